"""What renders and trials cost, in seconds and bytes, before they are run.

Told in seconds of a reference machine, from what the declaration says: pixels that the target covers, paths that are
asked for, frames, detectors, damage. `harness.engine.rates` corrects them by what this machine took. Not modelled: what
other programs leave of the machine, and what a detector of a plug-in costs.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from math import pi, sqrt

from harness.engine.averages import FEWEST_FRAMES
from harness.engine.plan import Batch, Group, RenderJob
from harness.experiment.points import Point
from harness.vocabulary.geometry import Region, transform_points
from harness.vocabulary.seeds import canonical_json
from harness.vocabulary.units import MM
from scenes.field_of_view import seen_region
from scenes.render.cache import view_bytes
from scenes.render.view import RIM_PX
from scenes.sensor.camera import CameraConfig, camera_of
from scenes.target.face import outline_board_m

REFERENCE = "another machine (2 cores, November 2026)"
"""Where the numbers below were measured; `tests/validation/cost_rates.py` measures them anew."""

# ---------------------------------------------------------------- renders: seconds on one core
# Least squares over 18 views (three cameras, 0.5 to 1.5 m, thesis board and drawn ones, with and without damage,
# settings of the render one at a time): what was taken is 0.87 to 1.4 times what is told here.
RENDER_PIXEL_S = 9.6e-6
"""Direct light, a pixel of the region."""
RENDER_HOLE_PIXEL_S = 3.8e-4
"""Direct light where footprints are finely divided: a pixel of damage or of its rim."""
FACE_PATH_S = 3.0e-7
"""A path from a node of the face."""
HOLE_PATH_S = 1.7e-7
"""A path from a pixel of damage."""
GOES_ON = 0.8
"""Of paths, the share that meets a further surface at each reflection: the rest leaves the scene."""
FULL_NOISE_MM = 0.1
FULL_SAMPLES = 8192
"""Paths that a pixel of a hole needs for that noise; their number goes with one over its square."""
LINE_OF_PATHS, LINE_OF_DIRECT, FEW_LINES = 0.07, 0.02, 3
"""What each modulation frequency beyond three adds."""

# ---------------------------------------------------------------- trials
FRAME_PIXEL_S: Mapping[str, float] = {"amcw_imager": 1.7e-7, "scanned_lidar": 4.5e-8}
"""A frame drawn and averaged, a pixel, by kind of camera."""
SORT_FRAMES = 15.0
"""A view's pixels are sorted once before averages are drawn at once: as much as so many frames take."""
BLOCK_FRAMES = 1.5
"""A block of 32 frames that are drawn at once, likewise."""
FRAMES_OF_BLOCK = 32
LOAD_BYTE_S = 7e-9
"""A set-up loaded, by bytes of its views."""
POINT_PIXEL_S = 4e-7
"""Crop, surface, finding, judging: for a point, a pixel of the cloud."""
DAMAGE_S = 2.5e-3
"""Measuring and judging one damage, for a point."""
MAP_PIXEL_S = 2e-6
"""Registering and merging, for a point, a pixel of each view."""
AT_ONCE = ("amcw_imager",)
"""Kinds of cameras whose averages can be drawn at once."""
RECORD_BYTES: Mapping[str, tuple[int, int]] = {"study": (550, 2000), "other": (4300, 450)}
"""A record's bytes for a point: without damage, and what each damage adds."""


@dataclass(frozen=True)
class Cost:
    """Of a render or trial: seconds of the reference machine, bytes on the disk, and what the rates call it."""

    seconds: float
    size_bytes: float
    kind: str

    def times(self, count: float) -> Cost:
        """Of so many."""
        return Cost(self.seconds * count, self.size_bytes * count, self.kind)


def render_cost(job: RenderJob) -> Cost:
    """Of a render that the cache lacks."""
    optics = camera_of(job.camera).optics
    region = _region(job)
    lines = len(optics.frequencies_hz)
    more = max(lines - FEW_LINES, 0)
    damaged_px = _damaged_pixels(job)
    config, board = job.config, job.target.board
    spacing = config.face_spacing_mm
    nodes = (int(board.width_mm / spacing) + 2) * (int(board.height_mm / spacing) + 2)
    samples = min(config.hole_samples, FULL_SAMPLES * (FULL_NOISE_MM / config.hole_noise_mm) ** 2)
    direct = RENDER_PIXEL_S * region.shape[0] * region.shape[1] + RENDER_HOLE_PIXEL_S * damaged_px
    paths = FACE_PATH_S * nodes * config.face_samples * _vertices(config.bounces)
    paths += HOLE_PATH_S * damaged_px * samples * _vertices(config.bounces + 1) if config.bounces else 0.0
    seconds = direct * (1 + LINE_OF_DIRECT * more) + paths * (1 + LINE_OF_PATHS * more)
    return Cost(seconds, view_bytes(region, lines), kind_of(job.camera))


