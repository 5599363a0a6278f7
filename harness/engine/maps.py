"""The maps that the points of one trial ask for, from the same views: what several points share is made once."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, TypeVar, cast

import numpy as np

from detectors.mapping.merge import Merged, merge, prepare
from detectors.mapping.settings import MappingConfig
from detectors.registration.register import register
from detectors.registration.registered import Registration, predicted_error_m
from detectors.registration.settings import PAIRWISE
from detectors.views import PreparedView, View
from harness.engine.setup import KnownCloud, SetUp, known_map
from harness.vocabulary.capture import Cloud
from harness.vocabulary.geometry import invert, transform_points
from harness.vocabulary.seeds import canonical_json
from harness.vocabulary.units import MM
from scenes.perspectives import AnyViews, T_reference_view_of, guessed_T_reference_view

Made = TypeVar("Made")
BOARD_STEPS = 9
"""Places along each side of the board at which a registration's error is taken."""


class MapMaker:
    """Maps of one trial: ``clouds`` by view, then by number of frames. ``poses``: the views' declaration; ``labels``
    tell this trial's errors of the nominal poses apart from another's."""

    def __init__(
        self,
        set_ups: Sequence[SetUp],
        clouds: Sequence[Mapping[int, Cloud]],
        poses: AnyViews,
        labels: Sequence[str | int],
        *,
        hole_free: bool,
    ) -> None:
        self._set_ups = set_ups
        self._clouds = clouds
        self._hole_free = hole_free
        self._made: dict[str, Any] = {}
        self._told: set[str] = set()
        stands = tuple(set_up.target.pose for set_up in set_ups)
        numbers = range(len(set_ups))
        self.truth = tuple(T_reference_view_of(stands, number) for number in numbers)
        self.guesses = tuple(guessed_T_reference_view(poses, stands, number, *labels) for number in numbers)

    def count(self, mapping: MappingConfig) -> int:
        """Number of views that a mapping uses."""
        return mapping.views or len(self._set_ups)

    def key(self, mapping: MappingConfig, frames: int) -> str:
        """Equal for mappings that make the same map: with one view there is nothing to register."""
        return canonical_json([self._registration_key(mapping, frames), mapping.merge.to_data()])

    def known(self, mapping: MappingConfig, frames: int) -> KnownCloud:
        """The map with the truth on it."""

        def make() -> KnownCloud:
            merged = self.merged(mapping, frames)
            hole_free = self._hole_free
            return known_map(self._set_ups[0], merged.cloud, merged.T_reference_cloud, hole_free=hole_free)

        return self._once(make, "known", self.key(mapping, frames))

    def merged(self, mapping: MappingConfig, frames: int) -> Merged:
        """The map."""

        def make() -> Merged:
            views, registrations = self.prepared(mapping, frames), self.registrations(mapping, frames)
            return merge(views, registrations, mapping.merge)

        return self._once(make, "merged", self.key(mapping, frames))

    def prepared(self, mapping: MappingConfig, frames: int) -> tuple[PreparedView, ...]:
        """The views with their targets cut out and their marks found."""
        numbers = range(self.count(mapping))
        return tuple(self._prepared(number, mapping, frames) for number in numbers)

    def registrations(self, mapping: MappingConfig, frames: int) -> tuple[Registration, ...]:
        """One for each view."""
        method = mapping.registration.method

        def make() -> tuple[Registration, ...]:
            views = self.prepared(mapping, frames)
            if method not in PAIRWISE:
                return register(views, mapping.registration)
            return self._to_the_first(mapping, frames)[: len(views)]

        return self._once(make, "registrations", self._registration_key(mapping, frames))

    def registration_rows(self, mapping: MappingConfig, frames: int) -> Iterator[dict[str, Any]]:
        """A row for each view but the first, the first time that its registration is asked for; columns as in
        `harness.evaluation.summary.ResultTables`."""
        key = self._registration_key(mapping, frames)
        if key in self._told or self.count(mapping) == 1:
            return
        self._told.add(key)
        views = self.prepared(mapping, frames)
        for number, registration in enumerate(self.registrations(mapping, frames)):
            if number > 0:
                yield self._registration_row(number, registration, views[number])

    def seconds(self, mapping: MappingConfig, frames: int) -> float:
        """Seconds that registering and merging took, whether for this point or for one that shares it."""
        spent = sum(registration.seconds for registration in self.registrations(mapping, frames))
        return float(spent + self.merged(mapping, frames).seconds)

    def _registration_key(self, mapping: MappingConfig, frames: int) -> str:
        count = self.count(mapping)
        registration = mapping.registration.to_data() if count > 1 else None
        return canonical_json([count, frames, mapping.crop.to_data(), mapping.marks.to_data(), registration])

    def _prepared(self, number: int, mapping: MappingConfig, frames: int) -> PreparedView:
        def make() -> PreparedView:
            view = View(f"view {number}", self._clouds[number][frames], self.guesses[number])
            return prepare(view, mapping)

        key = canonical_json([number, frames, mapping.crop.to_data(), mapping.marks.to_data()])
        return self._once(make, "prepared", key)

    def _to_the_first(self, mapping: MappingConfig, frames: int) -> tuple[Registration, ...]:
        """Every view that has such an average, registered to the first by itself: fewer views are the first of more."""

        def make() -> tuple[Registration, ...]:
            numbers = [number for number, clouds in enumerate(self._clouds) if frames in clouds]
            views = [self._prepared(number, mapping, frames) for number in numbers]
            return register(views, mapping.registration)

        parts = [frames, mapping.crop.to_data(), mapping.marks.to_data(), mapping.registration.to_data()]
        return self._once(make, "to the first", canonical_json(parts))

    def _once(self, make: Callable[[], Made], what: str, key: str) -> Made:
        if what + key not in self._made:
            self._made[what + key] = make()
        return cast("Made", self._made[what + key])

    def _registration_row(self, number: int, registration: Registration, view: PreparedView) -> dict[str, Any]:
        board = _board_points_m(self._set_ups[0])
        normal = self._set_ups[0].T_camera_board[:3, 2]
        errors = (
            registration_error_m(T, self.truth[number], board, normal)
            for T in (registration.T_reference_view, self.guesses[number])
        )
        (in_plane, across), guessed = errors
        predicted = predicted_error_m(registration, board, normal)
        return {
            "view": number,
            "method": registration.method,
            "tre_mm": float(np.hypot(in_plane, across)) / MM,
            "tre_in_plane_mm": in_plane / MM,
            "tre_across_mm": across / MM,
            "predicted_in_plane_mm": predicted[0] / MM,
            "predicted_across_mm": predicted[1] / MM,
            "guess_tre_mm": float(np.hypot(*guessed)) / MM,
            "residual_mm": registration.residual_m / MM,
            "overlap": registration.overlap,
            "pairs": registration.pairs,
            "marks": len(view.marks.trusted),
            "iterations": registration.iterations,
            "converged": registration.converged,
            "seconds": registration.seconds,
            "failure": registration.failure,
        }


