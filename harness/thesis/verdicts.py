"""Verdicts on claims, and decisions of rules with several parts.

A verdict needs certainty in either direction: where an interval leaves room for both, it is "undecided". No rule is a
parameter of the experiment, and none is chosen to make a claim come out.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass, fields
from functools import wraps
from typing import TYPE_CHECKING, Literal, TypeVar

from harness.evaluation.intervals import Interval
from harness.evaluation.maps import MANY

if TYPE_CHECKING:
    import pandas as pd

__all__ = ["FEW", "MANY", "Answer", "Rules", "Verdict", "claims_table", "decide", "is_above_zero", "rule_of"]

Answer = Literal["borne out", "not borne out", "undecided"]
CaseT = TypeVar("CaseT")
Rules = dict[str, Callable[[CaseT], "Verdict"]]

FEW = 1
"""The smaller and `MANY` the greater of the numbers of frames that the thesis' claims speak of."""


@dataclass(frozen=True)
class Verdict:
    """A claim, what the data say about it, the numbers behind that, and the criterion fixed beforehand."""

    claim: str
    text: str
    verdict: Answer
    evidence: str
    rule: str


def rule_of(
    rules: Rules[CaseT], claim: str, text: str, rule: str
) -> Callable[[Callable[[CaseT], tuple[Answer, str]]], Callable[[CaseT], Verdict]]:
    """Enter a function from a case to (answer, evidence) among ``rules``, as one from a case to a verdict."""

    def enter(judge: Callable[[CaseT], tuple[Answer, str]]) -> Callable[[CaseT], Verdict]:
        @wraps(judge)
        def judged(case: CaseT) -> Verdict:
            answer, evidence = judge(case)
            return Verdict(claim, text, answer, evidence, rule)

        rules[claim] = judged
        return judged

    return enter


def decide(parts: Iterable[bool | None]) -> Answer:
    """All parts hold: borne out. One fails: not borne out. Else undecided."""
    values = list(parts)
    if any(value is False for value in values):
        return "not borne out"
    return "borne out" if values and all(value is True for value in values) else "undecided"


def is_above_zero(interval: Interval) -> bool | None:
    """Return whether a difference is surely above zero; None where its interval has room for both."""
    return True if interval.above(0) else (False if interval.high <= 0 else None)


def claims_table(verdicts: Sequence[Verdict]) -> pd.DataFrame:
    """The table of claims.csv: one row for each verdict with the fields of `Verdict`."""
    import pandas as pd

    return pd.DataFrame([asdict(verdict) for verdict in verdicts], columns=[one.name for one in fields(Verdict)])
