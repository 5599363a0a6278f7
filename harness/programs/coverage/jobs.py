"""A part in front of a camera, patch by patch: its noise, the signal of damage there, and how
often damage is found.

The noise at a place is the detector's unit of score there, in metres: constant if the detector has
one scale for the whole part, else measured nearby. The signal of damage and its scatter are
learned from the detector's own scores on boards of the family, in random poses as wide as those
requested. Not modelled: light of other parts, sizes in missing returns."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy import ndimage

from harness.experiment.schema import Experiment, ExperimentConfig, Point, SimulatedSource
from harness.programs.coverage.statistics import Findable, Patches, ScoredDamage, Seen, findable
from harness.runs.estimate import progress_display
from harness.runs.job_batches import render_missing, values_of
from harness.runs.jobs import JobEngine, Outcome
from harness.runs.journal import Journal
from harness.runs.plan import Batch, Group, SweepPlan, batch_of, plan_of, trial_point
from harness.runs.run import run_plan
from harness.trials.board import load_board
from harness.trials.clouds import TrialPoint
from harness.trials.judge import detector_of
from harness.trials.trial import Trial, cloud_of
from harness.vocabulary.errors import UserError
from harness.vocabulary.geometry import MM, rotate_vectors, transform_points
from scenes.target.custom import BoardConfig, PoseConfig
from scenes.target.drawn import DrawnTargetConfig
from scenes.target.truth import Damage, face_of

# damaged boards to learn from, and averages in which each is inspected
BOARDS = 40
LOOKS = 3
STEEPEST_DEG = 60.0  # largest tilt of these boards about either axis
# averages for noise; sides of squares for the unit of score, for missing pixels
DRAWS = 2
AROUND_PX = 31
NEAR_PX = 15
MOST_PATCHES = 3000
SAME_MM = 1e-6  # sizes that differ by less are equal; if all are, the size of damage is its depth
# A patch is visible if its z and the view's differ by less, or by less than two pixels on the
# slope
ON_FACE_M = 5 * MM

# Distance in metres, tilts of the part about its x and y in degrees
Pose = tuple[float, float, float]


@dataclass(frozen=True, eq=False)
class Survey:
    """A set-up in front of a part."""

    # The set-up
    point: Point
    # The point as its trials have it, with its threshold
    task: TrialPoint
    # The face of the part
    patches: Patches
    # The law of the signal
    findable: Findable
    # How the patches are seen, by pose
    visibility: dict[Pose, Seen]


def survey(
    experiment: Experiment, poses: Sequence[Pose], cache: Path, folder: Path, engine: JobEngine
) -> list[Survey]:
    """Return a survey for each set-up. Views and trials in ``cache`` and ``folder`` are not made
    again. Raises UserError if a point has no threshold, and as `declared` and `findable` do."""
    plan = SweepPlan(
        tuple(_widened(group, poses) for group in plan_of(experiment, cache, folder).groups)
    )
    journal = Journal(folder / "journal")
    with progress_display() as report:
        outcome = run_plan(plan, journal, engine, report)
    scores = _scores_of(outcome, journal)
    surveys = []
    for group in plan.groups:
        source, family = declared(group.points[0].config)
        patches = patches_of(family.board)
        target = family.drawn("hole_free", 0)
        wholes = [_bare(batch) for batch in group.then]
        views = []
        for distance_m, tilt_x_deg, tilt_y_deg in poses:
            pose = PoseConfig(distance_m=distance_m, tilt_x_deg=tilt_x_deg, tilt_y_deg=tilt_y_deg)
            board = target.model_copy(update={"pose": pose})
            views.append(batch_of(board, "hole_free", source, cache, 0))
        renders = [job for batch in (*wholes, *views) for job in batch.renders]
        if lost := render_missing(renders, engine):
            raise UserError(f"a view could not be rendered: {lost[0].in_short}")
        for point in group.points:
            threshold = _threshold_of(point, outcome)
            task = trial_point(point, threshold, group.learned.get(point.digest))
            pairs = [(*pair, task, group.seed) for pair in zip(group.then, wholes, strict=True)]
            boards = values_of(_board_seen, pairs, engine)
            inspections = _inspections(
                [board for board in boards if board is not None], point, scores
            )
            law = findable(inspections, threshold)
            seen_of_views = values_of(
                _part_seen, [(view, task, group.seed, patches) for view in views], engine
            )
            visibility = {}
            for pose_of_view, seen_of_view in zip(poses, seen_of_views, strict=True):
                if seen_of_view is None:
                    seen_of_view = _unseen(len(patches.areas_m2))
                visibility[pose_of_view] = seen_of_view
            surveys.append(
                Survey(
                    point=point,
                    task=task,
                    patches=patches,
                    findable=law,
                    visibility=visibility,
                )
            )
    return surveys


def _scores_of(outcome: Outcome, journal: Journal) -> dict[tuple[str, int, int, str], list[float]]:
    """Return the scores of all finished trials by variant, frames, board and damage: NaN where it
    was missed, infinite where only missing returns found it."""
    scores: dict[tuple[str, int, int, str], list[float]] = {}
    for key in outcome.finished:
        entry = journal.read(key)
        if entry is None or not entry.record:
            continue
        for row in entry.record.get("holes", ()):
            damage_key = (row["variant"], row["frames"], row["board"], row["hole"])
            missed = np.inf if row["no_return"] else np.nan
            scores.setdefault(damage_key, []).append(row["score"] if row["detected"] else missed)
    return scores


def _threshold_of(point: Point, outcome: Outcome) -> float:
    """Return the calibrated threshold of a point. Raises UserError if there is none."""
    if point.digest not in outcome.thresholds:
        reasons = (failure.in_short for failure in outcome.failures)
        why = next(reasons, "no hole-free run ended")
        raise UserError(f"{point.label or point.variant} has no threshold: {why}")
    return outcome.thresholds[point.digest]


def _unseen(count: int) -> Seen:
    """Return the view of so many places of which nothing is judged."""
    return Seen(
        deviation_m=np.full(count, np.inf),
        cosine=np.ones(count),
        range_m=np.ones(count),
        residual_m=np.zeros(count),
    )


def patches_of(board: BoardConfig) -> Patches:
    """Return the face of a board in about `MOST_PATCHES` patches that are square in plan."""
    sides_m = np.array([board.width_mm, board.height_mm]) * MM
    counts = np.maximum(np.rint(sides_m / np.sqrt(sides_m.prod() / MOST_PATCHES)), 2).astype(int)
    column_count, row_count = counts.tolist()
    width_m, height_m = sides_m
    x = (np.arange(column_count) + 0.5) * width_m / column_count - width_m / 2
    y = (np.arange(row_count) + 0.5) * height_m / row_count - height_m / 2
    grid_x, grid_y = np.meshgrid(x, y)
    face = face_of(board)
    points = face.point(grid_x, grid_y).reshape(-1, 3)
    points = points[np.isfinite(points[:, 2])]
    normals = face.axis(points[:, 0], points[:, 1])
    kept = normals[:, 2] > 0
    areas_m2 = sides_m.prod() / counts.prod() / normals[kept, 2]
    return Patches(points[kept], normals[kept], areas_m2)


def declared(config: ExperimentConfig) -> tuple[SimulatedSource, DrawnTargetConfig]:
    """Return the source and the family of boards. Raises UserError if there is no study of these
    in single views."""
    source = config.simulated
    if (
        isinstance(source.target, DrawnTargetConfig)
        and config.study is not None
        and source.views is None
    ):
        return source, source.target
    fix = (
        "declare `study`, and `source.target: {name: drawn, damage: ..., board: ...}`, as "
        "experiments/pipe.yaml does"
    )
    raise UserError(f"{config.name}: is not a study of drawn damage in single views", fix=fix)


def refuse_size(config: ExperimentConfig, size_mm: float | None) -> None:
    """Raise UserError for a size outside the declared range, that of depths if all sizes in plan
    are equal."""
    damage = declared(config)[1].damage
    word = damage.size_of
    low, high = damage.size_mm
    if high - low < SAME_MM and damage.depths_mm:
        word = "depth"
        low, high = damage.depths_mm
    if size_mm is not None and not low <= size_mm <= high:
        fix = (
            "change the damage's range in the experiment: sizes that are not inspected have no "
            "limit"
        )
        message = f"{size_mm:.3g} mm: {config.name} inspects no damage of that size"
        raise UserError(message, legal=f"{low:.3g} to {high:.3g} mm ({word})", fix=fix)


def _widened(group: Group, poses: Sequence[Pose]) -> Group:
    """Return the group with damaged boards in poses that reach as far as those given, and as the
    face is curved."""
    source, family = declared(group.points[0].config)
    bent_deg = float(np.degrees(np.arccos(patches_of(family.board).normals[:, 2].min())))
    largest_tilt_deg = max(max(abs(x), abs(y)) for _, x, y in poses)
    near_m = min(distance_m for distance_m, _, _ in poses)
    far_m = max(distance_m for distance_m, _, _ in poses)
    wide = {
        "tilt_deg": min(family.tilt_deg + bent_deg + largest_tilt_deg, STEEPEST_DEG),
        "distance_m": (near_m + far_m) / 2,
        "distance_jitter_mm": family.distance_jitter_mm + (far_m - near_m) / 2 / MM,
    }
    family = family.model_copy(update=wide)
    cache = group.then[0].renders[0].folder
    then = tuple(
        batch_of(family.drawn("damaged", n), "damaged", source, cache, n) for n in range(BOARDS)
    )
    often = [
        replace(point, config=point.config.model_copy(update={"repeats": LOOKS}))
        for point in group.points
    ]
    return replace(group, points=tuple(often), then=then)


def _bare(batch: Batch) -> Batch:
    """Return a damaged batch's board without its damage."""
    (job,) = batch.renders
    (ref,) = batch.views
    job = replace(job, target=job.target.hole_free())
    ref = replace(ref, view_path=str(job.path), damaged=False)
    return replace(batch, role="hole_free", renders=(job,), views=(ref,))


