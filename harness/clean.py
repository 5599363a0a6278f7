"""``python -m harness.clean``: remove stored renders, or folders of results. Asks before it removes anything."""

from __future__ import annotations

import argparse
import sys
from contextlib import ExitStack
from pathlib import Path

from harness.vocabulary.errors import UserError
from harness.vocabulary.files import size_text
from harness.vocabulary.program import program


def _options(parser: argparse.ArgumentParser) -> None:
    parts = parser.add_subparsers(required=True, metavar="cache|results")
    cache = parts.add_parser("cache", help="renders; each is rendered again when it is needed")
    cache.add_argument("--limit", metavar="SIZE", help="the longest unused go until the rest fits, such as 5GB")
    cache.add_argument("--all", action="store_true", help="all of them")
    cache.set_defaults(run=_clean_cache)
    results = parts.add_parser("results", help="one folder of results, or all of an experiment")
    results.add_argument("name", metavar="NAME[/DIGEST]", help="as python -m harness.ls results names it")
    results.set_defaults(run=_clean_results)
    for part in (cache, results):
        where = "where results are (default: results)"
        part.add_argument("--out", type=Path, default=Path("results"), metavar="DIR", help=where)
        part.add_argument("--dry-run", action="store_true", help="say what would be removed; remove nothing")
        part.add_argument("--yes", action="store_true", help="do not ask")


@program(
    _options,
    "Remove stored renders or results. Only what tofpod wrote below --out is removed, links are never "
    "followed, and what a running sweep uses is left alone.",
    epilog="examples: python -m harness.clean cache --limit 5GB; "
    "python -m harness.clean results averaging/69346a82f4194e03 --dry-run",
)
def main(options: argparse.Namespace, command: str) -> int:
    """Returns 0, 1 where something could not be removed or the answer was no, 2 on a mistake of the user."""
    return int(options.run(options))


def _clean_cache(options: argparse.Namespace) -> int:
    from harness.listing import bytes_of, cache_removal, refuse_links
    from harness.tables.text import many
    from scenes.render.cache import alone, removed

    limit = None if options.limit is None else bytes_of(options.limit)
    if (limit is None) != options.all:
        raise UserError("which renders are to go?", legal="--limit SIZE, or --all")
    folder = options.out / ".cache" / "renders"
    if not folder.is_dir():
        print(f"{folder}: there is no cache")
        return 0
    refuse_links(folder, folder.parent)
    if not options.dry_run:
        with alone(folder):  # a sweep that runs is told before anything is asked
            pass
    wanted = cache_removal(folder, limit)
    size = size_text(sum(file.size_bytes for file in wanted))
    if not _agreed(options, f"{many(len(wanted), 'stored render')}, {size}", len(wanted)):
        return 0 if options.dry_run or not wanted else 1
    with alone(folder):  # not while the question waits for its answer: that would block every sweep
        gone = removed(wanted)
    return _concluded(len(gone), len(wanted), sum(file.size_bytes for file in gone))


def _clean_results(options: argparse.Namespace) -> int:
    from harness.listing import chosen_results, removable, remove_results
    from harness.tables.text import many

    folders = chosen_results(options.out, options.name)
    if not options.dry_run:
        with ExitStack() as held:  # a sweep that runs is told before anything is asked
            _hold(held, folders)
    files = [file for folder in folders for file in removable(folder)]
    print("\n".join(map(str, folders)))
    size = size_text(sum(file.size_bytes for file in files))
    if not _agreed(options, f"{len(files)} files in {many(len(folders), 'folder')}, {size}", len(files)):
        return 0 if options.dry_run or not files else 1
    with ExitStack() as held:  # not while the question waits for its answer: that would block every sweep
        _hold(held, folders)
        gone = remove_results(folders, files)
    for folder in folders:
        if folder.exists():
            print(f"{folder}: is kept, as there are files in it that are not tofpod's", file=sys.stderr)
    return _concluded(len(gone), len(files), sum(file.size_bytes for file in gone))


def _hold(held: ExitStack, folders: list[Path]) -> None:
    """Hold folders of results. Raises UserError where a sweep holds one, or where it cannot be written."""
    from harness.engine.work import locked

    for folder in folders:
        try:
            held.enter_context(locked(folder))
        except OSError as error:
            raise UserError(f"{folder}: cannot be written ({error.strerror})", fix="ask whoever owns it") from error


def _agreed(options: argparse.Namespace, what: str, count: int) -> bool:
    """Ask whether to go on. Raises UserError where nobody can be asked."""
    if options.dry_run or not count:
        print(f"would remove {what}" if count else "nothing to remove")
        return False
    if options.yes:
        return True
    if not sys.stdin.isatty():
        raise UserError(f"this would remove {what}", fix="say --yes where nobody can be asked, or --dry-run to look")
    try:
        return input(f"remove {what}? [y/N] ").strip().lower() in ("y", "yes")
    except EOFError:
        return False


def _concluded(gone: int, wanted: int, freed_bytes: int) -> int:
    from harness.tables.text import many

    print(f"removed {many(gone, 'file')}, {size_text(freed_bytes)}")
    if gone < wanted:
        print(f"{many(wanted - gone, 'file')} could not be removed", file=sys.stderr)
    return 0 if gone == wanted else 1


if __name__ == "__main__":
    sys.exit(main())
