"""The way from views to one cloud: prepare, register, and merge by the method that the settings name."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from detectors.crop import crop
from detectors.mapping.chosen_views import choose
from detectors.mapping.fusion import fuse
from detectors.mapping.grid_merge import merge_on_grid
from detectors.mapping.settings import AnyMerge, FusedMerge, GridMerge, MappingConfig
from detectors.mapping.surface_map import SurfaceMap
from detectors.mapping.volume import integrate
from detectors.marks.find import find_marks
from detectors.registration.register import register
from detectors.registration.registered import Registration
from detectors.views import PreparedView, View
from harness.vocabulary.capture import Cloud
from harness.vocabulary.units import MM


@dataclass(frozen=True)
class Merged:
    """One cloud of several views. ``T_reference_cloud`` (4, 4): its frame to the first view's camera frame, the
    identity where it is that frame. ``views_used``: names of those that went in. ``seconds``: of merging.
    ``surface_map``: what a fused map knows beside its cloud; None of the others."""

    cloud: Cloud
    T_reference_cloud: np.ndarray
    views_used: tuple[str, ...]
    seconds: float
    notes: tuple[str, ...] = ()
    surface_map: SurfaceMap | None = None


def merge(views: Sequence[PreparedView], registrations: Sequence[Registration], config: AnyMerge) -> Merged:
    """The views whose registration did not fail as one cloud; works for a single view too.

    Raises UserError where nothing is left to merge.
    """
    began = time.perf_counter()
    chosen, left_out = choose(views, registrations)
    surface_map: SurfaceMap | None = None
    T_reference_cloud, notes = np.eye(4), tuple[str, ...]()
    if isinstance(config, GridMerge):
        cloud = merge_on_grid(chosen, config.step_mm * MM)
    elif isinstance(config, FusedMerge):
        surface_map, notes = fuse(chosen, None if config.cell_mm is None else config.cell_mm * MM)
        clouds = [view.cloud for view in chosen]
        left = tuple(each for cloud in clouds for each in cloud.left_out)
        cloud, T_reference_cloud = surface_map.cloud(sum(c.n_frames for c in clouds), left), surface_map.T_reference_map
    else:
        cloud, notes = integrate(chosen, None if config.voxel_mm is None else config.voxel_mm * MM)
    used = tuple(view.prepared.view.name for view in chosen)
    return Merged(cloud, T_reference_cloud, used, time.perf_counter() - began, left_out + notes, surface_map)


@dataclass(frozen=True)
class Mapped:
    """Views, their registrations, and the cloud that they form."""

    views: tuple[PreparedView, ...]
    registrations: tuple[Registration, ...]
    merged: Merged


def prepare(view: View, config: MappingConfig) -> PreparedView:
    """Cut the target out of a view and find its marks. Raises UserError where the crop leaves nothing."""
    inside = crop(view.cloud, config.crop)
    return PreparedView(view, inside, find_marks(view.cloud, inside, config.marks))


def map_views(views: Sequence[View], config: MappingConfig) -> Mapped:
    """Prepare, register and merge the first ``config.views`` of some views. Raises UserError as its parts do."""
    prepared = tuple(prepare(view, config) for view in views[: config.views])
    registrations = register(prepared, config.registration)
    return Mapped(prepared, registrations, merge(prepared, registrations, config.merge))
