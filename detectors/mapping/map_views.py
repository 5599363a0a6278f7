"""The whole way from views to one cloud."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from detectors.crop import crop
from detectors.mapping.merge import Merged, merge
from detectors.mapping.settings import MappingConfig
from detectors.marks.find import find_marks
from detectors.registration.register import register
from detectors.registration.registered import Registration
from detectors.views import PreparedView, View


@dataclass(frozen=True)
class Mapped:
    """Views, where each stands, and the cloud that they make."""

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
