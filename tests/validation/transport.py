"""What is left of the light transport's error, and what it costs: ``python
tests/validation/transport.py``.

The thesis target at 0.7 m before the Azure Kinect, in a room with floor and back wall. Each view
is rendered as an experiment would, and compared in range (frequencies fused by least squares) with
a reference that knows neither nodes on the face nor a budget: paths of up to 24 reflections
through 32 x 32 sub-rays of every compared pixel. Then mitransient's ``transient_path`` renders the
hole-free board at a number of paths that it can afford; its variance is extrapolated by 1/n to our
error. Prints Markdown tables.
"""

from __future__ import annotations

import argparse
import sys
import time
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy import ndimage

if __name__ == "__main__":
    sys.path[:0] = [str(Path(__file__).resolve().parents[2])]

from harness.vocabulary.geometry import MM, Lens, rays_of
from scenes.optics import NoiseFreeView, Optics, Quadrilaterals, RenderConfig, wave_numbers
from scenes.render.direct import OffFace, cast
from scenes.render.indirect import PathWork, gather_in_pixels
from scenes.render.range_noise import range_change_m, range_noise_m
from scenes.render.scene import LitScene, lit_scene, load_mitsuba
from scenes.render.view import render_view
from scenes.sensor.camera import load_camera
from scenes.target.mesh import Target, build_target
from scenes.target.thesis import ThesisTargetConfig

SIDE = 32
"""Sub-rays per side of a pixel in the reference."""
LONGEST = 24
"""Reflections of the reference's paths; those of experiments have RenderConfig's."""
FACE_TIMES = 8
"""Paths of the reference on the face for one in a hole: they leave the scene soon, and the error
is small."""
AMPLITUDE_GATE = 0.03
"""Of a plane of albedo 1 at 1 m: 35 electrons of the Azure Kinect's 1168, above the noise of one
frame."""
FILTER_PIXELS = 25
"""Pixels under the camera's 5 x 5 window, if its weights were all equal: more than mitransient can
be credited with."""


@dataclass(frozen=True)
class Error:
    """Error of range over some pixels against the reference."""

    title: str
    """Which pixels."""
    pixels: int
    """Their number."""
    rms_mm: float
    """Root mean square, the reference's own noise taken off."""
    mean_mm: float
    """Mean."""
    mean_error_mm: float
    """Standard error of the mean."""
    reported_mm: float
    """Noise that the render reports."""
    reference_mm: float
    """Noise of the reference."""

    def row(self) -> str:
        mean = f"{self.mean_mm:+.4f} +- {self.mean_error_mm:.4f}"
        return (
            f"| {self.title} | {self.pixels} | **{self.rms_mm:.4f}** | {mean} | "
            f"{self.reported_mm:.4f} | {self.reference_mm:.4f} |"
        )


@dataclass(frozen=True)
class Scene:
    """A target that was rendered."""

    target: Target
    optics: Optics
    lit: LitScene
    view: NoiseFreeView
    wall_s: float
    """Seconds that it took."""
    cpu_s: float
    """Processor seconds of all cores together."""


def rendered(facts: dict[str, Any], *, holes: bool = True) -> Scene:
    """The thesis target rendered twice; the second, with warm kernels, counts."""
    declared = ThesisTargetConfig.from_data({"name": "thesis", **facts}).declare()
    target = build_target(declared if holes else declared.hole_free())
    optics = load_camera("azure_kinect_nfov").optics
    config = RenderConfig()
    render_view(target, optics, config)
    (view, cpu_s), wall_s = _timed(lambda: _cpu(lambda: render_view(target, optics, config)))
    return Scene(
        target,
        optics,
        lit_scene(load_mitsuba(), target.parts, optics),
        view,
        wall_s,
        cpu_s,
    )