def _inspections(
    boards: Sequence[Any], point: Point, scores: Mapping[tuple[str, int, int, str], Sequence[float]]
) -> ScoredDamage:
    """Return all inspections of the damages of boards (`_board_seen`)."""
    facts = list[tuple[float, ...]]()
    for number, damages in boards:
        for damage, seen_damage in damages:
            damage_key = (point.variant, point.config.capture.frames, number, str(damage.id))
            own_index = len(facts)
            sizes_mm = (damage.diameter_m / MM, damage.depth_m / MM)
            facts += [
                (own_index, *sizes_mm, *seen_damage, score) for score in scores.get(damage_key, ())
            ]
    if not facts:
        raise UserError(
            f"{point.label or point.variant}: no damaged board was judged",
            fix="check the detector's crop",
        )
    numbers, plan_mm, depth_mm, deviation_m, cosine, range_m, residual_m, score = np.array(facts).T
    is_depth = np.ptp(plan_mm) < SAME_MM < np.ptp(depth_mm)
    return ScoredDamage(
        size_of="depth" if is_depth else boards[0][1][0][0].size_of,
        damage=numbers,
        size_mm=depth_mm if is_depth else plan_mm,
        seen=Seen(
            deviation_m=deviation_m,
            cosine=cosine,
            range_m=range_m,
            residual_m=residual_m,
        ),
        score=score,
    )


