"""The contract kit: what keeps the contract passes, and each check fails for a detector that
breaks just that."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from detectors.findings.extents import measure_extents
from detectors.interface import Detection, Evidence, Measurement
from detectors.methods.thesis import ThesisDetector
from detectors.score_map import ScoreMapConfig, ScoreMapDetector, above, on_grid
from harness.testing import CHECKS, check_detector, turned_once
from harness.testing import contract as checks
from harness.testing.synthetic_clouds import cylinder, plane, synthetic_clouds, with_gaps
from harness.vocabulary.config import Config
from harness.vocabulary.errors import UserError
from harness.vocabulary.geometry import Cloud, rays_of

CLOUD = with_gaps(plane(seed=3), seed=4)


class Sound(ScoreMapDetector[ScoreMapConfig]):
    """A plane by least squares, refitted twice without what lies far off: the least that keeps the
    contract."""

    name = "sound"
    version = 1

    def analyse(self, cloud: Cloud) -> Evidence:
        mask = cloud.valid
        if mask.sum() < 3:
            raise UserError("three points at least are wanted")
        points = cloud.points_m[mask]
        design = np.column_stack([points[:, :2] - points[:, :2].mean(axis=0), np.ones(len(points))])
        kept = np.ones(len(points), dtype=bool)
        for _ in range(3):
            fitted = design @ np.linalg.lstsq(design[kept], points[kept, 2], rcond=None)[0]
            residual = points[:, 2] - fitted
            scale = float(np.median(np.abs(residual))) / 0.6745
            kept = np.abs(residual) <= 4 * scale
        score = np.abs(residual) / scale
        return Evidence(on_grid(score, mask), on_grid(residual, mask), on_grid(fitted, mask), scale)

    def measure(self, cloud: Cloud, evidence: Evidence, detection: Detection) -> Measurement:
        return measure_extents(cloud, detection, "extents only")


def test_what_keeps_the_contract_passes() -> None:
    check_detector(Sound)


def test_the_thesis_detector_keeps_it() -> None:
    check_detector(ThesisDetector)


def test_with_settings_as_yaml_holds_them_and_on_clouds_of_ones_own() -> None:
    check_detector(
        ThesisDetector,
        settings={"min_points": 3, "surface": {"degree": 2}},
        clouds=[cylinder(seed=8)],
    )


def test_a_function_may_make_it_and_then_settings_are_its_own_business() -> None:
    check_detector(lambda: Sound(ScoreMapConfig(min_points=2)), clouds=[CLOUD])
    with pytest.raises(TypeError, match="settings"):
        check_detector(lambda: Sound(ScoreMapConfig()), settings={"min_points": 2})


def test_a_cloud_without_a_grid_can_be_checked_on() -> None:
    n = CLOUD.valid.size
    row = {
        name: getattr(CLOUD, name).reshape(1, n, *getattr(CLOUD, name).shape[2:])
        for name in ("points_m", "reason", "count", "variance_m2")
    }
    check_detector(Sound, clouds=[replace(CLOUD, **row, organised=False, lens=None)])


# ---------------------------------------------------------------- one broken detector for each
# check


class NoVersion(Sound):
    version = True


class LaxSettings(ScoreMapConfig):
    needed: int


class NoDefaults(Sound):
    settings_type = LaxSettings

    def __init__(self, settings: Any = None) -> None:
        super().__init__(ScoreMapConfig())


class ForgetsSettings(ScoreMapConfig):
    def to_data(self) -> dict[str, Any]:
        return {"min_points": self.min_points + 1}


class StoresWrongly(Sound):
    settings_type = ForgetsSettings


class ScoresInvalid(Sound):
    def analyse(self, cloud: Cloud) -> Evidence:
        result = super().analyse(cloud)
        return replace(result, score=np.nan_to_num(result.score))


class OtherShape(Sound):
    def analyse(self, cloud: Cloud) -> Evidence:
        result = super().analyse(cloud)
        return replace(result, residual_m=result.residual_m.T)


class NoScale(Sound):
    def analyse(self, cloud: Cloud) -> Evidence:
        return replace(super().analyse(cloud), scale_m=0.0)


class Infinite(Sound):
    def analyse(self, cloud: Cloud) -> Evidence:
        result = super().analyse(cloud)
        return replace(result, score=np.where(result.score > 30, np.inf, result.score))


class Restless(Sound):
    calls = 0

    def analyse(self, cloud: Cloud) -> Evidence:
        Restless.calls += 1
        result = super().analyse(cloud)
        return replace(result, score=result.score * (1 + 1e-12 * Restless.calls))


class Remembers(Sound):
    last = 0.0

    def analyse(self, cloud: Cloud) -> Evidence:
        result = super().analyse(cloud)
        size = float(cloud.valid.sum())
        drift = 1e-9 if self.last not in (0.0, size) else 0.0
        self.last = size
        return replace(result, scale_m=result.scale_m + drift)


class Writes(Sound):
    def analyse(self, cloud: Cloud) -> Evidence:
        result = super().analyse(cloud)
        cloud.count[0, 0] += 1
        return result


class WritesAndRestores(Sound):
    def analyse(self, cloud: Cloud) -> Evidence:
        gone = ~cloud.valid
        cloud.points_m[gone] = 0.0
        cloud.points_m[gone] = np.nan
        return super().analyse(cloud)


class SpoilsEvidence(Sound):
    def quiet_threshold(self, cloud: Cloud, evidence: Evidence) -> float:
        np.nan_to_num(evidence.residual_m, copy=False)
        return super().quiet_threshold(cloud, evidence)


class WeakestFirst(Sound):
    def find(self, cloud: Cloud, evidence: Evidence, threshold: float) -> tuple[Detection, ...]:
        return super().find(cloud, evidence, threshold)[::-1]


class MeanScores(Sound):
    """The mean of a cluster's scores is no threshold at which it vanishes."""

    def find(self, cloud: Cloud, evidence: Evidence, threshold: float) -> tuple[Detection, ...]:
        score = evidence.score.reshape(-1)
        result = [
            replace(detection, score=float(score[detection.pixels].mean()))
            for detection in super().find(cloud, evidence, threshold)
        ]
        return tuple(sorted(result, key=lambda detection: -detection.score))