def compared(
    scene: Scene,
    title: str,
    mask: np.ndarray,
    paths: int,
    most: int,
) -> Error:
    """The render against the reference over (at most so many, evenly picked) pixels of a mask (h,
    w)."""
    rows, cols = np.nonzero(mask)
    picked = slice(None, None, max(len(rows) // most, 1))
    rows = rows[picked]
    cols = cols[picked]
    frequencies = scene.optics.frequencies_hz
    footprint = Quadrilaterals(scene.optics.lens, scene.view.region)
    slopes = footprint.slopes(rows, cols, footprint.grid(SIDE))
    hits = cast(scene.lit, slopes.reshape(-1, 2))
    turned = hits.amplitude * np.exp(1j * wave_numbers(frequencies)[:, None] * hits.path_m)
    direct = turned.reshape(len(frequencies), -1, SIDE**2).mean(axis=-1)
    count = np.full(len(rows), SIDE**2)
    rays = OffFace(
        np.arange(len(rows)), count, np.ones(len(rows)), slopes.reshape(-1, 2).astype(np.float32)
    )
    light = gather_in_pixels(scene.lit, rays, PathWork(frequencies, LONGEST, seed=777), paths)
    total = direct + light.mean(axis=0, dtype=complex)[:-1]
    reference_m = range_noise_m(light[:, :-1], total, frequencies)
    error_m = range_change_m(
        scene.view.phasor[:, rows, cols].astype(complex) - total, total, frequencies
    )
    rms_m = np.sqrt(max((error_m**2).mean() - (reference_m**2).mean(), 0.0))
    return Error(
        title=title,
        pixels=len(rows),
        rms_mm=rms_m / MM,
        mean_mm=error_m.mean() / MM,
        mean_error_mm=error_m.std() / np.sqrt(len(rows)) / MM,
        reported_mm=float(np.sqrt((scene.view.indirect_noise_m[rows, cols] ** 2).mean())) / MM,
        reference_mm=float(np.sqrt((reference_m**2).mean())) / MM,
    )


def in_holes(scene: Scene) -> np.ndarray:
    """(h, w): pixels whose central ray goes through a hole's mouth."""
    rays = rays_of(scene.view.slopes)
    normal = scene.target.T_camera_board[:3, 2]
    middle = scene.target.T_camera_board[:3, 3]
    on_plane = rays * ((middle @ normal) / (rays @ normal))[..., None]
    masks = []
    for hole in scene.target.truth:
        off_axis_m = np.linalg.norm(on_plane - hole.centre_camera_m, axis=-1)
        masks.append(off_axis_m < hole.diameter_m / 2)
    return np.any(masks, axis=0)


def face_parts(scene: Scene) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Masks (h, w) of a hole-free board: whole pixels of one surface, pixels at edges of tape,
    pixels on its rim."""
    names = scene.view.surface_names
    on_board = [k for k, name in enumerate(names) if name == "board" or "tape" in name]
    board = np.isin(scene.view.surface, on_board)
    is_whole = scene.view.coverage == 1
    inner = ndimage.binary_erosion(board, np.ones((3, 3), bool), iterations=2)
    return board & is_whole & inner, board & ~is_whole & inner, board & ~inner


@dataclass(frozen=True)
class Rival:
    """mitransient on the same board: noise of range of a pixel at ``paths`` each, and what that
    took."""

    paths: int
    noise_mm: float
    cpu_s: float
    wall_s: float


def rival(
    scene: Scene,
    paths: int,
    runs: int = 8,
) -> Rival:
    """Spread of mitransient's range over seeds, on whole pixels of the board, by a lens as wide as
    the region."""
    from transport_oracle import oracle

    view = scene.view
    lens = scene.optics.lens
    h, w = view.range_m.shape
    narrow = Lens(
        w,
        h,
        lens.fx,
        lens.fx,
        (w - 1) / 2,
        (h - 1) / 2,
    )
    optics = replace(scene.optics, lens=narrow)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        tracer = oracle(scene.lit, optics, optics.frequencies_hz)
        bounces = RenderConfig().bounces
        tracer.phasors(paths, 0, bounces)
        seeds = range(1, runs + 1)
        (phasors, cpu_s), wall_s = _timed(
            lambda: _cpu(lambda: np.stack([tracer.phasors(paths, s, bounces) for s in seeds]))
        )
    middle = phasors[:, :, h // 4 : -h // 4, w // 8 : -w // 8].reshape(
        runs, len(optics.frequencies_hz), -1
    )
    mean = middle.mean(axis=0)
    spread_m = range_change_m(middle - mean, mean, optics.frequencies_hz)
    return Rival(
        paths,
        float(np.sqrt((spread_m**2).sum(axis=0).mean() / (runs - 1))) / MM,
        cpu_s / runs,
        wall_s / runs,
    )


def _timed(work: Callable[[], Any]) -> tuple[Any, float]:
    began = time.perf_counter()
    return work(), time.perf_counter() - began


def _cpu(work: Callable[[], Any]) -> tuple[Any, float]:
    began = time.process_time()
    return work(), time.process_time() - began


def errors(
    free: Scene,
    holed: dict[str, Scene],
    paths: int,
    most: int,
) -> list[Error]:
    """The table of errors: parts of the hole-free face, then the holes of each kind."""
    titles = ("face, whole pixels", "face, edges of tape", "face, outermost pixels")
    face_paths = FACE_TIMES * paths
    rows = [
        compared(free, title, mask, face_paths, most)
        for title, mask in zip(titles, face_parts(free), strict=True)
    ]
    for title, scene in holed.items():
        inside = in_holes(scene)
        lit = inside & (np.abs(scene.view.phasor).mean(axis=0) > AMPLITUDE_GATE)
        rows.append(compared(scene, f"holes, {title}", inside, paths, most))
        if lit.sum() < inside.sum():
            rows.append(compared(scene, f"holes, {title}, above the gate", lit, paths, most))
    return rows


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the tables."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--paths",
        type=int,
        default=1 << 16,
        help="of each pixel in holes in the reference, an eighth of those on the face",
    )
    parser.add_argument(
        "--pixels",
        type=int,
        default=300,
        help="compared of each kind at most",
    )
    parser.add_argument(
        "--rival-paths",
        type=int,
        default=64,
        help="of each pixel by mitransient",
    )
    options = parser.parse_args(arguments)
    load_mitsuba()
    free = rendered({}, holes=False)
    holed = {
        "blind": rendered({"hole_kind": "blind"}),
        "backing at 20 mm": rendered({}),
        "backing at 50 mm": rendered({"backing_distance_mm": 50.0}),
    }
    print(
        "| where | pixels | error, mm rms | mean error, mm | reported noise, mm | "
        "reference's noise, mm |"
    )
    print("|---|---|---|---|---|---|")
    table = errors(free, holed, options.paths, options.pixels)
    print("\n".join(row.row() for row in table))
    print("\n| view | seconds | processor seconds |\n|---|---|---|")
    for title, scene in {"hole-free": free, **holed}.items():
        print(f"| {title} | {scene.wall_s:.2f} | {scene.cpu_s:.2f} |")
    tracer = rival(free, options.rival_paths)
    ours_mm = table[0].rms_mm
    needed = tracer.paths * (tracer.noise_mm / ours_mm) ** 2
    cpu_s = tracer.cpu_s * needed / tracer.paths
    print(
        f"\nmitransient: {tracer.paths} paths a pixel leave {tracer.noise_mm:.3f} mm "
        f"in {tracer.cpu_s:.2f} processor s"
    )
    print(
        f"({tracer.wall_s:.2f} s); our {ours_mm:.4f} mm would take {needed:.3g} paths, "
        f"{cpu_s:.3g} processor s by 1/n:"
    )
    print(
        f"{cpu_s / free.cpu_s:.0f} times ours, "
        f"{cpu_s / free.cpu_s / FILTER_PIXELS:.0f} with the filter credited."
    )
    return 0


if __name__ == "__main__":
    sys.exit(main())