def trial_cost(group: Group, batch: Batch, jobs: int) -> Cost:
    """Of one trial of a batch, on average over its repeats, where ``jobs`` processes each load its set-up once."""
    most = max(group.most_repeats(batch), 1)
    points = [point for point in group.points if group.repeats(batch, point)]
    share = sum(group.repeats(batch, point) for point in points) / (most * max(len(points), 1))
    distinct = {_what_is_done(point): point for point in points}.values()
    regions = [_region(view.render) for view in batch.views]
    pixels = [region.shape[0] * region.shape[1] for region in regions]
    lines = len(camera_of(batch.views[0].render.camera).optics.frequencies_hz)
    kind = kind_of(batch.views[0].render.camera)
    counts = {point.config.capture.frames for point in points}
    whole = kind not in AT_ONCE or all(_is_exact(point) for point in points)
    one_by_one = {count for count in counts if whole or count < FEWEST_FRAMES}
    together = counts - one_by_one
    exact, loads = not together, min(jobs, most) / most
    frames: float = max(one_by_one, default=0) + len(one_by_one)
    if together:
        blocks = len(together) + max(together) // FRAMES_OF_BLOCK
        frames += BLOCK_FRAMES * blocks + SORT_FRAMES * loads
    seconds = FRAME_PIXEL_S.get(kind, FRAME_PIXEL_S["amcw_imager"]) * frames * sum(pixels)
    seconds += LOAD_BYTE_S * sum(view_bytes(one, lines) for one in regions) * loads
    damages = len(batch.views[0].set_up.target.damages) if batch.role == "damaged" else 0
    for point in distinct:
        mapped = point.config.mapping
        seconds += share * (POINT_PIXEL_S * pixels[0] + DAMAGE_S * damages)
        if mapped is not None:
            seconds += share * MAP_PIXEL_S * sum(pixels[: mapped.views])
    empty, each = RECORD_BYTES["study" if group.is_study else "other"]
    maps = any(point.config.mapping is not None for point in points)
    name = f"{kind}, {'frame by frame' if exact else 'drawn at once'}" + (", maps" if maps else "")
    return Cost(seconds, share * len(points) * (empty + each * damages), name)


def kind_of(camera: CameraConfig) -> str:
    """The kind of a camera, whose units cost alike."""
    return str(camera_of(camera).kind)


def _vertices(most: int) -> float:
    """Vertices of a path with at most so many, on average, in units of an endless path's."""
    return 1 - GOES_ON**most


def _region(job: RenderJob) -> Region:
    """What `scenes.render.view.target_region` finds, without building the target's mesh."""
    optics = camera_of(job.camera).optics
    outline = transform_points(job.target.pose.T_camera_board, outline_board_m(job.target.board))
    return seen_region(outline, optics).grown(RIM_PX + optics.margin_px, optics.lens.height, optics.lens.width)


def _damaged_pixels(job: RenderJob) -> float:
    """Pixels of damage and, one wide, of its rims."""
    lens = camera_of(job.camera).optics.lens
    pitch_mm = float(job.target.pose.T_camera_board[2, 3]) / sqrt(lens.fx * lens.fy) / MM
    diameters = [damage.diameter_mm / pitch_mm for damage in job.target.damages]
    return sum(pi / 4 * d**2 + pi * d for d in diameters)


def _what_is_done(point: Point) -> str:
    """Points that come to the same share the work, but for their thresholds."""
    config = point.config
    mapping = None if config.mapping is None else config.mapping.to_data()
    return canonical_json([config.capture.to_data(), config.detector.to_data(), mapping])


def _is_exact(point: Point) -> bool:
    """Whether the frames of a point's average are drawn one by one."""
    capture = point.config.capture
    return capture.exact or capture.average.method != "mean"
