"""The page of an audit."""

from collections.abc import Sequence

from harness.programs.audit.rows import AUDIT, Audited
from harness.report.blocks import command_of, note, page

METHOD = (
    "Simulated studies: {studies} of each case, with known truth, judged as studies are. Their "
    "thresholds are set by 60 simulated hole-free boards, so that a50, a90 and a90/95 contain the "
    "thresholds' error. Boards: rendered and recorded by one simulated Azure Kinect; only damage "
    "that was found and measured counts. A statement is judged by the exact 95 % interval of its "
    "coverage: too seldom if this lies below the nominal coverage, more often if above."
)


def headline(rows: Sequence[Audited]) -> str:
    """Return the answer in one sentence."""
    seldom = [row for row in rows if row.verdict == "too seldom"]
    if not seldom:
        return f"None of {len(rows)} statements covers the truth clearly less often than it says."
    worst = min(seldom, key=lambda row: row.coverage - row.nominal)
    return (
        f"{len(seldom)} of {len(rows)} statements cover the truth too seldom; the worst is "
        f"{worst.quantity} ({worst.case}): {100 * worst.coverage:.0f} % instead of "
        f"{100 * worst.nominal:.0f} %."
    )


def audit_html(rows: Sequence[Audited], studies: int, command: str) -> str:
    """Return the page."""
    body = [AUDIT.grid(rows).html(), *command_of(command)]
    return page("Audit", headline(rows), body, [note(METHOD.format(studies=studies))])
