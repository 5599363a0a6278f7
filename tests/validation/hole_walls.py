"""How deep the holes of a drilled plate look, by what their walls are like: ``python
tests/validation/hole_walls.py [FOLDER]``.

The plate is that of ``experiments/plate.yaml``. Each hole is rendered alone, on its own pixels of
the whole plate, with walls of another reflectance than the face. Frames are simulated and analysed
as by ``tofpod validate --board plate``. FOLDER holds the capture (``depth`` and
``intrinsic.json``); its pixels are those of the comparison. Prints the mean peaks and their
standard errors by angle off the axis, in mm. Nothing is fitted: all kinds of wall are shown.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import trimesh

from detectors.averages.average import AverageConfig, average
from harness.experiment.load import load_experiment
from harness.inspection.arguments import opened
from harness.programs.scorecard.board import ANGLES_DEG, Image, angles_deg, image_of, measured
from harness.vocabulary.geometry import MM, Region, transform_points
from scenes.optics import NoiseFreeView, RenderConfig
from scenes.render.face import face_triangles
from scenes.render.scene import load_mitsuba
from scenes.render.view import render_view
from scenes.sensor.camera import camera_of
from scenes.sensor.source import SimulatedUnit
from scenes.target.custom import HoleConfig, TargetConfig
from scenes.target.mesh import Target, TargetPart, build_target

FRAMES = 17
AROUND_MM = 1.0
AROUND_PX = 2
"""A hole's pixels reach so far beyond its mouth."""
EFFORT = RenderConfig(bounces=10, face_samples=4096, hole_noise_mm=0.4, hole_samples=4096)
"""Bright walls send light to and fro: after four reflections a fifth of a peak is missing."""
PER_PIXEL = (
    "phasor",
    "phasor_direct",
    "intensity",
    "indirect_noise_m",
    "range_m",
    "surface",
    "coverage",
    "rgb",
)
"""Fields of a view that have a value for each pixel, on the last two axes but for ``rgb``."""


@dataclass(frozen=True)
class Walls:
    """Holes 4.9 mm wide, and the reflectance of their walls and bottoms."""

    name: str
    albedo: float
    gloss: tuple[float, float] = (0.0, 1.0)
    """Share and exponent of a Phong lobe."""
    depth_mm: float | None = None
    """Depth of a blind hole; None for a through-hole."""
    chamfer_mm: float = 0.0
    face_albedo: float = 0.5


KINDS = (
    Walls(
        name="as the face",
        albedo=0.5,
    ),
    Walls(
        name="blind, mirrors 82 % within 13 degrees",
        albedo=0.85,
        gloss=(0.82, 100.0),
        depth_mm=11.0,
    ),
    Walls(
        name="matte metal, 90 %",
        albedo=0.9,
    ),
    Walls(
        name="blind, matte metal, 90 %",
        albedo=0.9,
        depth_mm=11.0,
    ),
    Walls(
        name="matte metal, 70 %, chamfer 0.5 mm",
        albedo=0.7,
        chamfer_mm=0.5,
    ),
    Walls(
        name="matte metal, 90 %, chamfer 0.5 mm, face 25 %",
        albedo=0.9,
        chamfer_mm=0.5,
        face_albedo=0.25,
    ),
)


