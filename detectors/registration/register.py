"""Registering views by whichever method its settings name."""

from __future__ import annotations

from collections.abc import Sequence

from detectors.registration.registered import Registration
from detectors.registration.settings import AnyRegistration
from detectors.views import PreparedView


def register(views: Sequence[PreparedView], config: AnyRegistration) -> tuple[Registration, ...]:
    """One registration for each view, the first that of the reference.

    Never raises for what the views show: a registration that cannot be trusted says so in its ``failure``. Raises
    UserError where the method needs what these views never have (colour, a pixel grid, a guess).
    """
    raise NotImplementedError
