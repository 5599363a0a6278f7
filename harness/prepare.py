"""``python -m harness.prepare``: compile the inner loops once, so that the first sweep need not. Part of the set-up."""

from __future__ import annotations

import argparse
import sys
import time
from contextlib import suppress

from harness.vocabulary.errors import UserError, exit_code_of


def main() -> int:
    """Run the program, which takes no options but --help; returns its exit code."""
    argparse.ArgumentParser(prog="python -m harness.prepare", description="Compile the inner loops once.").parse_args()
    return exit_code_of(_prepare)


def _prepare() -> int:
    """Drive every compiled loop through small captures, and print each step as it begins."""
    from dataclasses import replace

    import numpy as np

    from detectors import load_detector
    from detectors.average import AverageConfig, prefix_averages
    from detectors.interface import Detector, FindsAtOnce
    from detectors.mapping.merge import merge
    from detectors.mapping.settings import FusedMerge, GridMerge
    from detectors.marks.mark import MarkSet
    from detectors.registration.register import register
    from detectors.registration.settings import CpdRegistration, NominalRegistration
    from detectors.views import PreparedView, View
    from harness.engine.averages import FEWEST_FRAMES, averages_of
    from harness.vocabulary.capture import Cloud
    from harness.vocabulary.geometry import Region
    from scenes.closed_form import plane_view
    from scenes.sensor.camera import CameraConfig, camera_names, load_camera
    from scenes.sensor.source import SimulatedUnit

    began = time.perf_counter()

    def step(what: str) -> None:
        print(f"compiling {what} ..", flush=True)

    def inspect(detector: Detector, cloud: Cloud) -> None:
        evidence = detector.analyse(cloud)
        for detection in detector.find(cloud, evidence, detector.quiet_threshold(cloud, evidence) / 2):
            detector.measure(cloud, evidence, detection)

    step("the cameras")
    for name in camera_names():
        view = plane_view(load_camera(name), Region(200, 240, 200, 260), 0.7, 0.6, 0.05, 0.02)
        list(SimulatedUnit(load_camera(name), CameraConfig(name=name), view).capture(1, 1).frames())
    step("averages")
    camera = load_camera("azure_kinect_nfov")
    view = plane_view(camera, Region(300, 340, 300, 360), 0.7, 0.6, 0.05, 0.02)
    view.phasor[:, 18:24, 28:34] *= 1j
    capture = SimulatedUnit(camera, CameraConfig(edge_gate=False), view).capture(6, 1)
    for method in ("mean", "median", "clipped"):
        cloud = prefix_averages(capture, [1, 6], AverageConfig.from_data({"method": method}))[6]
    averages_of(replace(capture, n_frames=FEWEST_FRAMES), [FEWEST_FRAMES], AverageConfig(), exact=False)
    step("surfaces, clusters and the model of a hole")
    for method in ("lar", "bisquare", "least_squares", "lts"):
        inspect(load_detector("thesis", {"crop": {"kind": "none"}, "surface": {"method": method}}), cloud)
    for shape in ("auto", "free_form"):
        load_detector("thesis", {"crop": {"kind": "none"}, "surface": {"shape": shape}}).analyse(cloud)
    step("crops and findings at many thresholds")
    for crop in ({"kind": "auto"}, {"kind": "none"}):
        detector = load_detector("thesis", {"crop": crop})
        with suppress(UserError):  # a capture so small may be no target to the crop, whose loops have run by then
            evidence = detector.analyse(cloud)
            assert isinstance(detector, FindsAtOnce)
            detector.centres_at(cloud, evidence, [1.0, 2.0])
    step("registration and maps")  # one small view stands for two
    nothing = MarkSet((), np.zeros(0, np.int64))
    views = [PreparedView(View(name, cloud, np.eye(4)), cloud.valid, nothing) for name in ("first", "second")]
    register(views, CpdRegistration(points="target", max_iterations=2))
    registrations = register(views, NominalRegistration())
    merge(views, registrations, GridMerge())
    inspect(detector, merge(views, registrations, FusedMerge()).cloud)
    print(f"inner loops compiled in {time.perf_counter() - began:.0f} s")
    return 0


if __name__ == "__main__":
    sys.exit(main())
