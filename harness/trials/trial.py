"""One trial: simulate the frames of a set-up, average them, merge views into maps, and run the
detectors on the result.

Averages are drawn at once if that gives the same distribution (plain means of `FEWEST_FRAMES`
frames or more, if the camera's model supports it). Frames that jump are then left out by their
displacement, which is known exactly."""

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import islice, pairwise
from typing import Any, Literal, cast

import numpy as np
from scipy import special

from detectors.averages.average import (
    CORRELATED_PIXELS,
    REFERENCE_FRAMES,
    SAMPLED_PIXELS,
    AverageConfig,
    prefix_averages,
)
from detectors.averages.flat_captures import flattened, separated
from detectors.averages.flat_field import FlatField, FlatFieldConfig, corrected
from detectors.views.mapping.merge import Merged, merge, prepare
from detectors.views.mapping.settings import MappingConfig
from detectors.views.registration.register import register
from detectors.views.registration.registered import Registration, predicted_error_m
from detectors.views.registration.settings import PAIRWISE
from detectors.views.view import PreparedView, View
from harness.trials.judge import STUDY_TABLES, Rows, judge, study_rows
from harness.trials.setup import (
    KnownCloud,
    SetUp,
    SetUpRef,
    face_errors_m,
    known_map,
    known_view,
    load_set_up,
)
from harness.vocabulary.geometry import MM, Cloud, LeftOut, invert, transform_points
from harness.vocabulary.seeds import canonical_json
from scenes.closed_form import plane_view
from scenes.perspectives import AnyViews, T_reference_view_of, guessed_T_reference_view
from scenes.sensor.amcw.at_once import AtOnce
from scenes.sensor.camera import CameraConfig, camera_of
from scenes.sensor.source import SimulatedCapture, SimulatedUnit
from scenes.sensor.unit import FrameTotals

FEWEST_FRAMES = 10
"""Drawing fewer frames costs less than sorting a view's pixels. Results depend on the number only,
not on the cost."""
FLAT_ALBEDO = (
    # albedo of a flat field's plane: painted wood or paper, like the boards of the experiments
    0.6
)
MOST_DISTURBED = 0.5
"""Share of `AverageConfig.disturbed_fraction` that the pixels' own noise may disturb; it varies by
a thousandth."""


def averages_of(
    capture: SimulatedCapture,
    counts: Sequence[int],
    config: AverageConfig,
    exact: bool,
    flat_field: FlatFieldConfig | None = None,
) -> dict[int, Cloud]:
    """Return the averages of the first n frames of a capture for each n in ``counts``. Their
    distribution is that of `detectors.averages.average.prefix_averages`, which is used (and may
    raise) if ``exact`` or if averages cannot be drawn at once. Larger averages contain the frames
    of smaller ones drawn in the same way. A ``flat_field`` is subtracted."""
    many = sorted({n for n in counts if n >= FEWEST_FRAMES})
    clouds = (
        _at_once(capture, many, config) if many and not exact and config.method == "mean" else {}
    )
    rest = [n for n in counts if n not in clouds]
    clouds |= prefix_averages(capture, rest, config) if rest or not counts else {}
    if flat_field is not None:
        field = flat_field_of(capture.unit.config, flat_field, capture.seed)
        clouds = {n: corrected(cloud, field) for n, cloud in clouds.items()}
    return clouds


@lru_cache(maxsize=4)
def flat_field_of(camera: CameraConfig, config: FlatFieldConfig, seed: int) -> FlatField:
    """Return a unit's flat field, measured on a plane across its axis. Raises UserError if no
    pixel has a range."""
    facts = camera_of(camera)
    view = plane_view(facts, facts.nominal_lens.whole, config.distance_m, FLAT_ALBEDO)
    capture = SimulatedUnit(facts, camera, view).capture(config.frames, seed, "flat field")
    cloud = averages_of(capture, [config.frames], AverageConfig(), exact=False)[config.frames]
    return separated([flattened(cloud, cloud.valid, "flat field")], facts.nominal_lens).field


