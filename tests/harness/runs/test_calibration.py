"""Sets of thresholds that agree."""

from harness.runs.calibration import _agree


def test_thresholds_agree_within_a_thousandth_at_the_same_points():
    assert _agree({"a": 5.0, "b": 4.0}, {"a": 5.004, "b": 4.0})
    assert not _agree({"a": 5.0, "b": 4.0}, {"a": 5.006, "b": 4.0})
    assert not _agree({"a": 5.0}, {"a": 5.0, "b": 4.0})
