"""The costs of renders and trials before they run, in seconds and bytes.

Seconds are those of a reference machine, computed from the declaration: pixels that the target covers, paths, frames,
detectors, damage. Rates that are learnt from each run and kept beside the cache correct them for this machine, so that
a model that is off, faster code or a graphics processor are accounted for after the first run. Not modelled: other
programs that use the machine, and the cost of a plug-in's detector.
"""

from __future__ import annotations

import contextlib
import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from math import isfinite, pi, sqrt
from pathlib import Path
from typing import Any, Literal

from harness.engine.averages import FEWEST_FRAMES
from harness.engine.journal import Journal
from harness.engine.plan import Batch, Group, RenderJob, SweepPlan
from harness.engine.work import Outcome
from harness.vocabulary.errors import UserError
from harness.vocabulary.files import write_text
from harness.vocabulary.geometry import Region, transform_points
from harness.vocabulary.json_text import strict_json
from harness.vocabulary.limits import TEXT_BYTES, bounded_bytes
from harness.vocabulary.seeds import canonical_json
from harness.vocabulary.units import MM
from scenes.field_of_view import seen_region
from scenes.render.cache import view_bytes
from scenes.render.view import RIM_PX
from scenes.sensor.camera import CameraConfig, camera_of
from scenes.target.face import outline_board_m

REFERENCE = "another machine (2 cores, November 2026)"
"""The machine on which the numbers below were measured; `tests/validation/cost_rates.py` measures them anew."""

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
"""Share of paths that meet a further surface at each reflection: the rest leaves the scene."""
FULL_NOISE_MM = 0.1
FULL_SAMPLES = 8192
"""Paths that a pixel of a hole needs for that noise; their number goes with one over its square."""
LINE_OF_PATHS, LINE_OF_DIRECT, FEW_LINES = 0.07, 0.02, 3
"""Share that each modulation frequency beyond three adds."""

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
class WorkCost:
    """Cost of a render or trial: seconds of the reference machine, bytes on the disk, and the rates' name."""

    seconds: float
    size_bytes: float
    kind: str

    def times(self, count: float) -> WorkCost:
        """The cost of ``count`` of them."""
        return WorkCost(self.seconds * count, self.size_bytes * count, self.kind)


def render_cost(job: RenderJob) -> WorkCost:
    """Cost of a render that the cache lacks."""
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
    return WorkCost(seconds, view_bytes(region, lines), kind_of(job.camera))


def trial_cost(group: Group, batch: Batch, jobs: int) -> WorkCost:
    """Cost of a trial of a batch, on average over its repeats, where ``jobs`` processes each load its set-up once."""
    most = max(group.most_repeats(batch), 1)
    points = [point for point in group.points if group.repeats(batch, point)]
    share = sum(group.repeats(batch, point) for point in points) / (most * max(len(points), 1))
    # points that come to the same share the work, but for their thresholds
    distinct = {
        canonical_json([one.capture.to_data(), one.detector.to_data(), one.mapping and one.mapping.to_data()]): point
        for point, one in ((point, point.config) for point in points)
    }.values()
    regions = [_region(job) for job in batch.renders]
    pixels = [region.shape[0] * region.shape[1] for region in regions]
    lines = len(camera_of(batch.renders[0].camera).optics.frequencies_hz)
    kind = kind_of(batch.renders[0].camera)
    counts = {point.config.capture.frames for point in points}
    whole = kind not in AT_ONCE or all(
        point.config.capture.exact or point.config.capture.average.method != "mean" for point in points
    )
    one_by_one = {count for count in counts if whole or count < FEWEST_FRAMES}
    together = counts - one_by_one
    exact, loads = not together, min(jobs, most) / most
    frames: float = max(one_by_one, default=0) + len(one_by_one)
    if together:
        blocks = len(together) + max(together) // FRAMES_OF_BLOCK
        frames += BLOCK_FRAMES * blocks + SORT_FRAMES * loads
    seconds = FRAME_PIXEL_S.get(kind, FRAME_PIXEL_S["amcw_imager"]) * frames * sum(pixels)
    seconds += LOAD_BYTE_S * sum(view_bytes(one, lines) for one in regions) * loads
    damages = len(batch.set_ups[0].target.damages) if batch.role == "damaged" else 0
    for point in distinct:
        mapped = point.config.mapping
        seconds += share * (POINT_PIXEL_S * pixels[0] + DAMAGE_S * damages)
        if mapped is not None:
            seconds += share * MAP_PIXEL_S * sum(pixels[: mapped.views])
    empty, each = RECORD_BYTES["study" if group.is_study else "other"]
    maps = any(point.config.mapping is not None for point in points)
    name = f"{kind}, {'frame by frame' if exact else 'drawn at once'}" + (", maps" if maps else "")
    return WorkCost(seconds, share * len(points) * (empty + each * damages), name)


def kind_of(camera: CameraConfig) -> str:
    """The kind of a camera, whose units cost alike."""
    return str(camera_of(camera).kind)


def _vertices(most: int) -> float:
    """Vertices of a path with at most so many, on average, in units of an endless path's."""
    return 1 - GOES_ON**most


def _region(job: RenderJob) -> Region:
    """The region that `scenes.render.view.target_region` finds, without building the target's mesh."""
    optics = camera_of(job.camera).optics
    outline = transform_points(job.target.pose.T_camera_board, outline_board_m(job.target.board))
    return seen_region(outline, optics).grown(RIM_PX + optics.margin_px, optics.lens.height, optics.lens.width)