def _at_once(
    capture: SimulatedCapture, counts: list[int], config: AverageConfig
) -> dict[int, Cloud]:
    """Return the averages that can be drawn at once."""
    summer = capture.unit.at_once
    if (
        summer is None
        or counts[-1] > capture.n_frames
        or (config.judge_frames and not summer.sure_pixels)
    ):
        return {}
    # noise of one frame, with rounding, as `detectors.averages.average` estimates it
    noise_m = float(np.hypot(summer.noise_m, capture.z_step_m / np.sqrt(12)))
    left_out = _left_out(capture, summer, config, noise_m) if config.judge_frames else {}
    steps = pairwise([0, *counts])
    parts = [
        np.array([number for number in range(*step) if number not in left_out], int)
        for step in steps
    ]
    clouds: dict[int, Cloud] = {}
    for n, totals in zip(counts, capture.totals(parts) or (), strict=False):
        cloud = _cloud(
            capture, totals, tuple(left for number, left in left_out.items() if number < n)
        )
        if cloud is not None and not (config.judge_frames and _disturbed(cloud, noise_m, config)):
            clouds[n] = cloud
    return clouds


def _left_out(
    capture: SimulatedCapture, summer: AtOnce, config: AverageConfig, noise_m: float
) -> dict[int, LeftOut]:
    """Return the frames, by number, that jump. The estimate's error, a sixth of the limit, is not
    simulated."""
    sampled = summer.sure_pixels / -(-summer.sure_pixels // SAMPLED_PIXELS)
    error_m = 1.2533 * noise_m * np.sqrt(2.0 * CORRELATED_PIXELS / max(sampled, CORRELATED_PIXELS))
    limit_m = max(config.jump_sigmas * error_m, config.jump_mm * MM)
    off_m = summer.z_by_error * (capture.errors_m - np.median(capture.errors_m[:REFERENCE_FRAMES]))
    allowed = f"against the first {REFERENCE_FRAMES} frames (allowed {limit_m / MM:.1f} mm)"
    return {
        number: LeftOut(
            f"frame {number}", f"the whole range jumps by {off_m[number] / MM:+.1f} mm {allowed}"
        )
        for number in np.flatnonzero(np.abs(off_m) > limit_m).tolist()
    }


def _disturbed(cloud: Cloud, noise_m: float, config: AverageConfig) -> bool:
    """Return whether enough pixels lose their range or change for frames to be left out."""
    judged = 2 * cloud.count > cloud.n_frames
    if not judged.any():
        return True
    change_m = max(config.changed_sigmas * noise_m, config.changed_mm * MM)
    lost = 1 - cloud.count[judged].mean() / cloud.n_frames
    # of pixels with less than a quarter of the change, 6 in 100,000 change
    loud = judged & (cloud.variance_m2 > (change_m / 4) ** 2)
    changed = special.erfc(change_m / np.sqrt(2 * cloud.variance_m2[loud])).sum() / judged.sum()
    return bool(lost + changed > MOST_DISTURBED * config.disturbed_fraction)


def _cloud(
    capture: SimulatedCapture, totals: FrameTotals, left_out: tuple[LeftOut, ...]
) -> Cloud | None:
    """Return the average from sums over frames, as `detectors.averages.average` computes it; None
    if no pixel has a range."""
    count = totals.count
    if not count.any():
        return None
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = totals.total / count
        z_m = (totals.base + mean) * totals.step_m
        variance = (totals.squares - totals.total * mean) / (count - 1)
        amplitude = totals.amplitude / count
    reason = np.zeros(count.shape, np.uint8)
    lost = count == 0
    reason[lost] = totals.reasons[:, lost].argmax(axis=0)
    return Cloud(
        points_m=np.concatenate([capture.slopes * z_m[..., None], z_m[..., None]], axis=-1),
        reason=reason,
        count=count,
        variance_m2=np.where(count > 1, np.maximum(variance, 0.0) * totals.step_m**2, np.nan),
        region=capture.region,
        z_step_m=capture.z_step_m,
        n_frames=totals.frames,
        organised=capture.organised,
        lens=capture.lens,
        rgb=capture.unit.rgb,
        amplitude=amplitude,
        left_out=left_out,
    )


Clouds = Mapping[int, Cloud]  # averages of one view, by number of frames
BOARD_STEPS = 9  # points along each side of the board where a registration's error is evaluated


class MapMaker:
    """Makes the maps of one trial. ``clouds``: by view, then by number of frames. ``poses``:
    declaration of the views. ``labels``: of the random stream of the poses' errors. ``truth``,
    ``guesses``: T_reference_view of each view."""

    def __init__(
        self,
        set_ups: Sequence[SetUp],
        clouds: Sequence[Clouds],
        poses: AnyViews,
        labels: Sequence[str | int],
    ) -> None:
        self._set_ups = set_ups
        self._clouds = clouds
        self._made: dict[str, Any] = {}
        self._reported: set[str] = set()
        stands = tuple(set_up.target.pose for set_up in set_ups)
        numbers = range(len(set_ups))
        self.truth = tuple(T_reference_view_of(stands, number) for number in numbers)
        self.guesses = tuple(
            guessed_T_reference_view(poses, stands, number, *labels) for number in numbers
        )

    def count(self, mapping: MappingConfig) -> int:
        """Return the number of views that a mapping uses."""
        return mapping.views or len(self._set_ups)

    def key(self, mapping: MappingConfig, frames: int) -> str:
        """Return a text that is equal for mappings that make the same map."""
        return canonical_json([self._registration_key(mapping, frames), mapping.merge.to_data()])

    def known(self, mapping: MappingConfig, frames: int, *, hole_free: bool) -> KnownCloud:
        """Return the map together with the truth."""
        merged = self.merged(mapping, frames)
        return known_map(
            self._set_ups[0], merged.cloud, merged.T_reference_cloud, hole_free=hole_free
        )

    def merged(self, mapping: MappingConfig, frames: int) -> Merged:
        """Return the map."""
        if (key := f"merged {self.key(mapping, frames)}") not in self._made:
            self._made[key] = merge(
                self.prepared(mapping, frames), self.registrations(mapping, frames), mapping.merge
            )
        return cast("Merged", self._made[key])

    def prepared(
        self, mapping: MappingConfig, frames: int, count: int | None = None
    ) -> tuple[PreparedView, ...]:
        """Return the views with their target cut out and their marks found."""
        keys = []
        for number in range(self.count(mapping) if count is None else count):
            keys.append(
                canonical_json([number, frames, mapping.crop.to_data(), mapping.marks.to_data()])
            )
            if keys[-1] not in self._made:
                view = View(f"view {number}", self._clouds[number][frames], self.guesses[number])
                self._made[keys[-1]] = prepare(view, mapping)
        return tuple(self._made[key] for key in keys)

    def registrations(self, mapping: MappingConfig, frames: int) -> tuple[Registration, ...]:
        """Return the registration of each view."""
        count = self.count(mapping)
        key = self._registration_key(mapping, frames)
        if mapping.registration.method in PAIRWISE:
            most = sum(frames in clouds for clouds in self._clouds)
            parts = [
                frames,
                mapping.crop.to_data(),
                mapping.marks.to_data(),
                mapping.registration.to_data(),
            ]
            key = canonical_json(parts)
            count = max(most, count)
        if key not in self._made:
            self._made[key] = register(self.prepared(mapping, frames, count), mapping.registration)
        return tuple(self._made[key][: self.count(mapping)])

    def registration_rows(self, mapping: MappingConfig, frames: int) -> list[dict[str, Any]]:
        """Return a row for each view but the first (columns: `REGISTRATIONS`), once for each
        registration."""
        key = self._registration_key(mapping, frames)
        if key in self._reported or self.count(mapping) == 1:
            return []
        self._reported.add(key)
        found = zip(
            self.prepared(mapping, frames), self.registrations(mapping, frames), strict=True
        )
        return [
            self._row(number, view, registration)
            for number, (view, registration) in enumerate(found)
            if number
        ]

    def seconds(self, mapping: MappingConfig, frames: int) -> float:
        """Return the seconds that registration and merging took, even if another point shares
        them."""
        spent = sum(registration.seconds for registration in self.registrations(mapping, frames))
        return float(spent + self.merged(mapping, frames).seconds)

    def _registration_key(self, mapping: MappingConfig, frames: int) -> str:
        count = self.count(mapping)
        registration = mapping.registration.to_data() if count > 1 else None
        return canonical_json(
            [count, frames, mapping.crop.to_data(), mapping.marks.to_data(), registration]
        )

    def _row(self, number: int, view: PreparedView, registration: Registration) -> dict[str, Any]:
        first = self._set_ups[0]
        board = first.target.board
        T_camera_board = first.T_camera_board
        x = np.linspace(-0.5, 0.5, BOARD_STEPS) * board.width_mm * MM
        y = np.linspace(-0.5, 0.5, BOARD_STEPS) * board.height_mm * MM
        grid = np.stack(
            [*np.meshgrid(x, y), np.zeros((BOARD_STEPS, BOARD_STEPS))], axis=-1
        ).reshape(-1, 3)
        places_m = transform_points(T_camera_board, grid)
        normal = T_camera_board[:3, 2]
        both = (registration.T_reference_view, self.guesses[number])
        (in_plane, across), guessed = (
            registration_error_m(T, self.truth[number], places_m, normal) for T in both
        )
        predicted = predicted_error_m(registration, places_m, normal)
        columns = ("method", "overlap", "pairs", "iterations", "converged", "seconds", "failure")
        return {
            "view": number,
            **{name: getattr(registration, name) for name in columns},
            "tre_mm": float(np.hypot(in_plane, across)) / MM,
            "tre_in_plane_mm": in_plane / MM,
            "tre_across_mm": across / MM,
            "predicted_in_plane_mm": predicted[0] / MM,
            "predicted_across_mm": predicted[1] / MM,
            "guess_tre_mm": float(np.hypot(*guessed)) / MM,
            "residual_mm": registration.residual_m / MM,
            "marks": len(view.marks.trusted),
        }


def registration_error_m(
    T_reference_view: np.ndarray,
    true_T_reference_view: np.ndarray,
    points_m: np.ndarray,
    normal: np.ndarray,
) -> tuple[float, float]:
    """Return the root mean square target registration error over points (n, 3) of the reference
    frame, in metres: in the plane perpendicular to ``normal`` (3,), and along ``normal``
    (Fitzpatrick, West and Maurer 1998). An error that a whole view shares counts too: a camera
    that ranges d too far at an angle a adds d sin(a) in the plane."""
    moved = transform_points(T_reference_view @ invert(true_T_reference_view), points_m) - points_m
    across = moved @ normal
    in_plane = np.linalg.norm(moved - across[:, None] * normal, axis=-1)
    return float(np.sqrt((in_plane**2).mean())), float(np.sqrt((across**2).mean()))


Role = Literal["learning", "calibration", "hole_free", "damaged"]
"""Purpose of a board: to learn from, to set a threshold (only in a study), to count false calls,
or to be inspected."""
TABLES = ("runs", "holes", "probes", "noise", "registrations", *STUDY_TABLES)
LAGS = (1, 2, 3)  # distances in pixels for the correlation of noise
FEWEST_PAIRS = (
    # fewest pairs of pixels for a correlation; with fewer, its standard error would exceed 0.14
    50
)


@dataclass(frozen=True)
class PointTask:
    """A point's part of a trial. ``threshold``: None in calibration. ``learned``: file of what its
    detector learned."""

    digest: str
    variant: str
    frames: int
    detector: str
    settings_json: str
    average: AverageConfig
    radius_m: float
    threshold: float | None
    mapping: MappingConfig | None = None
    exact: bool = False
    learned: str | None = None
    flat_field: FlatFieldConfig | None = None
    overlap: float | None = None


@dataclass(frozen=True)
class TrialTask:
    """Frames of one set-up, drawn once and judged by all points that share them. ``board``: its
    number in a study."""

    set_ups: tuple[SetUpRef, ...]
    seed: int
    role: Role
    repeat: int
    points: tuple[PointTask, ...]
    poses: AnyViews | None = None
    board: int | None = None

    @property
    def hole_free(self) -> bool:
        """Return whether the target is shown without damage."""
        return self.role != "damaged"

    @property
    def labels(self) -> tuple[str | int, ...]:
        """Labels of the random stream: different for all trials and boards."""
        return (
            (self.role, self.repeat)
            if self.board is None
            else (self.role, self.repeat, "board", self.board)
        )


def run_trial(task: TrialTask) -> Rows:
    """Run one trial. Return rows by table, as in `TABLES` (columns: `harness.runs.tables`)."""
    set_ups = [load_set_up(ref) for ref in task.set_ups]
    record: Rows = {name: [] for name in TABLES}
    by_average: dict[str, list[PointTask]] = {}
    for point in task.points:
        averaging = [
            point.average.to_data(),
            point.exact,
            point.flat_field and point.flat_field.to_data(),
        ]
        by_average.setdefault(canonical_json(averaging), []).append(point)
    for points in by_average.values():
        began = time.perf_counter()
        clouds = [_clouds(set_up, number, task, points) for number, set_up in enumerate(set_ups)]
        seconds = {"seconds_frames": (time.perf_counter() - began) / len(points)}
        if task.role == "hole_free" and task.poses is None and task.board is None:
            for name, rows in _board_rows(task, set_ups[0], clouds[0], points).items():
                record[name] += rows
        maps = None if task.poses is None else MapMaker(set_ups, clouds, task.poses, task.labels)
        done: dict[str, Rows] = {}
        for point in points:
            for name, rows in _point_rows(
                task, set_ups[0], clouds[0], maps, point, done, seconds
            ).items():
                record[name] += rows
    return record


def cloud_of(task: TrialTask, point: PointTask) -> Cloud:
    """Return the cloud, or the map, that a point's detector sees in a trial."""
    set_ups = [load_set_up(ref) for ref in task.set_ups]
    clouds = [_clouds(set_up, number, task, [point]) for number, set_up in enumerate(set_ups)]
    if task.poses is None or point.mapping is None:
        return clouds[0][point.frames]
    return (
        MapMaker(set_ups, clouds, task.poses, task.labels).merged(point.mapping, point.frames).cloud
    )


def _clouds(
    set_up: SetUp, number: int, task: TrialTask, points: Sequence[PointTask]
) -> dict[int, Cloud]:
    """Return the averages of one view at all numbers of frames of the points that use it."""
    views = [None if point.mapping is None else point.mapping.views for point in points]
    counts = sorted(
        {point.frames for point, n in zip(points, views, strict=True) if n is None or number < n}
    )
    if not counts:
        return {}
    first = points[0]
    capture = capture_of(set_up, number, task, counts[-1])
    return averages_of(capture, counts, first.average, first.exact, first.flat_field)


def capture_of(set_up: SetUp, number: int, task: TrialTask, frames: int) -> SimulatedCapture:
    """Return the frames of one view in one trial. Those of the first view are the same without
    other views."""
    return set_up.unit.capture(
        frames, task.seed, *task.labels, *(("view", number) if number else ())
    )


def _point_rows(
    task: TrialTask,
    first: SetUp,
    views: dict[int, Cloud],
    maps: MapMaker | None,
    point: PointTask,
    done: dict[str, Rows],
    seconds: dict[str, float],
) -> Rows:
    """Return the rows of one point, by table. ``done``: rows of earlier points, reused if their
    inputs are the same."""
    common: dict[str, Any] = {
        "variant": point.variant,
        "frames": point.frames,
        "repeat": task.repeat,
    }
    if task.board is not None:
        common["board"] = task.board
    named = {"point": point.digest, **common}
    role = {"role": task.role}
    mapping = point.mapping
    source: Any = point.frames
    of_map: dict[str, float] = {}
    registrations: list[dict[str, Any]] = []
    probes: list[dict[str, Any]] = []
    if maps is not None and mapping is not None:
        merged = maps.merged(mapping, point.frames)
        registrations = maps.registration_rows(mapping, point.frames)
        used = len(merged.views_used)
        of_map = {"views_used": used, "views_left_out": maps.count(mapping) - used}
        of_map["seconds_map"] = maps.seconds(mapping, point.frames)
        source = maps.key(mapping, point.frames)
    judging = (point.detector, point.settings_json, point.threshold, point.radius_m)
    key = canonical_json([source, *judging, point.learned, point.overlap])
    if key not in done:
        if maps is None or mapping is None:
            known = known_view(first, views[point.frames], hole_free=task.hole_free)
        else:
            known = maps.known(mapping, point.frames, hole_free=task.hole_free)
            if task.hole_free and task.board is None:
                errors_m = face_errors_m(known, first.board_xy_m.reshape(-1, 2)[first.probes])
                probes = [{"error_tenth_um": _tenth_um(errors_m)}]
        began = time.perf_counter()
        judged = judge(
            known, *judging, overlap=point.overlap, hole_free=task.hole_free, learned=point.learned
        )
        judged.run["seconds_detect"] = time.perf_counter() - began
        if task.board is None:
            done[key] = {"runs": [judged.run], "holes": judged.holes, "probes": probes}
        else:
            done[key] = study_rows(known, judged, point.radius_m, hole_free=task.hole_free)
    before = {"runs": named | role, "holes": named, "probes": common}
    after = {"runs": of_map | seconds}
    rows = {
        name: [{**before.get(name, common | role), **row, **after.get(name, {})} for row in found]
        for name, found in done[key].items()
    }
    return rows | {"registrations": [{**common, **role, **row} for row in registrations]}


def _board_rows(
    task: TrialTask, set_up: SetUp, clouds: dict[int, Cloud], points: Sequence[PointTask]
) -> Rows:
    """Return rows by variant and number of frames: "probes", errors of z; "noise", as in
    `tables.trials.NOISE`."""
    pair = [frame.z_m for frame in islice(capture_of(set_up, 0, task, 2).frames(), 2)]
    noise = pair_noise(pair[0], pair[-1], set_up.bare)
    rows: Rows = {"probes": [], "noise": []}
    for variant, frames in sorted({(point.variant, point.frames) for point in points}):
        common = {"variant": variant, "frames": frames, "repeat": task.repeat}
        cloud = clouds[frames]
        errors_m = (
            cloud.points_m[..., 2].ravel()[set_up.probes] - set_up.seen_z_m.ravel()[set_up.probes]
        )
        rows["probes"].append({**common, "error_tenth_um": _tenth_um(errors_m)})
        share = float(cloud.valid[set_up.on_board].mean())
        pitch = dict(zip(("pitch_u_mm", "pitch_v_mm"), set_up.pitch_mm, strict=True))
        rows["noise"].append({**common, "valid_share": share, **pitch, **noise})
    return rows


def _tenth_um(errors_m: np.ndarray) -> list[int | None]:
    """Return errors in whole tenths of a micrometre, which keep records small."""
    return [round(float(error) * 1e7) if np.isfinite(error) else None for error in errors_m]


def pair_noise(
    first_z_m: np.ndarray, second_z_m: np.ndarray, where: np.ndarray
) -> dict[str, float]:
    """Return the standard deviation of one frame's temporal noise and its correlations, from two
    frames' z (h, w) in metres without their median difference. Only valid pixels in ``where`` (h,
    w) count; NaN if there are too few."""
    difference = (first_z_m.astype(float) - second_z_m.astype(float)) / np.sqrt(2)
    valid = where & np.isfinite(difference)
    if valid.sum() < FEWEST_PAIRS:
        return {"single_frame_mm": np.nan} | {
            f"correlation_{way}{lag}": np.nan for way in "uv" for lag in LAGS
        }
    noise = np.where(valid, difference - np.median(difference[valid]), 0.0)
    found = {"single_frame_mm": float(np.sqrt((noise[valid] ** 2).mean())) / MM}
    for way, turned, mask in (("u", noise, valid), ("v", noise.T, valid.T)):
        for lag in LAGS:
            both = mask[:, :-lag] & mask[:, lag:]
            a = turned[:, :-lag][both]
            b = turned[:, lag:][both]
            power = np.sqrt((a @ a) * (b @ b))
            enough = len(a) >= FEWEST_PAIRS and power > 0
            found[f"correlation_{way}{lag}"] = float(a @ b / power) if enough else float("nan")
    return found
