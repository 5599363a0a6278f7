"""Everything from frames to findings; runs on real captures without Mitsuba. Knows nothing of scenes.

Detectors are found by name: the built-in ones below, others through the entry point group ``tofpod.detectors``.
"""

from __future__ import annotations

import difflib
import importlib
from importlib.metadata import EntryPoint, entry_points
from typing import TYPE_CHECKING, Any, cast

from harness.vocabulary.errors import UserError

if TYPE_CHECKING:
    from detectors.interface import Detector
    from harness.vocabulary.config import Config

GROUP = "tofpod.detectors"
"""Entry points of this group name a class ``C`` with ``C.settings_type`` (a Config) and ``C(settings)`` a Detector."""

BUILT_IN = {"thesis": "detectors.thesis:ThesisDetector"}


def detector_names() -> tuple[str, ...]:
    """Every known name, sorted. Raises UserError where a name is taken twice."""
    return tuple(sorted(_registry()))


def detector_type(name: str) -> Any:
    """The class behind a name; its ``settings_type`` is the Config that validates its settings.

    Raises UserError on an unknown name (with the nearest one), on a name taken twice, and where a plug-in cannot be
    imported.
    """
    registry = _registry()
    if name not in registry:
        near = difflib.get_close_matches(name, registry, n=1)
        raise UserError(
            f"unknown detector {name!r}" + (f"; did you mean {near[0]!r}?" if near else ""),
            legal=", ".join(sorted(registry)),
            fix=f"install the package that offers it through the entry point group {GROUP!r}",
        )
    return _imported(name, registry[name])


def load_detector(name: str, settings: dict[str, Any]) -> Detector:
    """The detector of that name with these settings (plain data, as YAML holds it).

    Raises UserError as `detector_type`, and where the settings are not legal (every problem at once).
    """
    from pydantic import ValidationError

    kind = detector_type(name)
    settings_type = cast("type[Config]", kind.settings_type)
    try:
        return cast("Detector", kind(settings_type.from_data(settings)))
    except ValidationError as error:
        problems = [f"{'.'.join(map(str, p['loc'])) or 'settings'}: {p['msg']}" for p in error.errors()]
        raise UserError(f"settings of detector {name!r}:\n  " + "\n  ".join(problems)) from error


def _registry() -> dict[str, str]:
    """Name to ``module:attribute``."""
    known = dict(BUILT_IN)
    origin = dict.fromkeys(BUILT_IN, "tofpod")
    for entry in _plug_ins():
        offered_by = entry.dist.name if entry.dist is not None else entry.value
        if entry.name in known and known[entry.name] != entry.value:
            raise UserError(
                f"two detectors are called {entry.name!r}: {known[entry.name]} ({origin[entry.name]})"
                f" and {entry.value} ({offered_by})",
                fix="uninstall one of the two packages, or rename its entry point",
            )
        known[entry.name] = entry.value
        origin[entry.name] = offered_by
    return known


def _plug_ins() -> tuple[EntryPoint, ...]:
    return tuple(entry_points(group=GROUP))


def _imported(name: str, target: str) -> Any:
    module, _, attribute = target.partition(":")
    try:
        return getattr(importlib.import_module(module), attribute)
    except (ImportError, AttributeError) as error:
        if name in BUILT_IN:
            raise
        raise UserError(
            f"detector {name!r} ({target}) cannot be loaded: {error}",
            fix="repair or uninstall the package that offers it",
        ) from error
