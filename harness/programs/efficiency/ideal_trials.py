"""Noise of random units and the signature of each damage: the input of the ideal observer for a
study's set-ups.

Noise is a unit's average away from damage and rim, minus a cubic; so errors that the board's grain
causes are noise. The signature is what a camera without noise, unit errors and rounding shows near
damage, minus what it shows of the undamaged board."""

from dataclasses import replace

import numpy as np
from scipy import ndimage

from detectors.surfaces.surface import Chebyshev
from harness.experiment.schema import Point
from harness.programs.efficiency.ideal_observer import (
    BoardView,
    IdealDamages,
    ideal_damages,
    noise_sums,
)
from harness.runs.job_batches import carried_out, render_missing
from harness.runs.jobs import Job, JobEngine
from harness.runs.plan import Batch, RenderJob, SweepPlan
from harness.trials.averages import Averaging, averages_of
from harness.trials.board import Board, load_board
from harness.vocabulary.errors import UserError
from harness.vocabulary.geometry import MM
from harness.vocabulary.seeds import random_stream
from scenes.sensor.camera import camera_of
from scenes.sensor.common.config import CameraConfig, EffectsConfig
from scenes.sensor.source import SimulatedUnit

UNITS_A_BOARD = 10  # units, drawn anew for every board, whose noise is measured there
SMOOTHED_PX = 61  # side of the square over which a pixel's variance is averaged
DEGREE = 3  # degree of the undamaged surface, as in the thesis
FEWEST_PIXELS = 1000  # fewest undamaged pixels of a board to estimate its noise
FINE_MM = 1e-4  # rounding step of the noise-free camera
# distance beyond a damage's outline to which the camera's window and rims spread its signature
REACH_PX = 8


def ideal_of_set_ups(
    plan: SweepPlan, engine: JobEngine, calls_per_m2: float
) -> dict[tuple[str, int], IdealDamages]:
    """Return the ideal observer for every set-up of a study, by variant and frames, at a rate of
    false calls. Views that are not stored are rendered. Raises UserError if a view or a board's
    noise is not available."""
    ideals = {}
    for group in plan.groups:
        batches = [batch for batch in group.then if batch.role == "damaged"]
        lost = render_missing(
            (job for batch in batches for job in (*batch.renders, _undamaged(batch))), engine
        )
        jobs = [
            Job(f"noise of board {batch.board}", "trials", board_views, (batch, group.points))
            for batch in batches
        ]
        ends = {} if lost else {job.name: ended for job, ended in carried_out(jobs, engine)}
        if bug := next((end.why for end in ends.values() if end.is_bug), None):
            raise RuntimeError(bug)
        wrong = [failure.in_short for failure in lost] + [
            end.why for end in ends.values() if end.state != "done"
        ]
        if wrong:
            raise UserError(
                f"the ideal observer lacks a board: {wrong[0]}",
                fix="correct the cause, and run it again",
            )
        views = [ends[job.name].value for job in jobs]
        by_frames = {
            frames: ideal_damages([view[frames] for view in views], calls_per_m2)
            for frames in views[0]
        }
        for point in group.points:
            frames = point.config.capture.frames
            ideals[point.variant, frames] = by_frames[frames]
    return ideals


def _undamaged(batch: Batch) -> RenderJob:
    """Return the render of a batch's first view without its damage."""
    return replace(batch.renders[0], target=batch.renders[0].target.hole_free())


