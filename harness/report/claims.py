"""Claims about a target: what a set of claims offers to pages, and where sets are found.

Some targets have published claims, such as "with 50 frames the holes 4 to 11 are found". A set of
claims judges them on the tables of an experiment. Pages know only this interface; the sets are
programs of their own."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib import import_module
from typing import TYPE_CHECKING, Any, Literal

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
    """The answer of the experiment."""
    evidence: str
    """The numbers that support the verdict."""
    rule: str
    """The criterion, which was fixed in advance."""


@dataclass(frozen=True)
class ClaimSet:
    """The claims about one target: headings, and functions that judge them on the tables of an
    experiment with that target. ``summary`` has a row per set-up, number of frames and hole;
    ``axes`` are the paths on which set-ups differ."""

    title: str
    """Heading of the claims on the page of a plain sweep."""
    title_of_set_ups: str
    """Heading of the claims on the page of several set-ups."""
    title_of_views: str
    """Heading of the claims on the page of several views."""
    judge_sweep: Callable[
        [ResultTables, Sequence[ExampleCloud], pd.DataFrame],
        Sequence[Verdict],
    ]
    """(tables, averaged clouds, summary): the verdicts on a plain sweep."""
    judge_set_ups: Callable[[pd.DataFrame, Sequence[str]], Sequence[Verdict]]
    """(summary of all set-ups and variations, axes): the verdicts on several set-ups."""
    judge_views: Callable[[Sequence[MapCase]], Sequence[Verdict]]
    """(places): the verdicts on several views, for each place."""
    lead_of_views: Callable[[Sequence[Verdict]], str]
    """(verdicts): the first sentence of the answer on several views."""
    posterior_of: Callable[[pd.DataFrame, Sequence[str]], pd.DataFrame | None]
    """(summary of all set-ups, axes): rows of `harness.records.trials.POSTERIOR`, or None if the
    experiment does not determine them."""
    posterior_section: Callable[[pd.DataFrame], Sequence[Markup]]
    """(posterior): the section of a page on it."""
    posterior_answer: Callable[[pd.DataFrame], str]
    """(posterior): the answer of the page."""


def claim_set_of(facts: Mapping[str, Any]) -> ClaimSet | None:
    """Return the claims about the target of the resolved experiment ``facts``, or None if there
    are none."""
    target = facts.get("source", {}).get("target") or {}
    address = CLAIM_SETS.get(target.get("name", ""))
    if address is None:
        return None
    module_name, attribute = address.split(":")
    claim_set: ClaimSet = getattr(import_module(module_name), attribute)
    return claim_set
