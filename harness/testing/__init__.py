"""The contract of detectors as checks for a plug-in author's own tests.

    from harness.testing import check_detector
    from acme.detector import AcmeDetector


    def test_my_detector_keeps_the_contract():
        check_detector(AcmeDetector, settings={"window_px": 7})

Every check is a function of its own in `harness.testing.checks` and `harness.testing.motion`, listed in `CHECKS`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from detectors.interface import Detector
from harness.testing import checks, motion
from harness.testing.clouds import synthetic_clouds
from harness.testing.contract import broken, made_by
from harness.vocabulary.capture import Cloud

CHECKS = (
    checks.declares_itself,
    checks.gives_sound_evidence,
    checks.gives_the_same_twice,
    checks.keeps_its_input,
    checks.orders_findings_by_score,
    checks.is_silent_at_the_quiet_threshold,
    checks.finds_no_more_at_higher_thresholds,
    checks.finds_valid_pixels,
    checks.survives_missing_pixels,
    checks.refuses_an_empty_cloud,
    checks.measures_extents,
    checks.survives_pickling,
    motion.turns_with_the_cloud,
    motion.moves_with_the_cloud,
)
"""Each takes a function that makes the detector, and a cloud; each raises AssertionError with what it saw."""


def check_detector(
    make: Callable[[], Detector] | type,
    *,
    settings: Mapping[str, Any] | None = None,
    clouds: Sequence[Cloud] | None = None,
) -> None:
    """Run every check on every cloud. Raises AssertionError where the contract of `detectors.interface` is broken.

    ``make``: a detector's class, whose ``settings`` (plain data, as YAML holds it) are then validated by its
    ``settings_type``; or a function without arguments that makes a detector anew at each call. ``clouds``: what it is
    checked on, by default three small synthetic ones 0.7 m before the camera, within 90 mm of its axis, each with
    damage of centimetres (`harness.testing.clouds`). Something must be found on one of them at least, at any
    threshold, or nothing would have been checked.

    Not checked: whether the detector is any good, which is what a study measures.
    """
    maker = made_by(make, settings)
    tried = tuple(synthetic_clouds() if clouds is None else clouds)
    for check in CHECKS:
        for cloud in tried:
            check(maker, cloud)
    detector = maker()
    if not any(detector.quiet_threshold(cloud, detector.analyse(cloud)) > 0 for cloud in tried):
        raise broken("nothing was found on any cloud at any threshold, so that next to nothing was checked")