def registration_error_m(
    T_reference_view: np.ndarray, true_T_reference_view: np.ndarray, points_m: np.ndarray, normal: np.ndarray
) -> tuple[float, float]:
    """Root mean square target registration error over points (n, 3) of the reference frame, metres: in the plane
    across ``normal`` (3,), and along it (Fitzpatrick, West and Maurer 1998).

    Against the true poses, so an error that a whole view shares counts: a camera that ranges d too far displaces what
    it sees under an angle a by d sin(a) in the plane, marks and holes alike, though they still coincide in the map.
    """
    moved = transform_points(T_reference_view @ invert(true_T_reference_view), points_m) - points_m
    across = moved @ normal
    in_plane = np.linalg.norm(moved - across[:, None] * normal, axis=-1)
    return float(np.sqrt((in_plane**2).mean())), float(np.sqrt((across**2).mean()))


def _board_points_m(first: SetUp) -> np.ndarray:
    """(n, 3) places over the whole face, in the reference view's camera frame."""
    size = first.target.board
    x, y = (np.linspace(-0.5, 0.5, BOARD_STEPS) * side * MM for side in (size.width_mm, size.height_mm))
    grid = np.stack([*np.meshgrid(x, y), np.zeros((BOARD_STEPS, BOARD_STEPS))], axis=-1).reshape(-1, 3)
    return transform_points(first.T_camera_board, grid)
