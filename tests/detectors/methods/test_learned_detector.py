"""The detector with a network: whitened input, the score of a likelihood ratio, both signs, and the
network's file, on whose content results hang."""

from __future__ import annotations

import pickle
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from detectors import load_detector
from detectors.methods.learned import SHIPPED, LearnedConfig, LearnedDetector, seen_by_network
from detectors.methods.network import Layer, Network, read_network, write_network
from harness.testing import check_detector
from harness.testing.synthetic_clouds import plane
from harness.vocabulary.errors import UserError
from harness.vocabulary.geometry import Cloud

PRIOR = -6.0
HOLE = np.s_[40:44, 50:54]
BUMP = np.s_[20:24, 30:34]


def sum_of_nine(path: Path, scale: float = 1.0) -> Path:
    """A network whose log-odds are the prior plus the sum of nine whitened residuals."""
    weights = np.zeros((1, 2, 3), np.float32)
    weights[0, 0] = [scale, 2 * scale, 2 * scale]
    write_network(path, Network((Layer(weights, np.full(1, PRIOR, np.float32), 1),), PRIOR))
    return path


def detector_of(path: Path | None, **settings: object) -> LearnedDetector:
    network = None if path is None else str(path)
    data = {"crop": {"kind": "none"}, "surface": {"degree": 1}, "network": network, **settings}
    loaded = load_detector("learned", data)
    assert isinstance(loaded, LearnedDetector)
    return loaded


def damaged() -> Cloud:
    """A plane with white noise, a hole of 6 deviations and a bump of as many."""
    cloud = plane(seed=3, tilt=0.0, damage=())
    deviation_m = float(np.std(cloud.points_m[..., 2]))
    points_m = cloud.points_m.copy()
    points_m[HOLE][..., 2] += 6 * deviation_m
    points_m[BUMP][..., 2] -= 6 * deviation_m
    return replace(cloud, points_m=points_m)


def test_whitened_noise_is_independent_with_a_deviation_near_1():
    """A square leaves no power at some frequencies; what the floor of the spectrum takes for noise
    there is missing from the deviation of 1."""
    detector = detector_of(None)
    stream = np.random.default_rng(7)
    white = stream.standard_normal((124, 164))
    blurred = sum(white[i : i + 120, j : j + 160] for i in range(5) for j in range(5)) / 25
    weights = np.ones(blurred.shape, np.float32)
    whitened = detector.whitened(1e-3 * blurred, weights, (0.0, 0.0))
    inner = whitened.values[20:-20, 20:-20]
    assert 0.75 < np.std(inner) < 1.05
    beside = np.mean(inner[:, 1:] * inner[:, :-1])
    assert abs(beside) < 0.06
    assert np.corrcoef(blurred[:, 1:].ravel(), blurred[:, :-1].ravel())[0, 1] > 0.7


def test_small_residuals_keep_their_size_and_large_ones_grow_slowly():
    values = np.array([[0.5, -0.5, 400.0]], np.float32)
    is_known = np.array([[True, True, True]])
    pictures = seen_by_network(values, is_known, 1.0)
    np.testing.assert_allclose(pictures[0, 0, :2], [0.5, -0.5], rtol=0.01)
    assert 10.0 < pictures[0, 0, 2] < 30.0
    np.testing.assert_array_equal(seen_by_network(values, is_known, -1.0)[0], -pictures[0])
    hidden = seen_by_network(values, ~is_known, 1.0)
    assert not hidden.any()


def test_a_score_is_the_root_of_twice_the_logarithm_of_the_likelihood_ratio(tmp_path):
    detector = detector_of(sum_of_nine(tmp_path / "n.npz"))
    cloud = damaged()
    evidence = detector.analyse(cloud)
    whitened = detector.whitened(*detector.picture(cloud).residuals)
    inputs = seen_by_network(whitened.values, whitened.is_known, 1.0)[0]
    row, column = 42, 52
    log_ratio = float(inputs[row - 1 : row + 2, column - 1 : column + 2].sum())
    expected = np.sqrt(2 * np.log1p(np.exp(log_ratio)))
    assert evidence.score[row, column] == pytest.approx(expected, rel=0.05)
    assert evidence.score[row, column] <= expected
    assert evidence.score[row, column] > 6.0