def board_views(batch: Batch, points: tuple[Point, ...]) -> dict[int, BoardView]:
    """Return a damaged board as the ideal observer sees it, by the numbers of frames of the
    points."""
    set_up = load_board(batch.views[0])
    undamaged = load_board(
        replace(batch.views[0], view_path=str(_undamaged(batch).path), damaged=False)
    )
    clear_z_m = noise_free_z_m(set_up)
    intact = set_up.intact & np.isfinite(clear_z_m)
    rows, columns = np.nonzero(set_up.on_board)
    cut = slice(rows.min(), rows.max() + 1), slice(columns.min(), columns.max() + 1)
    if intact.sum() < FEWEST_PIXELS:
        raise UserError(
            f"only {intact.sum()} pixels of the board are far from damage and rim: its "
            "noise is not known"
        )
    face_xy_m = set_up.board_xy_m[set_up.on_board]
    basis = Chebyshev.over(face_xy_m, DEGREE).basis(face_xy_m)
    surface = np.zeros((len(basis), *set_up.on_board.shape))
    surface[:, set_up.on_board] = basis
    reach_m = REACH_PX * max(set_up.pitch_mm) * MM
    x, y = np.moveaxis(set_up.board_xy_m, -1, 0)
    within_reach = [damage.within(x, y, reach_m) for damage in set_up.truth]
    signals_m = np.where(within_reach, clear_z_m - noise_free_z_m(undamaged), 0.0)
    is_judged = ndimage.binary_erosion(set_up.on_board, iterations=2) & np.isfinite(clear_z_m)
    inside = np.concatenate(list(set_up.outlines.values()))
    board = batch.board or 0
    names = tuple(str(damage.id) for damage in set_up.truth)
    pixel_m2 = float(np.prod(set_up.pitch_mm)) * MM**2
    lost_share = float((~np.isfinite(clear_z_m.ravel()[inside])).mean())
    shown_signals_m = np.nan_to_num(signals_m[:, *cut])
    shown_surface = surface[:, *cut]
    views = {}
    for point in {point.config.capture.frames: point for point in points}.values():
        noise_m, is_known = _noise_m(set_up, board, point, surface, intact)
        deviation_m = _deviation_m(noise_m, is_known)
        sums = noise_sums(noise_m[:, *cut] / deviation_m[cut], is_known[:, *cut])
        view = BoardView(
            board=board,
            holes=names,
            is_known=is_judged[cut],
            deviation_m=deviation_m[cut],
            signals_m=shown_signals_m,
            surface=shown_surface,
            sums=sums,
            units=UNITS_A_BOARD,
            pixel_m2=pixel_m2,
            lost=lost_share,
        )
        views[point.config.capture.frames] = view
    return views


def noise_free_z_m(set_up: Board) -> np.ndarray:
    """Return z (h, w) of the camera without noise, unit errors and rounding; NaN where it shows
    nothing."""
    config = set_up.unit.config
    kept = {
        name: getattr(config.effects, name)
        for name in ("multipath", "wiggling", "ambient", "saturation")
    }
    clear = dict.fromkeys(EffectsConfig.model_fields, False) | kept
    numbers = {**config.numbers, "engine.output_step_mm": FINE_MM}
    capture = _unit(set_up, effects=EffectsConfig(**clear), numbers=numbers).capture(1, 0)
    return np.asarray(next(iter(capture.frames())).z_m, dtype=np.float64)


def _unit(set_up: Board, **changes: object) -> SimulatedUnit:
    """Return the unit of a set-up with a changed declaration, in front of the same view."""
    config = CameraConfig.model_validate(set_up.unit.config.model_dump() | changes)
    return SimulatedUnit(camera_of(config), config, set_up.unit.view)


def _noise_m(
    set_up: Board, board: int, point: Point, surface: np.ndarray, intact: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the noise (k, h, w) of `UNITS_A_BOARD` units, each minus its cubic fit, and where it
    is known."""
    capture = point.config.capture
    fields = []
    for number in range(UNITS_A_BOARD):
        labels = ("units of the ideal observer", board, number)
        seed = int(random_stream(point.config.seed, *labels).integers(2**31))
        frames = _unit(set_up, unit_seed=seed).capture(capture.frames, point.config.seed, *labels)
        clouds = averages_of(frames, [capture.frames], Averaging(capture.average))
        cloud = clouds[capture.frames]
        noise = np.where(intact, cloud.points_m[..., 2], np.nan)
        is_known = np.isfinite(noise)
        basis = surface[:, is_known].T
        noise[is_known] -= basis @ np.linalg.lstsq(basis, noise[is_known], rcond=None)[0]
        fields.append(noise)
    noise_m = np.array(fields)
    return np.nan_to_num(noise_m), np.isfinite(noise_m)


def _deviation_m(noise_m: np.ndarray, is_known: np.ndarray) -> np.ndarray:
    """Return the root mean square (h, w) of the noise over units and a square around each pixel,
    or the nearest one."""
    square = ndimage.uniform_filter((noise_m**2).sum(axis=0), SMOOTHED_PX)
    count = ndimage.uniform_filter((is_known * 1.0).sum(axis=0), SMOOTHED_PX)
    enough = count > 0.5 * len(noise_m) / SMOOTHED_PX
    nearest = ndimage.distance_transform_edt(~enough, return_distances=False, return_indices=True)
    return np.asarray(np.sqrt(square[tuple(nearest)] / count[tuple(nearest)]))