def _damaged_pixels(job: RenderJob) -> float:
    """Pixels of damage and, one wide, of its rims."""
    lens = camera_of(job.camera).optics.lens
    pitch_mm = float(job.target.pose.T_camera_board[2, 3]) / sqrt(lens.fx * lens.fy) / MM
    diameters = [damage.diameter_mm / pitch_mm for damage in job.target.damages]
    return sum(pi / 4 * d**2 + pi * d for d in diameters)


# ---------------------------------------------------------------- rates that are learnt from runs

CostStage = Literal["renders", "trials", "records"]
STAGES: tuple[CostStage, ...] = ("renders", "trials", "records")
RATES_VERSION = 1
RATES_NAME = "rates.json"
FORGOTTEN = 0.5
"""Weight of earlier runs, each time: machines and code change."""
LEAST_S = 1.0
"""Seconds of work: less says nothing about a machine."""


@dataclass(frozen=True)
class Taken:
    """Seconds (or bytes) that were expected, and what it came to; old runs weigh less."""

    expected: float = 0.0
    taken: float = 0.0
    runs: int = 0

    def and_then(self, expected: float, taken: float) -> Taken:
        """The rates with a run more."""
        return Taken(FORGOTTEN * self.expected + expected, FORGOTTEN * self.taken + taken, self.runs + 1)

    @property
    def ratio(self) -> float | None:
        """Ratio of what was taken to what was expected; None where nothing is known."""
        return self.taken / self.expected if self.runs and self.expected > 0 else None


@dataclass(frozen=True)
class Rates:
    """The work of this machine for each kind of render and trial in seconds, and of record in bytes."""

    renders: Mapping[str, Taken] = field(default_factory=dict)
    trials: Mapping[str, Taken] = field(default_factory=dict)
    records: Mapping[str, Taken] = field(default_factory=dict)

    def ratio(self, stage: CostStage, kind: str) -> float:
        """Cost relative to the reference; of an unknown kind, as the stage's other kinds; 1 where nothing is known."""
        known = {name: one.ratio for name, one in getattr(self, stage).items() if one.ratio is not None}
        if kind in known:
            return known[kind]
        return sum(known.values()) / len(known) if known else 1.0

    def runs(self, stage: CostStage, kinds: Iterable[str]) -> int:
        """Number of runs of which the least known of these kinds is known; 0: of none."""
        return min((getattr(self, stage).get(kind, Taken()).runs for kind in kinds), default=0)


def read_rates(cache: Path) -> Rates:
    """Read the rates of this machine. A file that is absent, damaged or of another version says nothing."""
    try:
        said = strict_json(bounded_bytes(cache / RATES_NAME, TEXT_BYTES))
        if said["version"] != RATES_VERSION:
            return Rates()
        return Rates(*({kind: _taken(one) for kind, one in said[stage].items()} for stage in STAGES))
    except (OSError, UserError, ValueError, TypeError, KeyError, AttributeError, OverflowError):
        return Rates()


def _taken(said: dict[str, Any]) -> Taken:
    """Raises ValueError or TypeError where it is none."""
    one = Taken(float(said["expected"]), float(said["taken"]), int(said["runs"]))
    if not (isfinite(one.expected) and isfinite(one.taken) and one.expected > 0 and one.taken > 0 and one.runs > 0):
        raise ValueError("no rate")
    return one


def learn(plan: SweepPlan, outcome: Outcome, journal: Journal, cache: Path, jobs: int) -> Rates:
    """Put the costs of a run, of a shard too, into the rates and write them; returns them. ``cache``: the
    folder around that of the renders; one that cannot be written is no matter."""
    known = read_rates(cache)
    views = [render_cost(job) for job in plan.renders]
    batches = [(group, batch) for group in plan.groups for batch in group.batches]
    trials = [trial_cost(group, batch, jobs).times(group.most_repeats(batch)) for group, batch in batches]
    r, t = outcome.renders, outcome.trials
    size = sum(journal.size(key) for key in outcome.finished) if outcome.trials.done else 0
    rates = Rates(
        renders=_learnt(known.renders, _part(views, r.done, len(plan.renders)), r.seconds, LEAST_S),
        trials=_learnt(known.trials, _part(trials, t.done, plan.trial_count), t.seconds, LEAST_S),
        records=_learnt(known.records, _part(trials, len(outcome.finished), plan.trial_count, sizes=True), size, 1),
    )
    if rates != known:
        content = {stage: {kind: one.__dict__ for kind, one in getattr(rates, stage).items()} for stage in STAGES}
        text = json.dumps({"version": RATES_VERSION, **content}, indent=2, sort_keys=True)
        with contextlib.suppress(UserError):
            write_text(cache / RATES_NAME, text + "\n")
    return rates


def _learnt(
    known: Mapping[str, Taken], expected: list[tuple[str, float]], taken: float, least: float
) -> dict[str, Taken]:
    """The rates with a run more: what each cost, by kind, was expected to be, and what all of them took together; so
    kinds that ran together share one ratio."""
    total = sum(value for _, value in expected)
    if total <= 0 or taken < least:
        return dict(known)
    rates = dict(known)
    for kind in sorted({kind for kind, _ in expected}):
        own = sum(value for name, value in expected if name == kind)
        rates[kind] = rates.get(kind, Taken()).and_then(own, own * taken / total)
    return rates


def _part(costs: list[WorkCost], count: int, total: int, *, sizes: bool = False) -> list[tuple[str, float]]:
    """The expected costs of ``count`` of ``total``, by kind, as if they were as large as the rest."""
    return [(one.kind, (one.size_bytes if sizes else one.seconds) * count / total) for one in costs] if total else []