def test_what_lies_in_front_is_judged_as_what_lies_behind(tmp_path):
    detector = detector_of(sum_of_nine(tmp_path / "n.npz"))
    cloud = damaged()
    evidence = detector.analyse(cloud)
    detections = detector.find(cloud, evidence, 8.0)
    assert len(detections) == 2
    assert evidence.behind is not None
    assert evidence.behind[HOLE].all()
    assert not evidence.behind[BUMP].any()
    turned = replace(cloud, points_m=cloud.points_m * [1, 1, -1] + [0, 0, 1.4])
    mirrored = detector.analyse(turned)
    np.testing.assert_allclose(mirrored.score, evidence.score, rtol=0.05, atol=0.05)


def test_a_side_lobe_beside_stronger_evidence_is_no_finding(tmp_path):
    """A weaker pixel of the other sign within the reach is none, and farther away it is one."""
    detector = detector_of(sum_of_nine(tmp_path / "n.npz"))
    scores = {}
    for distance in (5, 12):
        residual_m = np.full((60, 60), 1e-9)
        residual_m[30:33, 30:33] = 1e-2
        residual_m[30:33, 30 + distance : 33 + distance] = -7e-3
        noise_m = 1e-3 * np.random.default_rng(8).standard_normal((60, 60))
        weights = np.ones((60, 60), np.float32)
        signed, _, _ = detector.scored(residual_m + noise_m, weights, (0.0, 0.0), 1.0)
        scores[distance] = signed[31, 31 + distance]
        assert signed[31, 31] > 8.0
    assert scores[12] < -5.0
    assert abs(scores[5]) < 0.8 * abs(scores[12])


def test_a_learned_covariance_whitens(tmp_path):
    detector = detector_of(sum_of_nine(tmp_path / "n.npz"))
    learned = detector.calibrate([plane(seed=4, tilt=0.0, damage=())])
    calibrated = detector.calibrated(learned)
    assert isinstance(calibrated, LearnedDetector)
    fourfold = calibrated.calibrated({"covariance": 4 * learned["covariance"]})
    cloud = damaged()
    residuals = detector.picture(cloud).residuals
    inner = np.s_[10:-10, 10:-10]
    half = fourfold.whitened(*residuals).values[inner]
    single = calibrated.whitened(*residuals).values[inner]
    np.testing.assert_allclose(2 * half, single, atol=0.05 * single.max())


def test_the_network_of_another_content_is_refused(tmp_path):
    """A detector that was declared with a network does not judge with another one."""
    path = sum_of_nine(tmp_path / "n.npz")
    detector = detector_of(path)
    detector.analyse(damaged())
    kept = pickle.loads(pickle.dumps(detector))
    sum_of_nine(path, scale=0.5)
    for changed in (detector, kept):
        with pytest.raises(UserError, match="is not the network with the digest"):
            changed.analyse(damaged())
    assert detector_of(path).settings != detector.settings


def test_a_missing_network_is_one_problem_of_the_settings(tmp_path):
    with pytest.raises(UserError, match=r"there is no file .*none\.npz; write one with tofpod"):
        detector_of(tmp_path / "none.npz")


def test_a_network_of_another_shape_is_one_problem_of_the_settings(tmp_path):
    odd = Layer(np.zeros((1, 5, 3), np.float32), np.zeros(1, np.float32), 1)
    write_network(tmp_path / "odd.npz", Network((odd,), PRIOR))
    with pytest.raises(UserError, match=r"layer 0 has weights \(1, 5, 3\)"):
        detector_of(tmp_path / "odd.npz")


def test_it_keeps_the_contract() -> None:
    check_detector(LearnedDetector, settings={"crop": {"kind": "none"}})


def test_the_shipped_network_says_what_it_was_trained_on():
    network = read_network(SHIPPED)
    assert network.weight_count < 100_000
    assert network.facts["experiment"] == "training"
    assert network.facts["content"]
    assert LearnedConfig.from_data({}).digest is not None
