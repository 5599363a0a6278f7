"""The choice of the default detector by holes implanted in the capture."""

from __future__ import annotations

import argparse
from dataclasses import dataclass, replace

import numpy as np
import pytest

from detectors import load_detector
from detectors.findings.tails import Tail, calls_at, threshold_at
from detectors.findings.virtual_holes import VirtualHoles
from detectors.interface import Detection, Evidence
from detectors.methods.part import part_of_cloud, part_of_evidence
from harness.inspection import arguments as cli
from harness.inspection import choosing
from harness.inspection.choosing import Contender, _is_better, candidate_of, chosen
from harness.testing.synthetic_clouds import plane
from harness.vocabulary.errors import UserError
from harness.vocabulary.geometry import Cloud

SETTINGS = {"crop": {"kind": "none"}, "surface": {"shape": "auto"}}


def contender(name: str, cloud: Cloud, threshold: float | None = None) -> Contender:
    options = argparse.Namespace(threshold=threshold, quiet_capture=None, false_calls=None)
    detector = load_detector(name, SETTINGS)
    return candidate_of(options, (detector, SETTINGS), cloud, lambda _: (float("nan"), ""))


@pytest.fixture(scope="module")
def cloud() -> Cloud:
    return plane(seed=5)


@pytest.mark.parametrize("name", cli.CANDIDATES)
def test_the_same_residuals_have_the_same_scores(name: str, cloud: Cloud) -> None:
    detector = load_detector(name, SETTINGS)
    evidence = detector.analyse(cloud)
    again = detector.rescored(cloud, evidence, evidence.residual_m)
    np.testing.assert_allclose(again.score, evidence.score, rtol=1e-9)
    deeper_m = evidence.residual_m.copy()
    row, column = np.argwhere(np.isfinite(evidence.score))[-1] // 2
    deeper_m[row : row + 6, column : column + 6] += 0.02
    deeper = detector.rescored(cloud, evidence, deeper_m)
    inside = np.s_[row : row + 6, column : column + 6]
    assert np.nanmin(deeper.score[inside]) > 3.0 * np.nanmax(evidence.score[inside])


def test_candidates_share_one_fit_of_the_surface() -> None:
    fresh = plane(seed=6)
    for name in cli.CANDIDATES:
        load_detector(name, SETTINGS).analyse(fresh)
    assert len(fresh.surfaces) == 1  # a cloud keeps each surface that was fitted to it
    polynomial = {**SETTINGS, "surface": {"shape": "polynomial", "degree": 2}}
    load_detector("local", polynomial).analyse(fresh)
    assert len(fresh.surfaces) == 3  # a polynomial, and the background that takes it


