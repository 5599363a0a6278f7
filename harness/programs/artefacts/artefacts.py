"""``tofpod artefacts``: makes stored answers again that are older than the code, and writes what
documents quote of them."""

import argparse
import sys

from harness.vocabulary.errors import UserError
from harness.vocabulary.program import program


def _options(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("--only", action="append", metavar="NAME", help="only this artefact; may be repeated")
    add("--quick", action="store_true", help="with a third of the boards; documents then say so")
    add("--ages", action="store_true", help="make nothing; write into documents what is older")
    add(
        "--made",
        action="append",
        default=[],
        metavar="NAME",
        help="state that an artefact has been made by hand from today's code; may be repeated",
    )


@program(
    _options,
    "Make the stored answers again that are older than the code: the atlas, the baseline of the "
    "gate, and tables and pictures of the documents, the most valuable first. An artefact of "
    "today's code is left as it is. It needs a checkout.",
    "tofpod artefacts --only today --quick",
    "tofpod artefacts --ages",
    epilog="The same command goes on after Ctrl-C. `tofpod ls artefacts` lists all with their age.",
)
def main(options: argparse.Namespace, command: str) -> int:
    """Run the program. Returns 0, 1 if a command fails, 2 for a user's mistake, 130 after
    Ctrl-C."""
    from harness.programs.artefacts.declaration import declared_artefacts, refuse_without_checkout
    from harness.programs.artefacts.ledger import entry_now, read_ledger, store_entry
    from harness.programs.artefacts.making import make_all, store_files
    from harness.programs.artefacts.quoted import write_quotations

    refuse_without_checkout()
    for name in options.made:
        store_files(name)
        entry = entry_now(name, None)
        store_entry(name, entry)
    failed = []
    if not options.ages and not options.made:
        for name in options.only or ():
            _refuse_by_hand(name)
        names = options.only or list(declared_artefacts())
        failed = make_all(names, quick=options.quick)
    for document in write_quotations(read_ledger()):
        print(f"wrote {document}")
    if failed:
        print(f"not made: {', '.join(failed)}", file=sys.stderr)
    return int(bool(failed))


def _refuse_by_hand(name: str) -> None:
    """Raise UserError for an artefact that no command makes as a whole, and for an unknown name."""
    from harness.programs.artefacts.declaration import artefact_named

    artefact = artefact_named(name)
    if artefact.by_hand:
        instruction = "; ".join(artefact.commands) or "as its document describes"
        raise UserError(
            f"{name}: is made by hand",
            fix=f"make it again ({instruction}), then run tofpod artefacts --made {name}",
        )


if __name__ == "__main__":
    raise SystemExit(main())
