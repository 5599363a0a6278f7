"""A 2.5-D map: heights over a fitted surface on equal cells, with what is known about each cell."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from detectors.mapping.between_views import BetweenViews
from harness.vocabulary.capture import Cloud, LeftOut, MapViews, Reason
from harness.vocabulary.geometry import Region


@dataclass(frozen=True)
class SurfaceMap:
    """Cells (h, w) at ``x_m`` (w,), ``y_m`` (h,) of the map's frame; ``T_reference_map`` (4, 4) leads to the first
    view's. The frame: z away from the viewer along the target's mean normal, x as near as can be to the first camera's,
    the origin as far before the surface as the first camera.

    ``surface_z_m``: the fitted surface. ``height_m``: mean deviation from it along z, positive behind, NaN where no
    view counts; a deviation belongs to the cell where its ray meets the *surface*, so that the mouth of a hole lies in
    one place for all views. ``variance_m2``: of an intact surface's height: sensor, lens, registration, and what views
    disagree about beyond (``between``). ``temporal_m2``: the part of it that more frames lessen.
    ``spread_m2``: the views' sample variance about their mean, NaN below two; at damage it is large because views see
    different parts of it. ``samples``: frames in the mean. ``seen_by`` (k, h, w) bool: views that count, in the order
    of ``views``; ``map_views``: where their cameras stand in the map's frame. ``direction`` (h, w, 3): mean of the unit
    directions to their cameras, normalised; ``direction_spread_deg``: root mean square angle about it. ``rejected``:
    single observations that were outliers.
    """

    T_reference_map: np.ndarray
    views: tuple[str, ...]
    map_views: MapViews
    x_m: np.ndarray
    y_m: np.ndarray
    cell_m: float
    surface_z_m: np.ndarray
    height_m: np.ndarray
    variance_m2: np.ndarray
    temporal_m2: np.ndarray
    spread_m2: np.ndarray
    samples: np.ndarray
    seen_by: np.ndarray
    direction: np.ndarray
    direction_spread_deg: np.ndarray
    rejected: int
    between: BetweenViews
    rgb: np.ndarray | None
    amplitude: np.ndarray | None

    def cloud(self, n_frames: int, left_out: tuple[LeftOut, ...]) -> Cloud:
        """Return the cloud that a detector sees: an organised cloud in the map's frame. ``variance_m2`` over ``count``
        is the temporal part of the variance, ``mean_variance_m2`` all of it, which one view does not know of itself
        (then None). Rounding is in it, so there is no rounding step left."""
        x, y = np.meshgrid(self.x_m, self.y_m)
        known = np.isfinite(self.height_m)
        points = np.stack([x, y, self.surface_z_m + self.height_m], axis=-1)
        points[~known] = np.nan
        return Cloud(
            points_m=points,
            reason=np.where(known, Reason.VALID, Reason.NO_RETURN).astype(np.uint8),
            count=self.samples,
            variance_m2=self.temporal_m2 * self.samples,
            region=Region(0, len(self.y_m), 0, len(self.x_m)),
            z_step_m=0.0,
            n_frames=n_frames,
            rgb=self.rgb,
            amplitude=self.amplitude,
            left_out=left_out,
            projection="parallel",
            mean_variance_m2=self.variance_m2 if len(self.views) > 1 else None,
            map_views=self.map_views,
        )
