"""Claims are found by the target's name."""

from __future__ import annotations

import pytest

from harness.programs.thesis.answers import THESIS
from harness.report.claims import CLAIM_SETS, claim_set_of


def test_the_thesis_target_has_the_thesis_claims() -> None:
    assert claim_set_of({"source": {"target": {"name": "thesis"}}}) is THESIS


@pytest.mark.parametrize(
    "facts",
    [
        {},
        {"source": {}},
        {"source": {"kind": "capture", "target": None}},
        {"source": {"target": {"family": "drawn"}}},
        {"source": {"target": {"name": "drawn"}}},
    ],
)
def test_other_targets_have_no_claims(facts: dict[str, object]) -> None:
    assert claim_set_of(facts) is None


def test_every_set_that_the_registry_names_exists() -> None:
    for name in CLAIM_SETS:
        claim_set = claim_set_of({"source": {"target": {"name": name}}})
        assert claim_set is not None
        assert claim_set.title and claim_set.title_of_set_ups and claim_set.title_of_views