@pytest.mark.parametrize("name", cli.CANDIDATES)
def test_a_part_has_the_scores_and_findings_of_the_whole(name: str, cloud: Cloud) -> None:
    detector = load_detector(name, SETTINGS)
    evidence = detector.analyse(cloud)
    height, width = cloud.valid.shape
    rows = slice(height // 4, 3 * height // 4)
    columns = slice(width // 5, 4 * width // 5)
    part = part_of_cloud(cloud, rows, columns)
    evidence_of_part = part_of_evidence(evidence, rows, columns)
    np.testing.assert_array_equal(evidence_of_part.score, evidence.score[rows, columns])
    threshold = 0.9 * float(np.nanmax(evidence_of_part.score))
    (strongest, *_) = detector.find(part, evidence_of_part, threshold)
    assert strongest.score == pytest.approx(np.nanmax(evidence.score[rows, columns]))
    assert np.isfinite(strongest.centre_m).all()


@dataclass(frozen=True)
class Seeing:
    """A detector whose score is the residual in millimetres, if it is wide enough to be seen."""

    name: str
    least_mm: float

    def rescored(self, cloud: Cloud, evidence: Evidence, residual_m: np.ndarray) -> Evidence:
        return replace(evidence, residual_m=residual_m, score=np.abs(residual_m) * 1e3)

    def find(self, cloud: Cloud, evidence: Evidence, threshold: float) -> tuple[Detection, ...]:
        pixels = np.flatnonzero(np.nan_to_num(evidence.score) > max(self.least_mm, threshold))
        return tuple(Detection(1.0, np.array([pixel]), np.zeros(3)) for pixel in pixels)


def seeing(name: str, least_mm: float, cloud: Cloud, is_known: bool = True) -> Contender:
    residual_m = np.random.default_rng(3).normal(0.0, 1e-3, cloud.valid.shape)
    evidence = Evidence(np.abs(residual_m) * 1e3, residual_m, cloud.points_m[..., 2], 1e-3)
    return Contender(Seeing(name, least_mm), {}, evidence, 1.0, "", is_known)


def test_the_one_that_finds_most_holes_is_chosen_and_says_so(cloud: Cloud) -> None:
    sharp = seeing("thesis", 5.0, cloud)
    blunt = seeing("matched", 12.0, cloud)
    best = chosen([blunt, sharp], cloud, "1 expected false call")
    choice = best.evidence.notes["choice"]
    assert best.detector.name == choice["detector"] == "thesis"
    assert choice["found"]["thesis"] > choice["found"]["matched"]
    assert choice["text"].startswith(
        f"thesis, as it found {choice['found']['thesis']} of {choice['implanted']} implanted holes"
    )
    assert choice["text"].endswith(
        f"at 1 expected false call; matched {choice['found']['matched']}"
    )
    again = chosen([blunt, sharp], cloud, "1 expected false call")
    assert again.evidence.notes == best.evidence.notes


@pytest.mark.parametrize(
    ("shares", "scales"),
    [
        ([0.2], [1.0]),
        ([0.8], [1.0]),
        ([0.05, 0.5], [1.0, 2.5]),
        ([0.95, 0.5], [1.0, 0.4]),
        ([0.0, 0.0, 0.0], [1.0, 2.5, 6.25]),
    ],
)
def test_depths_change_until_the_best_finds_some_of_the_holes(
    cloud: Cloud, monkeypatch: pytest.MonkeyPatch, shares: list[float], scales: list[float]
) -> None:
    deepest_m = []
    left = list(shares)

    def found(
        candidate: Contender, part: Cloud, holes: VirtualHoles, squares: tuple[int, ...]
    ) -> np.ndarray:
        deepest_m.append(holes.depths_m.max())
        return np.full(len(holes.rows), left.pop(0))

    # a single picture of holes, so that each try is one call
    monkeypatch.setattr(choosing, "MOST_ROUNDS", 1)
    monkeypatch.setattr(choosing, "FEWEST", 1)
    monkeypatch.setattr(choosing, "_found", found)
    sought = choosing._sought([seeing("thesis", 5.0, cloud)], cloud, 1.0)
    assert left == []
    assert np.divide(deepest_m, deepest_m[0]) == pytest.approx(scales)
    assert sought is not None
    assert sought.depths_mm[1] == pytest.approx(deepest_m[-1] * 1e3)


def with_laws(contender: Contender, at_marks: int) -> Contender:
    """Return the candidate with a law of 100 peaks above a score of 3, and of some at marks."""
    scores = 3.0 + np.random.default_rng(2).exponential(0.5, 100)
    tails = {"plain": Tail.of(scores, 3.0), "marks": Tail.of(scores[:at_marks], 3.0)}
    null = {
        "expected": calls_at(tails, contender.threshold),
        "tails": {name: tail.facts for name, tail in tails.items()},
    }
    evidence = replace(contender.evidence, notes={"own_null": null})
    return replace(contender, evidence=evidence)


def test_one_with_more_false_calls_at_marks_is_compared_at_as_many(cloud: Cloud) -> None:
    sharp = replace(seeing("thesis", 5.0, cloud), threshold=5.0)
    blunt = replace(seeing("matched", 8.0, cloud), threshold=9.0)
    assert chosen([blunt, sharp], cloud, "").detector.name == "thesis"
    few_calls = with_laws(blunt, at_marks=1)
    many_calls = with_laws(sharp, at_marks=90)
    raised = many_calls.with_calls(few_calls.expected)
    assert raised.threshold > 5.0
    tails = {n: Tail.from_facts(f) for n, f in raised.evidence.notes["own_null"]["tails"].items()}
    assert calls_at(tails, raised.threshold) == pytest.approx(few_calls.expected)
    best = chosen([few_calls, many_calls], cloud, "")
    at_its_own = chosen([blunt, sharp], cloud, "")
    # the holes found at the raised threshold are fewer than at its own
    hits = best.evidence.notes["choice"]["found"]["thesis"]
    assert hits < at_its_own.evidence.notes["choice"]["found"]["thesis"]
    assert best.threshold in (few_calls.threshold, many_calls.threshold)
    text = best.evidence.notes["choice"]["text"]
    assert f" at {few_calls.expected:.2g} expected false calls; " in text


def test_equal_ones_are_told_by_the_pixels(cloud: Cloud) -> None:
    cloud = replace(
        cloud,
        points_m=np.tile(cloud.points_m, (5, 5, 1)),
        reason=np.tile(cloud.reason, (5, 5)),
        count=np.tile(cloud.count, (5, 5)),
        variance_m2=np.tile(cloud.variance_m2, (5, 5)),
    )
    equal = [seeing("local", 5.0, cloud), seeing("matched", 5.0, cloud)]
    native = chosen(equal, replace(cloud, noise_reach_px=3.0), "")
    assert native.detector.name == "matched"
    assert native.evidence.notes["choice"]["text"].endswith("matched suits a camera's own pixels")
    upsampled = chosen(equal, replace(cloud, noise_reach_px=8.0), "")
    assert upsampled.detector.name == "local"
    assert upsampled.evidence.notes["choice"]["text"].endswith("local suits upsampled pixels")


def test_an_unknown_number_of_false_calls_is_not_compared(cloud: Cloud) -> None:
    unknown = seeing("matched", 2.0, cloud, is_known=False)
    dull = seeing("local", 9.0, cloud)
    best = chosen([unknown, dull], cloud, "")
    assert best.detector.name == "local"
    assert "only its number of false calls is known" in best.evidence.notes["choice"]["text"]
    both_unknown = [unknown, seeing("thesis", 12.0, cloud, is_known=False)]
    assert chosen(both_unknown, cloud, "").detector.name == "matched"


def test_the_first_is_taken_where_nothing_can_be_implanted(cloud: Cloud) -> None:
    pair = [seeing("matched", 9.0, cloud), seeing("thesis", 5.0, cloud)]
    listed = replace(cloud, organised=False)
    best = chosen(pair, listed, "")
    assert best.detector.name == "matched"
    assert "without a grid" in best.evidence.notes["choice"]["text"]
    crowded = replace(cloud, noise_reach_px=40.0)
    assert "no place" in chosen(pair, crowded, "").evidence.notes["choice"]["text"]
    assert "only it has" in chosen(pair[:1], cloud, "").evidence.notes["choice"]["text"]


def test_a_difference_must_exceed_chance() -> None:
    hits = np.zeros(60, bool)
    by_other = hits.copy()
    hits[:5] = True
    assert _is_better(hits, by_other)
    hits[4] = False  # 4 to 0: 4 is no more than twice the root of 4
    assert not _is_better(hits, by_other)
    hits[:9] = True
    by_other[9:12] = True  # 9 to 3: 6 is less than twice the root of 12
    assert not _is_better(hits, by_other)
    assert not _is_better(hits, hits)


def options(*words: str) -> argparse.Namespace:
    from harness.detect import detect_options

    parser = argparse.ArgumentParser()
    detect_options(parser)
    return parser.parse_args(["capture", *words])


def test_settings_and_options_limit_what_is_compared() -> None:
    def names(*words: str) -> list[str]:
        stated = options(*words)
        return [detector.name for detector, _ in cli.detectors_of(stated, "auto", stated.set)]

    assert names() == list(cli.CANDIDATES)
    assert names("--detector", "local") == ["local"]
    assert names("--threshold", "5") == ["matched"]
    assert names("--set", "min_points=4") == ["thesis"]
    assert names("--set", "surface.degree=2") == list(cli.CANDIDATES)
    with pytest.raises(UserError, match="matched"):
        names("--set", "no_such=1")


def test_the_rate_is_stated() -> None:
    assert cli.rate_text(options()) == "1 expected false call"
    assert cli.rate_text(options("--false-calls", "0.5")) == "0.5 expected false calls"
    assert "silent" in cli.rate_text(options("--quiet-capture", "x"))


def test_a_threshold_for_all_laws_together_expects_that_many_calls() -> None:
    scores = 3.0 + np.random.default_rng(4).exponential(0.5, 60)
    tails = {"plain": Tail.of(scores, 3.0), "marks": Tail.of(scores[:30], 3.5)}
    both_sides = 2.0 * (tails["plain"].expected(4.0) + tails["marks"].expected(4.0))
    assert calls_at(tails, 4.0) == pytest.approx(both_sides)
    for calls in (10.0, 1.0, 0.01):
        assert calls_at(tails, threshold_at(tails, calls, 3.5)) == pytest.approx(calls)
    assert threshold_at(tails, 1e3, 3.5) == 3.5