class NeverQuiet(Sound):
    def quiet_threshold(self, cloud: Cloud, evidence: Evidence) -> float:
        return 0.9 * super().quiet_threshold(cloud, evidence)


class TooQuiet(Sound):
    def quiet_threshold(self, cloud: Cloud, evidence: Evidence) -> float:
        return 1.1 * super().quiet_threshold(cloud, evidence)


class Rings(Sound):
    """Finds pixels in a band above the threshold, so that raising it finds others."""

    def find(self, cloud: Cloud, evidence: Evidence, threshold: float) -> tuple[Detection, ...]:
        band = replace(
            evidence, score=np.where(evidence.score > 1.5 * threshold + 1, np.nan, evidence.score)
        )
        return super().find(cloud, band, threshold)


class Unsorted(Sound):
    def find(self, cloud: Cloud, evidence: Evidence, threshold: float) -> tuple[Detection, ...]:
        return tuple(
            replace(detection, pixels=detection.pixels[::-1])
            for detection in super().find(cloud, evidence, threshold)
        )


class TakesInvalid(Sound):
    def find(self, cloud: Cloud, evidence: Evidence, threshold: float) -> tuple[Detection, ...]:
        gone = np.flatnonzero(~cloud.valid)[:1]
        return tuple(
            replace(detection, pixels=np.union1d(detection.pixels, gone))
            for detection in super().find(cloud, evidence, threshold)
        )


class Beyond(Sound):
    def find(self, cloud: Cloud, evidence: Evidence, threshold: float) -> tuple[Detection, ...]:
        result = super().find(cloud, evidence, threshold)
        return tuple(
            replace(detection, pixels=np.append(detection.pixels, cloud.valid.size))
            for detection in result
        )


class InMillimetres(Sound):
    def find(self, cloud: Cloud, evidence: Evidence, threshold: float) -> tuple[Detection, ...]:
        return tuple(
            replace(detection, centre_m=1e3 * detection.centre_m)
            for detection in super().find(cloud, evidence, threshold)
        )


class NeedsEveryPixel(Sound):
    def analyse(self, cloud: Cloud) -> Evidence:
        if not cloud.valid[:, -1].any():
            raise IndexError("the last column")
        return super().analyse(cloud)


class CrashesOnNothing(Sound):
    def analyse(self, cloud: Cloud) -> Evidence:
        if not cloud.valid.any():
            raise ValueError("zero-size array")
        return super().analyse(cloud)


class JudgesNothing(Sound):
    def analyse(self, cloud: Cloud) -> Evidence:
        if cloud.valid.any():
            return super().analyse(cloud)
        nothing = np.full(cloud.valid.shape, np.nan)
        return Evidence(nothing, nothing, nothing, 1.0)


class CrashesOnOnePoint(Sound):
    def analyse(self, cloud: Cloud) -> Evidence:
        if cloud.valid.sum() == 1:
            raise np.linalg.LinAlgError("singular")
        return super().analyse(cloud)


