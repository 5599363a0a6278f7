"""``tofpod prepare``: compiles the inner loops once, as part of the installation."""

import argparse
import time
from contextlib import suppress

from harness.vocabulary.errors import UserError
from harness.vocabulary.program import program


@program(lambda parser: None, "Compile the inner loops once.", "tofpod prepare")
def main(options: argparse.Namespace, command: str) -> int:
    """Run the loops of single views on small captures, in two processes; map loops compile at
    first use. Returns 0."""
    from harness.runs.processes import PROCESSES

    began = time.perf_counter()
    print("compiling the cameras, averages, surfaces and crops, in two processes ..", flush=True)
    with PROCESSES.Pool(2) as pool:
        for done in [pool.apply_async(part) for part in (analyse, draw_frames)]:
            done.get()
    print(f"inner loops compiled in {time.perf_counter() - began:.0f} s")
    return 0


def draw_frames() -> None:
    """Draw a frame with every camera, and average frames with every method."""
    import numpy as np

    from detectors.averages.average import AverageConfig, prefix_averages
    from harness.vocabulary.geometry import Region
    from harness.vocabulary.seeds import random_stream
    from scenes.closed_form import plane_view
    from scenes.sensor.camera import camera_names, load_camera
    from scenes.sensor.common.config import CameraConfig
    from scenes.sensor.empirical.imager import decode
    from scenes.sensor.source import SimulatedUnit

    for name in camera_names():
        camera = load_camera(name)
        row = int(camera.nominal_lens.cy)
        column = int(camera.nominal_lens.cx)
        view = plane_view(
            camera, Region(row - 20, row + 20, column - 30, column + 30), 0.7, 0.6, 0.05, 0.02
        )
        unit = SimulatedUnit(camera, CameraConfig(name=name), view)
        capture = unit.capture(6, 1)
        next(iter(capture.frames()))
        # pixels that may saturate are drawn sample by sample, like all those of a whole frame
        unit.model.frame(unit.exposure, random_stream(1))
    # no camera's file is empirical
    image = np.ones((2, 2), np.float32)
    number = np.float32(1)
    decode(*6 * (image,), *4 * (number,), image.copy(), image.astype(np.uint8))
    for method in ("mean", "median", "clipped"):
        prefix_averages(capture, [1, 6], AverageConfig.from_data({"method": method}))


def analyse() -> None:
    """Average frames, and search for damage on every kind of surface."""
    import numpy as np

    from detectors import load_detector
    from detectors.averages.average import AverageConfig, average
    from harness.vocabulary.geometry import Region
    from scenes.closed_form import plane_view
    from scenes.sensor.camera import load_camera
    from scenes.sensor.common.config import CameraConfig
    from scenes.sensor.source import SimulatedUnit

    camera = load_camera("azure_kinect_nfov")
    view = plane_view(camera, Region(300, 340, 300, 360), 0.7, 0.6, 0.05, 0.02)
    # so shallow that all of its pixels have a range, and the model of a hole is fitted
    view.phasor[:, 18:24, 28:34] *= np.exp(0.1j)
    unit = SimulatedUnit(camera, CameraConfig(edge_gate=False), view)
    cloud = average(unit.capture(3, 1), AverageConfig())
    # pixels at the rim of a deep hole are simulated one by one
    view.phasor[:, 18:24, 28:34] *= 1j
    deep = SimulatedUnit(camera, CameraConfig(), view)
    average(deep.capture(3, 1), AverageConfig())
    surfaces = [{"method": method} for method in ("lar", "bisquare", "least_squares", "lts")]
    surfaces += [{"shape": shape} for shape in ("auto", "free_form")]
    wanted = [
        {"crop": {"kind": "auto"}},
        *({"crop": {"kind": "none"}, "surface": surface} for surface in surfaces),
    ]
    for name, settings in (("matched", wanted[1]), *(("thesis", surface) for surface in wanted)):
        detector = load_detector(name, settings)
        with suppress(
            UserError
        ):  # the crop may find no target in so small a capture, but its loops have run by then
            evidence = detector.analyse(cloud)
            for detection in detector.find(
                cloud, evidence, detector.quiet_threshold(cloud, evidence) / 2
            ):
                detector.measure(cloud, evidence, detection)


if __name__ == "__main__":
    raise SystemExit(main())
