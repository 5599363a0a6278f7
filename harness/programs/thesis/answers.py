"""The thesis' claims as the report asks for them; `harness.report.claims` names this set."""

from harness.programs.thesis.cameras import score_cameras
from harness.programs.thesis.claims import score_claims
from harness.programs.thesis.inference import borne_out_if, posterior_of
from harness.programs.thesis.page import lead_of_views, posterior_section
from harness.programs.thesis.views import score_views
from harness.report.claims import ClaimSet

THESIS = ClaimSet(
    title="The thesis' claims",
    title_of_set_ups="The thesis' claim",
    title_of_views="The thesis' claims and its proposal",
    judge_sweep=score_claims,
    judge_set_ups=score_cameras,
    judge_views=score_views,
    lead_of_views=lead_of_views,
    posterior_of=posterior_of,
    posterior_section=posterior_section,
    posterior_answer=borne_out_if,
)