class NoExtent(Sound):
    def measure(self, cloud: Cloud, evidence: Evidence, detection: Detection) -> Measurement:
        return replace(super().measure(cloud, evidence, detection), extent_diameter_m=np.nan)


class OtherScore(Sound):
    def measure(self, cloud: Cloud, evidence: Evidence, detection: Detection) -> Measurement:
        return replace(super().measure(cloud, evidence, detection), score=0.0)


class Unpicklable(Sound):
    def __init__(self, settings: ScoreMapConfig) -> None:
        super().__init__(settings)
        self.fit: Callable[[float], float] = lambda x: x


class LosesItself(Sound):
    gain = 1.0

    def __init__(self, settings: ScoreMapConfig) -> None:
        super().__init__(settings)
        self.gain = 2.0

    def __getstate__(self) -> dict[str, Any]:
        return {"settings": self.settings}

    def analyse(self, cloud: Cloud) -> Evidence:
        result = super().analyse(cloud)
        return replace(result, score=self.gain * result.score)


class AlongRows(Sound):
    """Looks at neighbours in its row alone."""

    def analyse(self, cloud: Cloud) -> Evidence:
        result = super().analyse(cloud)
        beside = np.fmax(result.score, np.roll(result.score, 1, axis=1))
        return replace(result, score=np.where(cloud.valid, beside, np.nan))


class LooksAtX(Sound):
    def find(self, cloud: Cloud, evidence: Evidence, threshold: float) -> tuple[Detection, ...]:
        result = super().find(cloud, evidence, threshold)
        return tuple(
            replace(detection, centre_m=np.abs(detection.centre_m)) for detection in result
        )


class LooksAtDistance(Sound):
    def analyse(self, cloud: Cloud) -> Evidence:
        result = super().analyse(cloud)
        return replace(result, score=result.score * (cloud.points_m[..., 2] / 0.7) ** 2)


class LearnsAnew(Sound):
    times = 0

    def calibrate(self, hole_free):
        LearnsAnew.times += 1
        return {"times": np.array([LearnsAnew.times])}

    def calibrated(self, learned):
        return self


class LearnsObjects(Sound):
    def calibrate(self, hole_free):
        return {"clouds": np.array([{"clouds": len(hole_free)}])}

    def calibrated(self, learned):
        return self


BROKEN: list[tuple[Callable[..., None], type[Sound], str]] = [
    (checks.declares_itself, NoVersion, "`version` is True"),
    (checks.declares_itself, NoDefaults, "Field required"),
    (checks.declares_itself, StoresWrongly, "stored and read again"),
    (checks.gives_sound_evidence, ScoresInvalid, "pixels without a point have a score"),
    (checks.gives_sound_evidence, OtherShape, "`residual_m` has the shape"),
    (checks.gives_sound_evidence, NoScale, "`scale_m` is 0"),
    (checks.gives_sound_evidence, Infinite, "a score is infinite"),
    (checks.gives_the_same_twice, Restless, "the second time"),
    (checks.gives_the_same_twice, Remembers, "after another cloud"),
    (checks.keeps_its_input, Writes, "`analyse` changed the cloud"),
    (checks.keeps_its_input, WritesAndRestores, "read-only"),
    (checks.keeps_its_input, SpoilsEvidence, "changed the evidence"),
    (checks.orders_findings_by_score, WeakestFirst, "strongest finding is not first"),
    (checks.orders_findings_by_score, MeanScores, "not the threshold at which it vanishes"),
    (checks.is_silent_at_the_quiet_threshold, NeverQuiet, "at the quiet threshold of .* there are"),
    (checks.is_silent_at_the_quiet_threshold, TooQuiet, "just below the quiet threshold"),
    (checks.finds_no_more_at_higher_thresholds, Rings, "adds .* pixels"),
    (checks.finds_valid_pixels, Unsorted, "not in strictly ascending order"),
    (checks.finds_valid_pixels, TakesInvalid, "have no point"),
    (checks.finds_valid_pixels, Beyond, "beyond the cloud's grid"),
    (checks.finds_valid_pixels, InMillimetres, "lies outside the cloud"),
    (checks.survives_missing_pixels, NeedsEveryPixel, "the last column"),
    (
        checks.refuses_an_empty_cloud,
        CrashesOnNothing,
        "0 valid points .* ValueError: zero-size array",
    ),
    (checks.refuses_an_empty_cloud, JudgesNothing, "was not refused"),
    (checks.refuses_an_empty_cloud, CrashesOnOnePoint, "1 valid points .* LinAlgError: singular"),
    (checks.gives_the_same_twice, NoExtent, "`extent_diameter_m` is nan"),
    (checks.gives_the_same_twice, OtherScore, "`measure` gives score 0"),
    (checks.survives_pickling, Unpicklable, "pickle|local object"),
    (checks.survives_pickling, LosesItself, "a detector that was pickled gave another result"),
    (checks.learns_plain_arrays, LearnsAnew, "another learned state"),
    (checks.learns_plain_arrays, LearnsObjects, "allow_pickle"),
    (checks.turns_with_the_cloud, AlongRows, "turned by 90 degrees, a score changed"),
    (checks.turns_with_the_cloud, LooksAtX, "turned by 90 degrees, a finding's centre"),
    (checks.moves_with_the_cloud, LooksAtDistance, "moved by 37 mm, a score changed"),
]


