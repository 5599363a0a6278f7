"""The clouds that the points of a trial share: averages of one view, or maps of several.

`ViewClouds` and `MapClouds` answer the same questions about a point's cloud."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from detectors.crop import AnyCrop, NoCrop
from detectors.views.mapping.merge import Merged, merge, prepare
from detectors.views.mapping.settings import MappingConfig
from detectors.views.registration.register import register
from detectors.views.registration.registered import Registration, predicted_error_m
from detectors.views.registration.settings import PAIRWISE
from detectors.views.view import PreparedView, View
from harness.experiment.schema import AnyReference
from harness.records.rows import NoiseRow, Origin, ProbesRow, RegistrationRow, Role
from harness.trials.averages import Averaging
from harness.trials.board import Board, BoardRef, LabelledCloud, face_errors_m, load_board
from harness.trials.judge import Criteria, detector_of
from harness.trials.references import Recorded, ReferenceBoards, compared
from harness.vocabulary.geometry import MM, Cloud, invert, transform_points
from harness.vocabulary.seeds import canonical_json
from scenes.perspectives import AnyViews, T_reference_view_of, guessed_T_reference_view
from scenes.sensor.source import SimulatedCapture

NOISE_FRAMES = 2  # frames whose difference shows the noise of one
LAGS = (1, 2, 3)  # distances in pixels for the correlation of noise
# fewest pairs of pixels for a correlation; with fewer, its standard error would exceed 0.14
FEWEST_PAIRS = 50
BOARD_STEPS = 9  # points along each side of the board where a registration's error is evaluated


@dataclass(frozen=True)
class TrialPoint:
    """A point's part of a trial: what it makes of the frames."""

    digest: str
    """Digest of the point, which names its results."""
    variant: str
    """Name of its set-up."""
    frames: int
    """Number of frames to average."""
    averaging: Averaging
    """The average of the frames."""
    criteria: Criteria
    """The detector that judges the cloud, its threshold, and what counts as a hit."""
    mapping: MappingConfig | None = None
    """Registration and merge of the clouds of several views; None for a single view."""
    reference: AnyReference | None = None
    """What the cloud is compared with; None: a surface that is fitted to it."""
    left_out: tuple[BoardRef, ...] = ()
    """The hole-free board with the damage that the point's own set-up leaves out; empty: the
    trial's."""


@dataclass(frozen=True)
class MapFacts:
    """Facts on the making of a map."""

    views_used: int | None = None
    """Number of merged views; None for a single view."""
    views_left_out: int | None = None
    """Number of views whose registration failed."""
    seconds_map: float | None = None
    """Time of registration and merging, even if another point shares them."""


@dataclass(frozen=True)
class ViewClouds:
    """Averages of one view of a board."""

    board: Board
    """The board in this view."""
    averages: Mapping[int, Cloud]
    """Clouds by number of frames."""
    first_frames: SimulatedCapture
    """The first `NOISE_FRAMES` frames, whose difference is noise."""
    seed: int
    """Seed of the noise."""
    labels: tuple[str | int, ...]
    """Labels of the random stream."""
    references: ReferenceBoards
    """What the board may be compared with."""
    _compared: dict[str, Cloud] = field(default_factory=dict)

    def key(self, point: TrialPoint) -> str:
        """Return a text that is equal for points that see the same cloud."""
        if point.reference is None:
            return str(point.frames)
        return canonical_json([point.frames, point.reference.to_data(), _crop(point).to_data()])

    def cloud(self, point: TrialPoint) -> Cloud:
        """Return what a detector sees."""
        average = self.averages[point.frames]
        if point.reference is None:
            return average
        key = self.key(point)
        if key not in self._compared:
            self._compared[key] = compared(
                average,
                self.board.target.board,
                point.reference,
                boards=self.references,
                recorded=Recorded(point.frames, point.averaging, _crop(point), self.seed),
                labels=self.labels,
            )
        return self._compared[key]

    def labelled(self, point: TrialPoint) -> LabelledCloud:
        """Return the cloud with the truth."""
        board = self.board
        if point.left_out:
            (shown,) = point.left_out
            board = load_board(shown)
        return board.labelled(self.cloud(point))

    def probes_row(self, point: TrialPoint, origin: Origin) -> ProbesRow:
        """Return the errors of z at the board's probes."""
        z_m = self.averages[point.frames].points_m[..., 2].ravel()
        seen_z_m = self.board.seen_z_m.ravel()
        return _probes_row(origin, z_m[self.board.probes] - seen_z_m[self.board.probes])

    def noise_rows(self, point: TrialPoint, origin: Origin) -> list[NoiseRow]:
        """Return the row of an average's pixels and of the noise of single frames."""
        pitch_u_mm, pitch_v_mm = self.board.pitch_mm
        is_valid = self.averages[point.frames].valid[self.board.on_board]
        row = NoiseRow(
            variant=origin.variant,
            frames=origin.frames,
            repeat=origin.repeat,
            valid_share=float(is_valid.mean()),
            pitch_u_mm=pitch_u_mm,
            pitch_v_mm=pitch_v_mm,
            **self.frame_noise,
        )
        return [row]

    @cached_property
    def frame_noise(self) -> dict[str, float]:
        """Noise of single frames on the undamaged face, as `pair_noise` returns it."""
        first, second = self.first_frames.frames()
        return pair_noise(first.z_m, second.z_m, self.board.bare)

    def map_facts(self, point: TrialPoint) -> MapFacts:
        """Return no facts: a single view is not mapped."""
        return MapFacts()

    def registration_rows(
        self, point: TrialPoint, origin: Origin, role: Role
    ) -> list[RegistrationRow]:
        """Return no rows: a single view is not registered."""
        return []