class Plate:
    """The declared plate before its camera, on the pixels of a capture or of the camera."""

    def __init__(self, folder: Path | None) -> None:
        self.point = load_experiment(Path("plate")).at_stated_values().points[0]
        self.source = self.point.config.simulated
        target = self.source.target
        assert isinstance(target, TargetConfig)
        self.target = target.model_copy(update={"drill": None})
        self.camera = camera_of(self.source.camera)
        self.recording = None
        if folder is not None:
            self.recording = opened([folder / "depth"], str(folder / "intrinsic.json"))
        lens = self.recording.lens if self.recording else None
        self.image: Image = image_of(self.target, self.camera, lens)

    def captured_m(self) -> np.ndarray:
        """Return the frames (n, h, w) of the capture without those that are displaced."""
        assert self.recording is not None
        left_out = {frame.name for frame in average(self.recording, AverageConfig()).left_out}
        frames = [frame.z_m for frame in self.recording.frames() if frame.name not in left_out]
        return np.stack(frames).astype(float)

    def simulated_m(self, walls: Walls) -> np.ndarray:
        """Return simulated frames (n, h, w) of the plate with such holes."""
        material = self.target.material.model_copy(update={"albedo_850": walls.face_albedo})
        plate = self.target.model_copy(update={"material": material})
        bare = build_target(plate.hole_free())
        view = render_view(bare, self.camera.optics, EFFORT)
        for hole in plate.holes:
            drilled = HoleConfig(
                id=hole.id,
                centre_mm=hole.centre_mm,
                diameter_mm=4.9,
                kind="through" if walls.depth_mm is None else "blind",
                depth_mm=walls.depth_mm,
                chamfer_mm=walls.chamfer_mm,
            )
            region = self._pixels_of(drilled, view.region)
            if region is not None:
                alone = build_target(plate.model_copy(update={"holes": (drilled,)}))
                target = with_walls(alone, walls)
                put_into(view, render_view(target, self.camera.optics, EFFORT, region))
        unit = SimulatedUnit(self.camera, self.source.camera, view)
        z_m = np.full((FRAMES, *self.camera.nominal_lens.whole.shape), np.nan)
        cut = unit.region.within(self.camera.nominal_lens.whole)
        capture = unit.capture(FRAMES, self.point.config.seed, "board")
        for number, frame in enumerate(capture.frames()):
            z_m[number, *cut] = frame.z_m
        if self.recording is None:
            return z_m
        return self.image.resampled(z_m, self.camera)

    def _pixels_of(self, hole: HoleConfig, outer: Region) -> Region | None:
        """Return the pixels on which a hole lies; None if it is out of view."""
        lens = self.camera.nominal_lens
        angle = np.linspace(0.0, 2 * np.pi, 48)
        circle = np.column_stack([np.cos(angle), np.sin(angle), np.zeros(48)])
        rim = [*hole.centre_m, 0.0] + (hole.reach_mm + AROUND_MM) * MM * circle
        rim_m = transform_points(self.target.pose.T_camera_board, rim)
        if not lens.images(rim_m).all():
            return None
        pixels = lens.project(rim_m)
        left, top = np.floor(pixels.min(axis=0)).astype(int).tolist()
        right, bottom = np.ceil(pixels.max(axis=0)).astype(int).tolist()
        region = Region(top, bottom + 1, left, right + 1)
        return region.grown(AROUND_PX, outer.row1, outer.col1)

    def line(self, name: str, z_m: np.ndarray) -> str:
        """Return a line with the peaks of frames."""
        _, peaks_mm = measured(z_m, self.image, self.target, self.point.config, {})
        angles = angles_deg(self.target)
        parts = []
        for low, high in pairwise(ANGLES_DEG):
            chosen = peaks_mm[(angles >= low) & (angles < high) & np.isfinite(peaks_mm)]
            error = chosen.std(ddof=1) / np.sqrt(len(chosen))
            parts.append(f"{chosen.mean():5.2f} +- {error:.2f}")
        return f"{name:48}{'   '.join(parts)}"


def with_walls(target: Target, walls: Walls) -> Target:
    """Return a target whose board reflects as declared on its face alone, and like the walls
    elsewhere."""
    board = target.parts[0]
    on_face = face_triangles(target)[0]
    meshes = []
    for chosen in (on_face, ~on_face):
        faces = board.mesh.faces[chosen]
        meshes.append(trimesh.Trimesh(board.mesh.vertices, faces, process=False))
    drilled = TargetPart(
        name="walls",
        mesh=meshes[1],
        albedo_850=walls.albedo,
        rgb=np.full(3, walls.albedo),
        gloss=walls.gloss,
    )
    return replace(target, parts=(replace(board, mesh=meshes[0]), *target.parts[1:], drilled))


def put_into(view: NoiseFreeView, part: NoiseFreeView) -> None:
    """Replace the light of a view in the region of another, in place."""
    rows, columns = part.region.within(view.region)
    for name in PER_PIXEL:
        values = getattr(view, name)
        if name.startswith("phasor"):
            values[:, rows, columns] = getattr(part, name)
        else:
            values[rows, columns] = getattr(part, name)


def main(arguments: list[str]) -> int:
    """Print a line for the capture, if it is given, and for each kind of wall."""
    load_mitsuba()
    plate = Plate(Path(arguments[0]) if arguments else None)
    bands = [f"{low} to {high} deg" for low, high in pairwise(ANGLES_DEG)]
    print(f"{'':48}{'    '.join(bands)}")
    if plate.recording is not None:
        print(plate.line("capture", plate.captured_m()))
    for walls in KINDS:
        print(plate.line(walls.name, plate.simulated_m(walls)), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