@pytest.mark.parametrize(
    ("check", "kind", "told"), BROKEN, ids=[f"{c.__name__}-{k.__name__}" for c, k, _ in BROKEN]
)
def test_a_detector_that_breaks_the_contract_is_told_how(check, kind, told) -> None:
    def make() -> Sound:
        return kind(ScoreMapConfig())

    cloud = plane(seed=1) if kind is NeedsEveryPixel else CLOUD
    with pytest.raises(Exception, match=told):
        check(make, cloud)


def test_every_check_has_a_detector_that_breaks_it_and_is_run() -> None:
    assert {check for check, _, _ in BROKEN} == set(CHECKS)
    with pytest.raises(
        AssertionError, match="moved by 37 mm, a score changed"
    ) as message:  # the last check
        check_detector(lambda: LooksAtDistance(ScoreMapConfig()), clouds=[CLOUD])
    assert "in moves_with_the_cloud" in message.value.__notes__[0]


class FindsNothing(Sound):
    def analyse(self, cloud: Cloud) -> Evidence:
        result = super().analyse(cloud)
        return replace(result, score=0.0 * result.score)


def test_a_detector_that_finds_nothing_anywhere_was_not_checked() -> None:
    with pytest.raises(AssertionError, match="nothing was found on any cloud"):
        check_detector(FindsNothing)


class NoConfig(Sound):
    settings_type = dict


def test_settings_that_are_no_config_are_told() -> None:
    assert not issubclass(NoConfig.settings_type, Config)
    with pytest.raises(AssertionError, match="no `settings_type`"):
        checks.declares_itself(lambda: NoConfig(ScoreMapConfig()), CLOUD)


# ---------------------------------------------------------------- the kit's own clouds and motions


def test_the_clouds_are_what_an_imager_sees() -> None:
    for cloud in synthetic_clouds():
        valid = cloud.valid
        np.testing.assert_allclose(
            cloud.lens.project(cloud.points_m[valid])[:, 0], np.nonzero(valid)[1], atol=1e-6
        )
        np.testing.assert_allclose(
            cloud.lens.project(cloud.points_m[valid])[:, 1], np.nonzero(valid)[0], atol=1e-6
        )
        assert np.array_equal(valid, cloud.count > 0) and np.array_equal(valid, cloud.reason == 0)


def test_a_turned_cloud_is_what_the_turned_lens_sees() -> None:
    skewed = replace(
        CLOUD.lens, fy=480.0, cx=50.0, distortion=(0.1, -0.02, 1e-3, -2e-3, 0.0, 0.0, 0.0, 0.0)
    )
    slopes = skewed.region_slopes(skewed.whole)
    points = rays_of(slopes) * CLOUD.points_m[..., 2:]
    turned = turned_once(replace(CLOUD, lens=skewed, points_m=points))
    assert turned.valid.shape == CLOUD.valid.shape[::-1] == turned.region.shape
    expected = turned.lens.region_slopes(turned.region)
    result = turned.points_m[..., :2] / turned.points_m[..., 2:]
    np.testing.assert_allclose(result[turned.valid], expected[turned.valid], atol=1e-9)


def test_four_turns_are_none() -> None:
    turned = CLOUD
    for _ in range(4):
        turned = turned_once(turned)
    assert turned.lens == CLOUD.lens and turned.region == CLOUD.region
    np.testing.assert_array_equal(turned.points_m, CLOUD.points_m)


def test_scores_of_a_cluster_are_pixels_above() -> None:
    evidence = Evidence(np.array([[0.5, np.nan, 2.0]]), np.zeros((1, 3)), np.zeros((1, 3)), 1.0)
    np.testing.assert_array_equal(above(evidence, 0.5), [2])