def _crop(point: TrialPoint) -> AnyCrop:
    """Return how a point's detector, which has a surface, cuts out the board."""
    detector: Any = detector_of(point.criteria.detector, point.criteria.settings_json)
    crop: AnyCrop = getattr(detector.settings, "crop", NoCrop())
    return crop


@dataclass
class MapClouds:
    """Maps of several views of a board. What several points share is made once."""

    boards: Sequence[Board]
    """The board in each view; the first view is the reference."""
    averages: Sequence[Mapping[int, Cloud]]
    """Clouds by view, then by number of frames."""
    poses: AnyViews
    """Declaration of the views, with the errors of their nominal poses."""
    labels: tuple[str | int, ...]
    """Labels of the random stream of these errors."""
    _prepared: dict[str, PreparedView] = field(default_factory=dict)
    _registered: dict[str, tuple[Registration, ...]] = field(default_factory=dict)
    _merged: dict[str, Merged] = field(default_factory=dict)
    _labelled: dict[str, LabelledCloud] = field(default_factory=dict)
    _reported: set[str] = field(default_factory=set)
    """Keys of the registrations whose rows have been returned."""

    @cached_property
    def truth(self) -> list[np.ndarray]:
        """True T_reference_view (4, 4) of each view."""
        stands = tuple(board.target.pose for board in self.boards)
        return [T_reference_view_of(stands, number) for number in range(len(stands))]

    @cached_property
    def guesses(self) -> list[np.ndarray]:
        """Nominal T_reference_view (4, 4) of each view, from which registration starts."""
        stands = tuple(board.target.pose for board in self.boards)
        return [
            guessed_T_reference_view(self.poses, stands, number, *self.labels)
            for number in range(len(stands))
        ]

    def count(self, point: TrialPoint) -> int:
        """Return the number of views that a point maps."""
        return mapping_of(point).views or len(self.boards)

    def key(self, point: TrialPoint) -> str:
        """Return a text that is equal for points that see the same map."""
        mapping = mapping_of(point)
        return canonical_json([self._registration_key(point), mapping.merge.to_data()])

    def cloud(self, point: TrialPoint) -> Cloud:
        """Return what a detector sees."""
        return self.merged(point).cloud

    def labelled(self, point: TrialPoint) -> LabelledCloud:
        """Return the map with the truth."""
        key = self.key(point)
        if key not in self._labelled:
            merged = self.merged(point)
            self._labelled[key] = self.boards[0].labelled_map(
                merged.cloud, merged.T_reference_cloud
            )
        return self._labelled[key]

    def probes_row(self, point: TrialPoint, origin: Origin) -> ProbesRow:
        """Return the errors of the map at the probes of the first view, across the face."""
        first = self.boards[0]
        places_m = first.board_xy_m.reshape(-1, 2)[first.probes]
        return _probes_row(origin, face_errors_m(self.labelled(point), places_m))

    def noise_rows(self, point: TrialPoint, origin: Origin) -> list[NoiseRow]:
        """Return no rows: the noise of single frames belongs to a single view."""
        return []

    def map_facts(self, point: TrialPoint) -> MapFacts:
        """Return how the map was made."""
        merged = self.merged(point)
        views_used = len(merged.views_used)
        spent_s = sum(registration.seconds for registration in self.registrations(point))
        return MapFacts(
            views_used=views_used,
            views_left_out=self.count(point) - views_used,
            seconds_map=float(spent_s + merged.seconds),
        )

    def registration_rows(
        self, point: TrialPoint, origin: Origin, role: Role
    ) -> list[RegistrationRow]:
        """Return a row for each view but the first, once for each registration."""
        key = self._registration_key(point)
        if key in self._reported or self.count(point) == 1:
            return []
        self._reported.add(key)
        views = self.prepared(point)
        registrations = self.registrations(point)
        rows = []
        for number in range(1, len(views)):
            row = self._registration_row(number, views[number], registrations[number], origin, role)
            rows.append(row)
        return rows

    def merged(self, point: TrialPoint) -> Merged:
        """Return the map."""
        key = self.key(point)
        if key not in self._merged:
            views = self.prepared(point)
            registrations = self.registrations(point)
            self._merged[key] = merge(views, registrations, mapping_of(point).merge)
        return self._merged[key]

    def prepared(self, point: TrialPoint, count: int | None = None) -> tuple[PreparedView, ...]:
        """Return the views that the mapping uses, or the first ``count``, with their target cut
        out and their marks found."""
        if count is None:
            count = self.count(point)
        mapping = mapping_of(point)
        settings = [mapping.crop.to_data(), mapping.marks.to_data()]
        views = []
        for number in range(count):
            key = canonical_json([number, point.frames, *settings])
            if key not in self._prepared:
                cloud = self.averages[number][point.frames]
                view = View(f"view {number}", cloud, self.guesses[number])
                self._prepared[key] = prepare(view, mapping)
            views.append(self._prepared[key])
        return tuple(views)

    def registrations(self, point: TrialPoint) -> tuple[Registration, ...]:
        """Return the registration of each view that the mapping uses."""
        mapping = mapping_of(point)
        count = self.count(point)
        registered = count
        key = self._registration_key(point)
        if mapping.registration.method in PAIRWISE:
            # each view is registered to the first alone: all mappings share the longest sequence
            key = canonical_json([point.frames, *_registration_settings(mapping)])
            registered = max(sum(point.frames in averages for averages in self.averages), count)
        if key not in self._registered:
            views = self.prepared(point, registered)
            self._registered[key] = tuple(register(views, mapping.registration))
        return self._registered[key][:count]

    def _registration_key(self, point: TrialPoint) -> str:
        count = self.count(point)
        crop, marks, registration = _registration_settings(mapping_of(point))
        if count == 1:
            registration = None
        return canonical_json([count, point.frames, crop, marks, registration])

    def _registration_row(
        self,
        number: int,
        view: PreparedView,
        registration: Registration,
        origin: Origin,
        role: Role,
    ) -> RegistrationRow:
        """Return the row of one view: errors over a grid of points of the board."""
        T_camera_board = self.boards[0].T_camera_board
        points_m = transform_points(T_camera_board, board_grid_m(self.boards[0]))
        normal = T_camera_board[:3, 2]
        in_plane_m, across_m = registration_error_m(
            registration.T_reference_view, self.truth[number], points_m, normal
        )
        guessed_m = registration_error_m(self.guesses[number], self.truth[number], points_m, normal)
        predicted_in_plane_m, predicted_across_m = predicted_error_m(registration, points_m, normal)
        return RegistrationRow(
            origin=origin,
            role=role,
            view=number,
            method=registration.method,
            tre_mm=float(np.hypot(in_plane_m, across_m)) / MM,
            tre_in_plane_mm=in_plane_m / MM,
            tre_across_mm=across_m / MM,
            predicted_in_plane_mm=predicted_in_plane_m / MM,
            predicted_across_mm=predicted_across_m / MM,
            guess_tre_mm=float(np.hypot(*guessed_m)) / MM,
            residual_mm=registration.residual_m / MM,
            overlap=registration.overlap,
            pairs=registration.pairs,
            marks=len(view.marks.trusted),
            iterations=registration.iterations,
            converged=registration.converged,
            seconds=registration.seconds,
            failure=registration.failure,
        )


