"""``tofpod clean``: removes stored renders or results folders, after confirmation."""

import argparse
import sys
from contextlib import ExitStack
from pathlib import Path

from harness.vocabulary.errors import UserError
from harness.vocabulary.files import size_text
from harness.vocabulary.program import bytes_of, program


def _options(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    what_help = (
        "cache: stored renders, which are made again when they are needed; results: results folders"
    )
    add("what", choices=("cache", "results"), help=what_help)
    name_help = "name of the results, as listed by tofpod ls results"
    add("name", nargs="?", default="", metavar="NAME[/DIGEST]", help=name_help)
    keep_help = (
        "remove the longest unused renders, or the results that were written longest ago, until "
        "the rest fits, such as 5GB (bare: GB)"
    )
    add("--keep", type=bytes_of, metavar="SIZE", help=keep_help)
    add("--all", action="store_true", help="cache: remove all renders")
    add(
        "--results",
        type=Path,
        default=Path("results"),
        metavar="DIR",
        help="folder of results (default: results)",
    )
    add("--dry-run", action="store_true", help="print what would be removed; remove nothing")
    add("--yes", action="store_true", help="do not ask for confirmation")


@program(
    _options,
    "Remove stored renders or results. Only files that tofpod wrote below --results are "
    "removed, links are never "
    "followed, and files of a running sweep are kept.",
    "tofpod clean cache --keep 5GB",
    "tofpod clean results --keep 2GB --dry-run",
)
def main(options: argparse.Namespace, command: str) -> int:
    """Run the program. Returns 0, 1 if something could not be removed or the answer was no, 2 for
    a user's mistake."""
    from harness.programs.keeping.listing import (
        cache_removal,
        chosen_results,
        oldest_results,
        refuse_links,
        removable,
        remove_empty,
    )
    from harness.vocabulary.text import many
    from scenes.render.cache import removed

    of_results = options.what == "results"
    limit = options.keep
    if of_results and options.all:
        raise UserError("--all is for the cache", legal="clean results NAME[/DIGEST], or --keep")
    if options.name and not of_results:
        raise UserError(
            f"the cache has no part called {options.name!r}",
            legal="clean cache --keep SIZE, or --all",
        )
    if of_results:
        if limit is None:
            folders = chosen_results(options.results, options.name)
        else:
            folders = oldest_results(options.results, options.name, limit)
        print("".join(f"{folder}\n" for folder in folders), end="")
    else:
        folders = [options.results / ".cache" / "renders"]
        if (limit is None) != options.all:
            raise UserError("no renders are selected for removal", legal="--keep SIZE, or --all")
        if not folders[0].is_dir():
            print(f"{folders[0]}: there is no cache")
            return 0
        refuse_links(folders[0], folders[0].parent)
    if not options.dry_run:
        with _held(folders, of_results):  # report a running sweep before asking
            pass
    wanted = [
        file
        for path in folders
        for file in (removable(path) if of_results else cache_removal(path, limit))
    ]
    in_folders = f"{len(wanted)} files in {many(len(folders), 'folder')}"
    subject = in_folders if of_results else many(len(wanted), "stored render")
    if not _agreed(
        options, f"{subject}, {size_text(sum(file.size_bytes for file in wanted))}", len(wanted)
    ):
        return 0 if options.dry_run or not wanted else 1
    with _held(folders, of_results):  # not held during the question, which would block every sweep
        gone = removed(wanted)
    # Windows removes no lock while it is held
    gone += removed(file for file in wanted if file not in gone)
    for folder in folders if of_results else ():
        remove_empty(folder)
        if folder.exists():
            print(
                f"{folder}: is kept because it contains files that tofpod did not write",
                file=sys.stderr,
            )
    print(f"removed {many(len(gone), 'file')}, {size_text(sum(file.size_bytes for file in gone))}")
    if kept := len(wanted) - len(gone):
        print(f"{many(kept, 'file')} could not be removed", file=sys.stderr)
    return 1 if kept else 0


def _held(folders: list[Path], of_results: bool) -> ExitStack:
    """Lock folders. Raises UserError if a sweep uses one, or if one cannot be written."""
    from harness.runs.shards import locked
    from scenes.render.cache import alone

    with ExitStack() as locks:
        for folder in folders:
            try:
                locks.enter_context(locked(folder) if of_results else alone(folder))
            except OSError as error:
                raise UserError(
                    f"{folder}: cannot be written ({error.strerror})", fix="ask its owner"
                ) from error
        return locks.pop_all()


def _agreed(options: argparse.Namespace, subject: str, count: int) -> bool:
    """Ask for confirmation. Raises UserError if nobody can be asked."""
    if options.dry_run or not count:
        print(f"would remove {subject}" if count else "nothing to remove")
        return False
    if options.yes:
        return True
    if not sys.stdin.isatty():
        raise UserError(
            f"cannot ask whether to remove {subject}",
            fix="add --yes to confirm, or --dry-run to look",
        )
    try:
        return input(f"remove {subject}? [y/N] ").strip().lower() in ("y", "yes")
    except EOFError:
        return False


if __name__ == "__main__":
    raise SystemExit(main())
