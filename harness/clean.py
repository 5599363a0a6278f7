"""``python -m harness.clean``: remove stored renders, or folders of results. Asks before it removes anything."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from harness.vocabulary.errors import UserError, exit_code_of

if TYPE_CHECKING:
    from scenes.render.cache import StoredFile


def main(arguments: list[str] | None = None) -> int:
    """The program. Returns 0, 1 where something could not be removed or the answer was no, 2 on a mistake."""
    options = _parser().parse_args(arguments)
    return exit_code_of(lambda: int(options.run(options)))


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m harness.clean",
        description="Remove stored renders or results. Only what tofpod wrote below --out is removed, links are never "
        "followed, and what a running sweep uses is left alone.",
        epilog="examples: python -m harness.clean cache --limit 5GB; python -m harness.clean cache --older-than 30d; "
        "python -m harness.clean results averaging/69346a82f4194e03 --journal-only --dry-run",
    )
    parts = parser.add_subparsers(required=True, metavar="cache|results")
    cache = parts.add_parser("cache", help="renders; each is rendered again when it is needed")
    cache.add_argument("--limit", metavar="SIZE", help="the longest unused go until the rest fits, such as 5GB")
    cache.add_argument("--older-than", metavar="AGE", help="those not used for so long, such as 12h, 30d or 4w")
    cache.add_argument("--damaged", action="store_true", help="those that cannot be read")
    cache.add_argument("--all", action="store_true", help="all of them")
    cache.set_defaults(run=_clean_cache)
    results = parts.add_parser("results", help="one folder of results, or all of an experiment")
    results.add_argument("name", metavar="NAME[/DIGEST]", help="as python -m harness.ls results names it")
    results.add_argument(
        "--journal-only", action="store_true", help="only the records of trials: tables and report stay"
    )
    results.set_defaults(run=_clean_results)
    for part in (cache, results):
        part.add_argument(
            "--out", type=Path, default=Path("results"), metavar="DIR", help="where results are (default: results)"
        )
        part.add_argument("--dry-run", action="store_true", help="say what would be removed; remove nothing")
        part.add_argument("--yes", action="store_true", help="do not ask")
    return parser


def _clean_cache(options: argparse.Namespace) -> int:
    from harness.listing import bytes_of, cache_removal, refuse_links, seconds_of
    from harness.tables.text import many
    from scenes.render.cache import alone, removed

    limit = None if options.limit is None else bytes_of(options.limit)
    older_s = None if options.older_than is None else seconds_of(options.older_than)
    if limit is None and older_s is None and not options.damaged and not options.all:
        raise UserError("no renders were chosen", legal="--limit SIZE, --older-than AGE, --damaged, --all; or several")
    folder = options.out / ".cache" / "renders"
    if not folder.is_dir():
        print(f"{folder}: there is no cache")
        return 0
    refuse_links(folder, folder.parent)
    if not options.dry_run:
        with alone(folder):  # a sweep that runs is told before anything is asked
            pass
    wanted = cache_removal(folder, limit, older_s, damaged=options.damaged, everything=options.all)
    return _remove(options, many(len(wanted), "stored render"), wanted, partial(alone, folder), removed)


def _clean_results(options: argparse.Namespace) -> int:
    from harness.listing import chosen_results, removable, remove_results
    from harness.tables.text import many

    folders = chosen_results(options.out, options.name)
    if not options.dry_run:
        with _held(folders):  # a sweep that runs is told before anything is asked
            pass
    files = [file for folder in folders for file in removable(folder, journal_only=options.journal_only)]
    print("\n".join(map(str, folders)))
    what = "files of journals" if options.journal_only else "files"

    def remove(files: list[StoredFile]) -> list[StoredFile]:
        gone = remove_results(folders, files)
        for folder in folders:
            if not options.journal_only and folder.exists():
                print(f"{folder}: is kept, as there are files in it that are not tofpod's", file=sys.stderr)
        return gone

    said = f"{len(files)} {what} in {many(len(folders), 'folder')}"
    return _remove(options, said, files, partial(_held, folders), remove)


@contextmanager
def _held(folders: list[Path]) -> Iterator[None]:
    """Hold folders of results. Raises UserError where a sweep holds one, or where it cannot be written."""
    from harness.engine.work import locked

    with ExitStack() as held:
        for folder in folders:
            try:
                held.enter_context(locked(folder))
            except OSError as error:
                raise UserError(f"{folder}: cannot be written ({error.strerror})", fix="ask whoever owns it") from error
        yield


def _remove(
    options: argparse.Namespace,
    what: str,
    files: list[StoredFile],
    held: Callable[[], AbstractContextManager[None]],
    remove: Callable[[list[StoredFile]], list[StoredFile]],
) -> int:
    """Ask whether to go on, then remove files while ``held``: not while the question waits for its answer, as that
    would block every sweep. Raises UserError where nobody can be asked."""
    from harness.listing import size_text
    from harness.tables.text import many

    what += f", {size_text(sum(file.size_bytes for file in files))}"
    if options.dry_run or not files:
        print(f"would remove {what}" if files else "nothing to remove")
        return 0
    if not options.yes and not sys.stdin.isatty():
        raise UserError(f"this would remove {what}", fix="say --yes where nobody can be asked, or --dry-run to look")
    answer = "y" if options.yes else ""
    with suppress(EOFError):
        answer = answer or input(f"remove {what}? [y/N] ")
    if answer.strip().lower() not in ("y", "yes"):
        return 1
    with held():
        gone = remove(files)
    print(f"removed {many(len(gone), 'file')}, {size_text(sum(file.size_bytes for file in gone))}")
    if len(gone) < len(files):
        print(f"{many(len(files) - len(gone), 'file')} could not be removed", file=sys.stderr)
    return int(len(gone) < len(files))


if __name__ == "__main__":
    sys.exit(main())