def _probes_row(origin: Origin, errors_m: np.ndarray) -> ProbesRow:
    """Return the errors (p,) of probes in whole tenths of a micrometre, which keep records
    small."""
    tenths: list[int | None] = []
    for error_m in errors_m:
        tenths.append(round(float(error_m) * 1e7) if np.isfinite(error_m) else None)
    return ProbesRow(
        variant=origin.variant,
        frames=origin.frames,
        repeat=origin.repeat,
        error_tenth_um=tenths,
    )


def mapping_of(point: TrialPoint) -> MappingConfig:
    """Return a point's mapping, which every point of several views has."""
    if point.mapping is None:
        raise ValueError(f"{point.variant}: several views need a mapping into one cloud")
    return point.mapping


def _registration_settings(mapping: MappingConfig) -> list[object]:
    """Return the settings that a registration depends on: crop, marks and the method's own."""
    settings = (mapping.crop, mapping.marks, mapping.registration)
    return [part.to_data() for part in settings]


def board_grid_m(board: Board) -> np.ndarray:
    """Return `BOARD_STEPS` squared points (n, 3) over a board's rectangle at z = 0, board frame."""
    sides = board.target.board
    x_m = np.linspace(-0.5, 0.5, BOARD_STEPS) * sides.width_mm * MM
    y_m = np.linspace(-0.5, 0.5, BOARD_STEPS) * sides.height_mm * MM
    grid_x_m, grid_y_m = np.meshgrid(x_m, y_m)
    face_z_m = np.zeros(grid_x_m.shape)
    return np.stack([grid_x_m, grid_y_m, face_z_m], axis=-1).reshape(-1, 3)


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
    T_error = T_reference_view @ invert(true_T_reference_view)
    moved_m = transform_points(T_error, points_m) - points_m
    across_m = moved_m @ normal
    in_plane_m = np.linalg.norm(moved_m - across_m[:, None] * normal, axis=-1)
    return _rms(in_plane_m), _rms(across_m)


