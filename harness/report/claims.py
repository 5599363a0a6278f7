"""Claims about a target: what a set of claims offers to pages, and where sets are found.

Some targets have published claims, such as "with 50 frames the holes 4 to 11 are found". A set of
claims judges them on the tables of an experiment. Pages know only this interface; the sets are
programs of their own."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib import import_module
from typing import TYPE_CHECKING, Any, Literal, Protocol

if TYPE_CHECKING:
    import pandas as pd
    from markupsafe import Markup

    from harness.evaluation.maps import MapCase
    from harness.records.examples import ExampleCloud
    from harness.records.trials import ResultTables

CLAIM_SETS = {"thesis": "harness.programs.thesis.answers:THESIS"}
"""The set of claims about a target by the target's name, as module:attribute."""

Answer = Literal["borne out", "not borne out", "undecided"]


@dataclass(frozen=True)
class Verdict:
    """A claim with its verdict; a row of the table of claims."""

    claim: str
    """Number of the claim, such as C1."""
    text: str
    """The claim in one sentence."""
    verdict: Answer
    """Whether the experiment bears the claim out."""
    evidence: str
    """The numbers that support the verdict."""
    rule: str
    """The criterion, which was fixed in advance."""


class ClaimSet(Protocol):
    """The claims about one target, judged on the tables of an experiment with that target."""

    @property
    def title(self) -> str:
        """The heading of the claims on the page of a plain sweep."""

    @property
    def title_of_set_ups(self) -> str:
        """The heading of the claims on the page of several set-ups."""

    @property
    def title_of_views(self) -> str:
        """The heading of the claims on the page of several views."""

    def judge_sweep(
        self,
        tables: ResultTables,
        examples: Sequence[ExampleCloud],
        summary: pd.DataFrame,
    ) -> Sequence[Verdict]:
        """Return the verdicts on a plain sweep. ``summary`` has a row per set-up, number of frames
        and hole; ``examples`` are averaged clouds."""

    def judge_set_ups(self, summary: pd.DataFrame, axes: Sequence[str]) -> Sequence[Verdict]:
        """Return the verdicts on several set-ups from the rows of all set-ups and variations.
        ``axes`` are the paths on which set-ups differ."""

    def judge_views(self, cases: Sequence[MapCase]) -> Sequence[Verdict]:
        """Return the verdicts on an experiment with several views, for each of its places."""

    def posterior_of(self, summary: pd.DataFrame, axes: Sequence[str]) -> pd.DataFrame | None:
        """Return rows of `harness.records.trials.POSTERIOR` from the rows of all set-ups, or None
        if the experiment does not determine them."""

    def posterior_section(self, posterior: pd.DataFrame) -> Sequence[Markup]:
        """Return the section of a page on the result of `posterior_of`."""

    def posterior_answer(self, posterior: pd.DataFrame) -> str:
        """Return the sentence of the answer on the result of `posterior_of`."""

    def lead_of_views(self, verdicts: Sequence[Verdict]) -> str:
        """Return the first sentence of the answer on several views from their verdicts."""


def claim_set_of(facts: Mapping[str, Any]) -> ClaimSet | None:
    """Return the claims about the target of the resolved experiment ``facts``, or None if there are
    none."""
    target = facts.get("source", {}).get("target") or {}
    address = CLAIM_SETS.get(target.get("name", ""))
    if address is None:
        return None
    module_name, attribute = address.split(":")
    claim_set: ClaimSet = getattr(import_module(module_name), attribute)
    return claim_set
