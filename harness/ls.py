"""``python -m harness.ls``: list detectors and cameras with their settings, folders of results, and stored renders."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from harness.vocabulary.errors import UserError, exit_code_of

if TYPE_CHECKING:
    from harness.listing.offers import Offers

KINDS = ("detectors", "cameras")
STORED = ("results", "cache")


def main(arguments: list[str] | None = None) -> int:
    """The program. Returns 0 (also where something listed is broken), 2 on a mistake of the user."""
    options = _parser().parse_args(arguments)
    return exit_code_of(lambda: _run(options))


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m harness.ls",
        description="List detectors and cameras: tofpod's own and those that installed packages offer through the "
        "entry point groups tofpod.detectors and tofpod.cameras. Or folders of results, or the cache of renders.",
        epilog="examples: python -m harness.ls; python -m harness.ls thesis; python -m harness.ls cameras kinect_v2; "
        "python -m harness.ls --json; python -m harness.ls results; python -m harness.ls results averaging; "
        "python -m harness.ls cache",
    )
    add = parser.add_argument
    add("what", nargs="?", help=f"list one kind only ({', '.join(KINDS)}, results or cache); or a detector or camera")
    add("name", nargs="?", help="show everything that can be set of this one; of results, those of this experiment")
    add("--out", type=Path, default=Path("results"), metavar="DIR", help="where results are (default: results)")
    add("--fast", action="store_true", help="of the cache: do not read every render to find damaged ones")
    add("--json", action="store_true", help="as JSON, for programs")
    return parser


def _run(options: argparse.Namespace) -> int:
    if options.what == "results":
        return _list_results(options)
    if options.what == "cache":
        return _list_cache(options)
    return _list_offers(options)


# ---------------------------------------------------------------- detectors and cameras


def _list_offers(options: argparse.Namespace) -> int:
    from harness.listing.offers import OFFERS
    from harness.listing.text import table_lines

    if options.what is not None and options.what not in OFFERS:
        return _show_whichever(options)
    if options.name is not None:
        return _show(OFFERS[options.what], options.name, as_json=options.json)
    chosen = {title: OFFERS[title] for title in ([options.what] if options.what else OFFERS)}
    rows = {title: offers.rows() for title, offers in chosen.items()}
    if options.json:
        return _print_json(rows)
    for number, (title, offers) in enumerate(chosen.items()):
        print(f"{chr(10) if number else ''}{title} (entry points: {offers.plug_ins().group})")
        print("\n".join(table_lines([offers.cells(row) for row in rows[title]])))
    return 0


def _show_whichever(options: argparse.Namespace) -> int:
    """Show a detector, a camera, or one of each, by name. Raises UserError where there is none."""
    from harness.listing.offers import OFFERS
    from harness.vocabulary.declaration.diagnose import nearest

    word = options.what
    named = [title for title, offers in OFFERS.items() if word in offers.plug_ins().names()]
    if options.name is not None or not named:
        names = [name for offers in OFFERS.values() for name in offers.plug_ins().names()]
        legal = [*OFFERS, *STORED, *([] if options.name is not None else names)]
        near = nearest(word, legal)
        raise UserError(
            f"there is nothing called {word!r} to list" + (f"; did you mean {near!r}?" if near else ""),
            legal=", ".join(legal),
            fix="python -m harness.ls lists all",
        )
    if options.json:
        return _print_json({title: OFFERS[title].shown(word) for title in named})
    for title in named:
        _show(OFFERS[title], word, as_json=False)
    return 0


def _show(offers: Offers, name: str, *, as_json: bool) -> int:
    """Show one of them with its settings. Raises UserError where it is unknown, taken twice or broken."""
    from harness.listing.text import table_lines
    from harness.vocabulary.seeds import canonical_json

    row = offers.shown(name)
    if as_json:
        return _print_json(row)
    print("\n".join(table_lines([offers.cells(row)], indent="")))
    settable = row[offers.settable_title]
    print("\n".join(table_lines([(one["path"], canonical_json(one["value"]), one["about"]) for one in settable])))
    return 0


# ---------------------------------------------------------------- results and renders


def _list_results(options: argparse.Namespace) -> int:
    """List every folder of results with its state, the limit that it found and what tells it from others. Raises
    UserError where an experiment was named that has none."""
    from harness.listing.results import result_folders
    from harness.listing.text import size_text, table_lines

    folders = list(result_folders(options.out, options.name))
    if options.name is not None and not folders:
        raise UserError(
            f"{options.out}: has no results of {options.name!r}", fix="python -m harness.ls results lists all"
        )
    if options.json:
        return _print_json([one.to_data() for one in folders])
    print(f"results in {options.out}" + ("" if folders else ": none"))
    for name in sorted({one.experiment for one in folders}):
        print(f"  {name}")
        shown = [one for one in folders if one.experiment == name]
        rows = [
            (
                one.digest,
                (one.date or "")[:10],
                (one.commit or "")[:7] + ("+" if one.dirty else ""),
                size_text(one.size_bytes),
                "report" if one.has_report else "no report",
                one.note + (", latest" if one.is_latest else ""),
            )
            for one in shown
        ]
        for one, line in zip(shown, table_lines(rows, indent="    "), strict=True):
            print(line)
            for said in (one.limit_text, one.differs_text):
                if said:
                    print(f"      {said}")
    return 0


def _list_cache(options: argparse.Namespace) -> int:
    import time

    from harness.listing.text import age_text, cache_folder, size_text
    from scenes.render.cache import damaged_renders, leftovers, stored_renders

    if options.name is not None:
        raise UserError(f"the cache has no part called {options.name!r}", fix="python -m harness.ls cache")
    folder = cache_folder(options.out)
    renders, left = stored_renders(folder), leftovers(folder)
    ages_s = [max(time.time() - one.used_s, 0.0) for one in renders]
    size_bytes, left_bytes = (sum(one.size_bytes for one in files) for files in (renders, left))
    damaged = None if options.fast else [one.path.name for one in damaged_renders(renders)]  # 5 ms a render
    if options.json:
        facts = {"folder": str(folder), "renders": len(renders), "size_bytes": size_bytes}
        facts |= {"longest_unused_s": max(ages_s, default=None), "latest_use_s": min(ages_s, default=None)}
        return _print_json(facts | {"damaged": damaged, "leftovers": len(left), "leftovers_bytes": left_bytes})
    print(f"cache {folder}\n  renders: {len(renders)}, {size_text(size_bytes)}")
    if renders:
        print(f"  used: latest {age_text(min(ages_s))}, oldest {age_text(max(ages_s))}")
    if damaged is None:
        print("  damaged: not looked for")
    elif damaged:
        named = ", ".join(damaged[:3]) + (", ..." if len(damaged) > 3 else "")
        print(f"  damaged, or of another version: {len(damaged)} ({named})")
        print("    rendered again when needed; python -m harness.clean cache --damaged removes them")
    elif renders:
        print("  damaged: none")
    if left:
        print(f"  left by processes that were killed: {len(left)}, {size_text(left_bytes)}")
    return 0


def _print_json(value: Any) -> int:
    import json

    print(json.dumps(value, indent=2, ensure_ascii=False))
    return 0


if __name__ == "__main__":
    sys.exit(main())
