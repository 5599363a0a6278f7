"""``python -m harness.clean cache``: remove stored renders. Asks before it removes anything."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from harness.vocabulary.errors import UserError
from harness.vocabulary.files import size_text
from harness.vocabulary.program import program


def _options(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("what", choices=("cache",), help="renders; each is rendered again when it is needed")
    add("--limit", metavar="SIZE", help="the longest unused go until the rest fits, such as 5GB")
    add("--all", action="store_true", help="all of them")
    add("--out", type=Path, default=Path("results"), metavar="DIR", help="where results are (default: results)")
    add("--dry-run", action="store_true", help="say what would be removed; remove nothing")
    add("--yes", action="store_true", help="do not ask")


@program(
    _options,
    "Remove stored renders. Only what tofpod wrote below --out is removed, links are never followed, and what a "
    "running sweep uses is left alone. A folder of results is removed like any other folder.",
    epilog="example: python -m harness.clean cache --limit 5GB",
)
def main(options: argparse.Namespace, command: str) -> int:
    """Returns 0, 1 where something could not be removed or the answer was no, 2 on a mistake of the user."""
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
    print(f"removed {many(len(gone), 'file')}, {size_text(sum(file.size_bytes for file in gone))}")
    if kept := len(wanted) - len(gone):
        print(f"{many(kept, 'file')} could not be removed", file=sys.stderr)
    return 1 if kept else 0


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


if __name__ == "__main__":
    sys.exit(main())
