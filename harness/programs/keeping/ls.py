"""``tofpod ls``: lists detectors and cameras with their settings, results folders, and stored
renders."""

import argparse
import json
import time
from pathlib import Path
from typing import Any

from harness.vocabulary.errors import UserError
from harness.vocabulary.files import size_text
from harness.vocabulary.program import program

DAY_S = 86_400.0
FIRST_PARTS = 3
"""Parts of the code that the list of artefacts names; JSON has all."""


def _options(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add(
        "what",
        nargs="?",
        help="detectors, filters, cameras, sources (cameras to record with), results, cache, "
        "artefacts, keys (of experiments); or the name of one of the first four",
    )
    add(
        "name",
        nargs="?",
        help="a detector or camera, to show all its settings; with results, the experiment",
    )
    add(
        "--results",
        type=Path,
        default=Path("results"),
        metavar="DIR",
        help="folder of results (default: results)",
    )
    add("--json", action="store_true", help="print JSON, for programs")


@program(
    _options,
    "List detectors, filters, cameras, and sources of frames to record: tofpod's own and those "
    "that installed packages offer through the entry point groups tofpod.detectors, "
    "tofpod.filters, tofpod.cameras and tofpod.sources. Or list results folders, the "
    "cache of renders, the age of stored answers (artefacts), or all keys of an experiment.",
    "tofpod ls cameras kinect_v2",
    "tofpod ls thesis",
)
def main(options: argparse.Namespace, command: str) -> int:
    """Run the program. Returns 0 (also if something listed is broken), 2 for a user's mistake."""
    if options.what == "keys":
        from harness.programs.keeping.listing import reference

        print(reference())
        return 0
    listings = {"results": _list_results, "cache": _list_cache, "artefacts": _list_artefacts}
    return listings.get(options.what, _list_offers)(options)


def _list_offers(options: argparse.Namespace) -> int:
    """List all offers, or the settings of a named one. Raises UserError for an unknown
    name."""
    from harness.programs.keeping.listing import (
        SETTABLE,
        grid_of,
        offered,
        plug_ins,
        results_bytes,
        shown,
    )
    from harness.vocabulary.seeds import canonical_json
    from harness.vocabulary.text import Grid, many, show
    from harness.vocabulary.words import nearest
    from scenes.render.cache import stored_renders

    word = options.what
    name = options.name
    if word in (None, *SETTABLE) and name is None:
        rows = {kind: offered(kind) for kind in ([word] if word else SETTABLE)}
        if options.json:
            return _print_json(rows)
        for kind, offers in rows.items():
            show([f"{kind} (entry points: {plug_ins(kind).group})", grid_of(kind, offers), ""])
        if word is None:
            print(_results_text(options.results, results_bytes(options.results)))
            renders = stored_renders(options.results / ".cache" / "renders")
            size = size_text(sum(file.size_bytes for file in renders))
            print(f"cache: {many(len(renders), 'render')}, {size}; tofpod clean bounds both")
        return 0
    kinds_with_name = (
        [word]
        if word in SETTABLE
        else [kind for kind in SETTABLE if word in plug_ins(kind).names()]
    )
    if not kinds_with_name or (name is not None and word not in SETTABLE):
        names = (
            []
            if name is not None
            else [name for kind in SETTABLE for name in plug_ins(kind).names()]
        )
        legal = [*SETTABLE, "results", "cache", "artefacts", "keys", *names]
        nearest_word = nearest(word, legal)
        meant = f"; did you mean {nearest_word!r}?" if nearest_word else ""
        fix = "run tofpod ls for a list"
        raise UserError(
            f"there is nothing called {word!r} to list{meant}", legal=", ".join(legal), fix=fix
        )
    details = {kind: shown(kind, name or word) for kind in kinds_with_name}
    if options.json:
        return _print_json(details if name is None else details[word])
    for kind, row in details.items():
        settable = [
            (setting["path"], canonical_json(setting["value"]), setting["about"])
            for setting in row[SETTABLE[kind]]
        ]
        heads = (
            ("setting", "default", "legal")
            if kind != "cameras"
            else ("number", "value", "tag and source")
        )
        show([grid_of(kind, [row])])
        if settable:
            show(["", Grid.of(heads, settable, left=3)])
    return 0


def _list_results(options: argparse.Namespace) -> int:
    """List every results folder with its state, limit and differences. Raises UserError for an
    unknown experiment."""
    from harness.programs.keeping.listing import differs_text, limit_text, result_folders
    from harness.vocabulary.text import Grid

    folders = result_folders(options.results, options.name)
    if options.name is not None and not folders:
        fix = "run tofpod ls results for a list"
        raise UserError(f"{options.results}: has no results of {options.name!r}", fix=fix)
    if options.json:
        return _print_json(folders)
    print(_results_text(options.results, [run["size_bytes"] for run in folders]))
    for name in sorted({run["experiment"] for run in folders}):
        print(f"  {name}")
        shown = [run for run in folders if run["experiment"] == name]
        rows = []
        for run in shown:
            note = run["note"] + (", latest" if run["is_latest"] else "")
            rows.append(
                (run["digest"], (run["date"] or "")[:10], size_text(run["size_bytes"]), note)
            )
        for run, line in zip(
            shown, Grid.of(("run", "date", "size", "state"), rows, left=4).lines()[1:], strict=True
        ):
            cells = (limit_text(run["limits"]), differs_text(run["differs"]))
            print("\n".join([f"    {line}", *(f"      {text}" for text in cells if text)]))
    return 0


def _results_text(out: Path, sizes_bytes: list[int]) -> str:
    """Return a line on the number of results folders and their size."""
    from harness.vocabulary.text import many

    if not sizes_bytes:
        return f"results in {out}: none"
    return f"results in {out}: {many(len(sizes_bytes), 'folder')}, {size_text(sum(sizes_bytes))}"


def _list_cache(options: argparse.Namespace) -> int:
    from scenes.render.cache import leftovers, stored_renders

    if options.name is not None:
        raise UserError(f"the cache has no part called {options.name!r}", fix="tofpod ls cache")
    folder = options.results / ".cache" / "renders"
    renders = stored_renders(folder)
    leftover_files = leftovers(folder)
    size_bytes = sum(file.size_bytes for file in renders)
    unused_days = max(
        (max(time.time() - file.used_s, 0.0) / DAY_S for file in renders), default=0.0
    )
    if options.json:
        facts = {
            "folder": folder.as_posix(),
            "renders": len(renders),
            "size_bytes": size_bytes,
            "leftovers": len(leftover_files),
        }
        return _print_json(facts | {"longest_unused_days": unused_days})
    print(f"cache {folder}\n  renders: {len(renders)}, {size_text(size_bytes)}")
    if renders:
        print(f"  longest time without use: {unused_days:.1f} days")
    if leftover_files:
        print(f"  left by killed processes: {len(leftover_files)} files")
    return 0


def _list_artefacts(options: argparse.Namespace) -> int:
    """List every stored answer with its age and with what has changed since it was made."""
    from harness.programs.artefacts.listing import ages
    from harness.vocabulary.text import Grid, show

    rows = ages()
    if options.json:
        return _print_json(rows)
    heads = ("artefact", "made", "by tofpod", "seconds", "older than")
    cells = []
    for row in rows:
        older_than = row["older_than"]
        unshown = len(older_than) - FIRST_PARTS
        shown = ", ".join(older_than[:FIRST_PARTS])
        if unshown > 0:
            shown += f" and {unshown} more"
        facts = (row["made"], row["tofpod"], row["seconds"])
        cells.append(
            (row["name"], *("–" if fact is None else fact for fact in facts), shown or "–")
        )
    show([Grid.of(heads, cells, left=3)])
    return 0


def _print_json(value: Any) -> int:
    print(json.dumps(value, indent=2, ensure_ascii=False))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
