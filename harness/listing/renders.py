"""The cache of renders: how much is in it, how long it has not been used, what of it is damaged."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

from harness.listing.text import age_text, size_text
from scenes.render.cache import damaged_renders, leftovers, stored_renders


def cache_folder(out: Path) -> Path:
    """Where sweeps that write to ``out`` keep their renders."""
    return Path(out) / ".cache" / "renders"


def cache_facts(out: Path, *, check: bool) -> dict[str, Any]:
    """Counts, bytes, and seconds since the oldest and the latest use (None where there are no renders).

    ``check``: read every render and name the damaged ones, 5 ms each; None in their place without.
    """
    folder = cache_folder(out)
    renders, left = stored_renders(folder), leftovers(folder)
    now_s = time.time()
    ages = [max(now_s - one.used_s, 0.0) for one in renders]
    return {
        "folder": str(folder),
        "renders": len(renders),
        "size_bytes": sum(one.size_bytes for one in renders),
        "longest_unused_s": max(ages, default=None),
        "latest_use_s": min(ages, default=None),
        "damaged": [one.path.name for one in damaged_renders(renders)] if check else None,
        "leftovers": len(left),
        "leftovers_bytes": sum(one.size_bytes for one in left),
    }


def cache_lines(facts: dict[str, Any]) -> list[str]:
    """The same as text."""
    lines = [f"cache {facts['folder']}", f"  renders: {facts['renders']}, {size_text(facts['size_bytes'])}"]
    if facts["renders"]:
        lines.append(f"  used: latest {age_text(facts['latest_use_s'])}, oldest {age_text(facts['longest_unused_s'])}")
    if facts["damaged"] is None:
        lines.append("  damaged: not looked for")
    elif facts["damaged"]:
        named = ", ".join(facts["damaged"][:3]) + (", ..." if len(facts["damaged"]) > 3 else "")
        lines.append(f"  damaged, or of another version: {len(facts['damaged'])} ({named})")
        lines.append("    rendered again when needed; python -m harness.clean cache --damaged removes them")
    elif facts["renders"]:
        lines.append("  damaged: none")
    if facts["leftovers"]:
        lines.append(
            f"  left by processes that were killed: {facts['leftovers']}, {size_text(facts['leftovers_bytes'])}"
        )
    return lines
