"""The thesis' claims as the report asks for them: `harness.report.claims.CLAIM_SETS` names this set."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from harness.evaluation.maps import MapCase
from harness.evaluation.summary import MAIN
from harness.programs.thesis.claims import claim_c11, score_claims
from harness.programs.thesis.inference import borne_out_if, posterior_of
from harness.programs.thesis.page import lead_of_views, posterior_section
from harness.programs.thesis.views import score_views
from harness.records.examples import ExampleCloud
from harness.records.trials import ResultTables
from harness.report.claims import Verdict

if TYPE_CHECKING:
    import pandas as pd
    from markupsafe import Markup


@dataclass(frozen=True)
class ThesisClaims:
    """The claims of the thesis: a `harness.report.claims.ClaimSet`, whose methods it keeps."""

    title: str = "The thesis' claims"
    title_of_set_ups: str = "The thesis' claim"
    title_of_views: str = "The thesis' claims and its proposal"

    def judge_sweep(
        self,
        tables: ResultTables,
        examples: Sequence[ExampleCloud],
        summary: pd.DataFrame,
    ) -> Sequence[Verdict]:
        """Return the verdicts on C1 to C6 and C9."""
        return score_claims(tables, MAIN, examples, summary)

    def judge_set_ups(self, summary: pd.DataFrame, axes: Sequence[str]) -> Sequence[Verdict]:
        """Return the verdict on C11, if the set-ups compare the thesis' cameras."""
        verdict = claim_c11(summary, axes)
        return [] if verdict is None else [verdict]

    def judge_views(self, cases: Sequence[MapCase]) -> Sequence[Verdict]:
        """Return the verdicts on C7, C8, C10 and H1."""
        return score_views(cases)

    def posterior_of(self, summary: pd.DataFrame, axes: Sequence[str]) -> pd.DataFrame | None:
        """Return the posterior probability of each set-up, given the thesis' result."""
        return posterior_of(summary, axes)

    def posterior_section(self, posterior: pd.DataFrame) -> Sequence[Markup]:
        """Return the section on what would make the thesis true."""
        return posterior_section(posterior)

    def posterior_answer(self, posterior: pd.DataFrame) -> str:
        """Return the sentence on the facts that the thesis' result requires."""
        return borne_out_if(posterior)

    def lead_of_views(self, verdicts: Sequence[Verdict]) -> str:
        """Return the answer to the question whether several views are better than one."""
        return lead_of_views(verdicts)


THESIS = ThesisClaims()
