"""``tofpod audit``: how often everything that is quoted covers the truth."""

import argparse
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from harness.vocabulary.program import program, whole_number

if TYPE_CHECKING:
    from harness.programs.audit.rows import Audited
    from harness.programs.audit.studies import Claim

STUDIES = 300
QUICK_STUDIES = 30
QUICK_BOARDS = ("study.boards=3", "study.hole_free_boards=6", "threshold.calibrate.boards=20")
BOARDS = Path(__file__).with_name("audit.yaml")


def _options(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add(
        "--studies",
        type=whole_number(100_000),
        metavar="N",
        help=f"simulated studies of each case (default: {STUDIES}; --quick: {QUICK_STUDIES})",
    )
    add("--quick", action="store_true", help="few studies and boards: wide intervals, in minutes")
    add("--no-boards", action="store_true", help="leave out sizes, depths and counted false calls")
    add(
        "--out",
        type=Path,
        default=Path("results/audit"),
        metavar="DIR",
        help="default: results/audit",
    )
    add("--jobs", type=whole_number(256), default=2, metavar="N", help="processes (default: 2)")


@program(
    _options,
    "Show how often what is quoted covers the truth. Thresholds, rates, a50, a90 and a90/95 are "
    "stated for simulated studies of steep and flat curves, few and many targets, and boards that "
    "differ; diameters, depths and false calls for boards that are rendered and recorded by one "
    "simulated camera. Write audit.html, audit.csv and audit.parquet.",
    "tofpod audit --quick",
    "tofpod audit --quick --no-boards --out audit",
    epilog="A simulated study takes 0.2 s of processor time, one with a precision 0.7 s: all 14 "
    "cases some 25 minutes, --quick 3, and the boards besides.",
)
def main(options: argparse.Namespace, command: str) -> int:
    """Run the program. Returns 0, 2 for a user's mistake, 130 after Ctrl-C."""
    from harness import api
    from harness.programs.audit.boards import rows_of_study
    from harness.programs.audit.page import audit_html, headline
    from harness.programs.audit.rows import AUDIT
    from harness.runs.tables import write_tables
    from harness.vocabulary.files import write_text
    from harness.vocabulary.provenance import RESULTS_VERSION, record
    from harness.vocabulary.text import show

    studies = options.studies or (QUICK_STUDIES if options.quick else STUDIES)
    rows = rows_of_simulated(studies, options.jobs)
    if not options.no_boards:
        changes = QUICK_BOARDS if options.quick else ()
        folder = api.sweep(BOARDS, *changes, out=options.out, jobs=options.jobs)
        rows += rows_of_study(folder)
    options.out.mkdir(parents=True, exist_ok=True)
    provenance = {**record(command), "results_version": RESULTS_VERSION}
    write_tables(options.out, {AUDIT: AUDIT.frame(rows)}, provenance)
    page = options.out / "audit.html"
    write_text(page, audit_html(rows, studies, command))
    show([AUDIT.grid(rows), "", headline(rows)])
    print(f"page: {page}")
    return 0


def rows_of_simulated(studies: int, jobs: int) -> list["Audited"]:
    """Return the rows of ``studies`` simulated studies of each case."""
    from harness.programs.audit.precise_studies import PRECISE_CASES, claims_of_precise_study
    from harness.programs.audit.studies import STUDY_CASES, claims_of_study

    rows = []
    for case in STUDY_CASES:
        judged = _judged(partial(claims_of_study, case), studies, jobs)
        rows += _rows(case.name, [claim for of_study in judged for claim in of_study])
    for precise in PRECISE_CASES:
        judged = _judged(partial(claims_of_precise_study, precise), studies, jobs)
        rows += _rows(precise.name, [claim for of_study in judged for claim in of_study])
    return rows


def _judged(
    judge: Callable[[int], list["Claim"]], studies: int, jobs: int
) -> Iterator[list["Claim"]]:
    """Yield the claims of each study."""
    if jobs == 1:
        yield from map(judge, range(studies))
        return
    with ProcessPoolExecutor(jobs) as processes:
        yield from processes.map(judge, range(studies), chunksize=10)


def _rows(case: str, claims: Sequence["Claim"]) -> list["Audited"]:
    """Return a row for each quantity, in the order of the first study."""
    import numpy as np

    from harness.programs.audit.rows import audited

    by_quantity: dict[str, list[Claim]] = defaultdict(list)
    for claim in claims:
        by_quantity[claim.quantity].append(claim)
    rows = []
    for quantity, stated in by_quantity.items():
        row = audited(
            quantity,
            case,
            nominal=stated[0].nominal,
            holds=np.array([claim.holds for claim in stated]),
            ratio=np.array([claim.ratio for claim in stated]),
        )
        rows.append(row)
    return rows


if __name__ == "__main__":
    raise SystemExit(main())
