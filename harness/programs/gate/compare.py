"""``tofpod compare A B``: compares two studies of detection limits, set-up by set-up, with paired
tests."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from harness.records.outputs import COMPARISON, COMPARISON_PAGE
from harness.vocabulary.errors import UserError
from harness.vocabulary.program import program

if TYPE_CHECKING:
    from harness.programs.gate.verdict import Comparison

FILES = (COMPARISON.name, COMPARISON_PAGE.name)


def _options(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add(
        "first",
        type=Path,
        metavar="A",
        help="a result folder of a sweep with a `study`, or its study.json",
    )
    add(
        "second",
        type=Path,
        metavar="B",
        help="the other study, in the same form: is B worse or better than A?",
    )
    level = "significance level of the tests, for all set-ups together (default: 0.05)"
    add("--alpha", type=float, default=0.05, metavar="P", help=level)
    add("--out", type=Path, metavar="DIR", help=f"also write {' and '.join(FILES)} to this folder")


@program(
    _options,
    "Compare the detection limits of two studies: a90 and its change with an interval over "
    "boards, "
    "hits and false calls with tests, and a mark for each set-up: + worse, - better, ~ not "
    "significant, ! newly "
    "failing, x not comparable.",
    "tofpod compare A B",
    "tofpod compare A B --alpha 0.01 --out compared",
    epilog="Set-ups are paired by name and frames; if each study has a single set-up, the two are "
    "paired. Tests are "
    "paired if both studies have the same boards. tofpod check fails if a detection limit grew.",
)
def main(options: argparse.Namespace, command: str) -> int:
    """Run the program. Returns 0 for any result of the comparison, 2 for a user's mistake, 130
    after Ctrl-C."""
    from harness.evaluation.study.record import read_record
    from harness.programs.gate.page import compare_parts
    from harness.programs.gate.verdict import compare_studies, paired_set_ups
    from harness.vocabulary.text import show

    if not 1e-6 <= options.alpha <= 0.5:
        raise UserError(f"--alpha {options.alpha:g}", legal="1e-6 to 0.5")
    first = read_record(options.first)
    second = read_record(options.second)
    if not any(old is not None and new is not None for old, new in paired_set_ups(first, second)):
        names_of_both = " / ".join(
            "; ".join(set_up.label for set_up in study.set_ups) for study in (first, second)
        )
        message = (
            "no set-ups can be paired, since none has the same name and frames in both "
            f"studies: {names_of_both}"
        )
        legal = (
            "set-ups with the same frames and the same name or values on the axes; or a single "
            "set-up in each"
        )
        raise UserError(
            message,
            legal=legal,
            fix="run both studies with the same `sweep`, or each with a single set-up",
        )
    comparison = compare_studies(first, second, options.alpha)
    show(compare_parts(comparison))
    if options.out is not None:
        write_comparison(comparison, options.out, command)
        print(f"wrote {', '.join(str(options.out / name) for name in FILES)}")
    return 0


def write_comparison(comparison: Comparison, folder: Path, command: str) -> None:
    """Write `FILES` into ``folder``."""
    from harness.programs.gate.page import compare_data, compare_html
    from harness.vocabulary.files import write_json, write_text

    write_json(folder / FILES[0], compare_data(comparison))
    write_text(folder / FILES[1], compare_html(comparison, command))


if __name__ == "__main__":
    raise SystemExit(main())