def _unit_and_residual_m(
    batch: Batch, point: TrialPoint, seed: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return two fields (h, w) of a hole-free board, metres. The detector's unit of score is its
    residual over its score, rms around each pixel; larger if some pixels or averages are not
    judged, infinite if most are not. The residual is the mean of the averages around each pixel,
    0 where nothing is judged."""
    fields = []
    for repeat in range(DRAWS):
        task = Trial(
            views=batch.before(repeat),
            seed=seed,
            role="hole_free",
            repeat=repeat,
            points=(point,),
            board=batch.board,
        )
        criteria = point.criteria
        detector = detector_of(criteria.detector, criteria.settings_json, criteria.learned)
        evidence = detector.analyse(cloud_of(task, point))
        is_judged = np.isfinite(evidence.score)
        residual_m = np.where(is_judged, evidence.residual_m, 0.0)
        score_square = np.where(is_judged, evidence.score**2, 0.0)
        fields.append([is_judged, residual_m, residual_m**2, score_square])
    judged_share, residual_m, residual_square_m2, score_square = np.mean(fields, axis=0)
    residual_square_m2 = ndimage.uniform_filter(residual_square_m2, AROUND_PX)
    score_square = ndimage.uniform_filter(score_square, AROUND_PX)
    judged = (judged_share >= 0.5) & (residual_square_m2 > 0) & (score_square > 0)
    judged_share_nearby = ndimage.uniform_filter(judged_share, NEAR_PX)
    with np.errstate(divide="ignore", invalid="ignore"):
        unit_m = np.sqrt(residual_square_m2 / score_square / judged_share_nearby)
        around_m = ndimage.uniform_filter(residual_m, AROUND_PX) / ndimage.uniform_filter(
            judged_share, AROUND_PX
        )
    return np.where(judged, unit_m, np.inf), np.where(judged, around_m, 0.0)


def _board_seen(
    batch: Batch, whole_batch: Batch, point: TrialPoint, seed: int
) -> tuple[int, list[tuple[Damage, tuple[float, float, float, float]]]]:
    """Return a damaged board's number, and its damages with the view of each (`Seen`) on the board
    without damage."""
    set_up = load_board(batch.views[0])
    unit_m, residual_m = _unit_and_residual_m(whole_batch, point, seed)
    seen_damages = []
    for damage in set_up.truth:
        range_m = float(np.linalg.norm(damage.centre_camera_m))
        cosine = float(-damage.axis_camera @ damage.centre_camera_m) / range_m
        outline = set_up.outlines[damage.id]
        about_m = float(np.median(unit_m.ravel()[outline]))
        background_m = float(np.mean(residual_m.ravel()[outline])) if len(outline) else 0.0
        seen_damages.append((damage, (about_m, cosine, range_m, background_m)))
    return batch.board or 0, seen_damages


def _part_seen(view: Batch, point: TrialPoint, seed: int, patches: Patches) -> Seen:
    """Return the view and the noise of the patches of an undamaged part."""
    set_up = load_board(view.views[0])
    deviation_m, residual_m = _unit_and_residual_m(view, point, seed)
    points_m = transform_points(set_up.T_camera_board, patches.points_m)
    range_m = np.linalg.norm(points_m, axis=1)
    normals = rotate_vectors(set_up.T_camera_board, patches.normals)
    cosine = -(normals * points_m).sum(axis=1) / range_m
    region = set_up.unit.region
    camera = set_up.unit.camera
    lens = camera.nominal_lens
    u, v = np.rint(lens.project(points_m)).astype(int).T - [[region.col0], [region.row0]]
    is_seen = (
        camera.images(points_m)
        & (cosine > 0)
        & (u >= 0)
        & (v >= 0)
        & (u < region.shape[1])
        & (v < region.shape[0])
    )
    u = np.where(is_seen, u, 0)
    v = np.where(is_seen, v, 0)
    # an object in front of a patch has another z
    slope = np.sqrt(1 / np.clip(cosine, 0.05, 1) ** 2 - 1)
    reach_m = np.maximum(ON_FACE_M, 2 * slope * range_m / min(lens.fx, lens.fy))
    is_seen &= np.abs(set_up.seen_z_m[v, u] - points_m[:, 2]) < reach_m
    return Seen(
        deviation_m=np.where(is_seen, deviation_m[v, u], np.inf),
        cosine=np.clip(cosine, 1e-3, 1.0),
        range_m=range_m,
        residual_m=np.where(is_seen, residual_m[v, u], 0.0),
    )
