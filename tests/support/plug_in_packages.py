"""Packages that offer plug-ins, as an installer leaves them: a folder on the search path with
their metadata."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import pytest


def offer(
    monkeypatch: pytest.MonkeyPatch,
    folder: Path,
    package: str,
    group: str,
    entries: Mapping[str, str],
) -> None:
    """Make ``package`` 1.2 offer the entries (name to target) from ``folder`` until the test ends."""
    info = folder / f"{package.replace('-', '_')}-1.2.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {package}\nVersion: 1.2\n")
    lines = "".join(f"{name} = {target}\n" for name, target in entries.items())
    (info / "entry_points.txt").write_text(f"[{group}]\n{lines}")
    monkeypatch.syspath_prepend(str(folder))
