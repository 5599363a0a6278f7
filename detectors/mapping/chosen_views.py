"""The views that go into a merge: those whose registration may be trusted, in the frame of the first."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from detectors.registration.registered import Registration
from detectors.views import PreparedView
from harness.vocabulary.capture import Cloud
from harness.vocabulary.errors import UserError
from harness.vocabulary.geometry import transform_points


@dataclass(frozen=True)
class ChosenView:
    """A view that goes in, and where it stands."""

    prepared: PreparedView
    registration: Registration

    @property
    def cloud(self) -> Cloud:
        """The cloud in its own camera's frame."""
        return self.prepared.view.cloud

    @property
    def inside(self) -> np.ndarray:
        """(h, w) bool: valid pixels of the target."""
        return self.prepared.inside & self.cloud.valid

    @cached_property
    def points_reference_m(self) -> np.ndarray:
        """(n, 3) the target's points in the first view's frame, in the order of the grid."""
        return transform_points(self.registration.T_reference_view, self.cloud.points_m[self.inside])

    @cached_property
    def slope_step(self) -> float:
        """Step of x/z and y/z from pixel to pixel, the median; without a grid as if the points lay on a square one."""
        points = self.cloud.points_m
        with np.errstate(invalid="ignore"):
            slopes = np.where(self.inside[..., None], points[..., :2] / points[..., 2:], np.nan)
        if self.cloud.organised and min(self.inside.shape) > 1:
            steps = np.concatenate([np.abs(np.diff(slopes[..., k], axis=1 - k)).ravel() for k in (0, 1)])
            if np.isfinite(steps).any():
                return float(np.nanmedian(steps))
        extent = np.nanmax(slopes, axis=(0, 1)) - np.nanmin(slopes, axis=(0, 1))
        return float(np.sqrt(extent.prod() / self.inside.sum()))


def choose(
    views: Sequence[PreparedView], registrations: Sequence[Registration]
) -> tuple[tuple[ChosenView, ...], tuple[str, ...]]:
    """Views whose registration did not fail and that hold points of the target, and a note on each one left out.

    Raises UserError where none is left, and where a transform is not finite although nothing is said to have failed.
    """
    kept: list[ChosenView] = []
    notes: list[str] = []
    for view, registration in zip(views, registrations, strict=True):
        name = view.view.name
        if registration.failure:
            notes.append(f"{name} left out: {registration.failure}")
        elif not (view.inside & view.view.cloud.valid).any():
            notes.append(f"{name} left out: none of its points belong to the target")
        elif not np.isfinite(registration.T_reference_view).all():
            raise UserError(f"{name}: its registration ({registration.method}) is not finite", fix="register it anew")
        else:
            kept.append(ChosenView(view, registration))
    if not kept:
        raise UserError(
            "no view is left to merge" + (": " + "; ".join(notes) if notes else ""),
            legal="at least one view that is registered and holds points of the target",
            fix="mend the views or their crop, or choose another way to register",
        )
    return tuple(kept), tuple(notes)