def _rms(values: np.ndarray) -> float:
    """Return the root mean square of values (n,)."""
    return float(np.sqrt((values**2).mean()))


def pair_noise(
    first_z_m: np.ndarray, second_z_m: np.ndarray, where: np.ndarray
) -> dict[str, float]:
    """Return the standard deviation of one frame's temporal noise and its correlations (columns of
    `NoiseRow`), from two frames' z (h, w) in metres without their median difference. Only valid
    pixels in ``where`` (h, w) count; NaN if there are too few."""
    difference = (first_z_m.astype(float) - second_z_m.astype(float)) / np.sqrt(2)
    valid = where & np.isfinite(difference)
    if valid.sum() < FEWEST_PAIRS:
        columns = ["single_frame_mm"]
        columns += [f"correlation_{way}{lag}" for way in "uv" for lag in LAGS]
        return dict.fromkeys(columns, np.nan)
    noise = np.where(valid, difference - np.median(difference[valid]), 0.0)
    measured = {"single_frame_mm": _rms(noise[valid]) / MM}
    for lag in LAGS:
        measured[f"correlation_u{lag}"] = _correlation(noise, valid, lag)
        measured[f"correlation_v{lag}"] = _correlation(noise.T, valid.T, lag)
    return measured


def _correlation(noise: np.ndarray, valid: np.ndarray, lag: int) -> float:
    """Return the correlation of valid noise (h, w) between pixels a lag of columns apart."""
    both_valid = valid[:, :-lag] & valid[:, lag:]
    first = noise[:, :-lag][both_valid]
    second = noise[:, lag:][both_valid]
    power = np.sqrt((first @ first) * (second @ second))
    if len(first) < FEWEST_PAIRS or not power > 0:
        return float("nan")
    return float(first @ second / power)
