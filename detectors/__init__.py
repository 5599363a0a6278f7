"""The path from frames to findings; it runs on real captures without Mitsuba and does not import
scenes.

Detectors are found by name: the built-in ones below, others through the entry point group
``tofpod.detectors``."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, cast

from harness.vocabulary.extras import require_extra
from harness.vocabulary.plug_ins import PlugIns

if TYPE_CHECKING:
    from detectors.interface import Detector
    from harness.vocabulary.config import Config

GROUP = "tofpod.detectors"
"""Entry points of this group name a class ``C`` with ``C.settings_type`` (a Config) and
``C(settings)`` a Detector."""

BUILT_IN = {
    "fpfh_memory": "detectors.methods.peers:FpfhMemoryDetector",
    "learned": "detectors.methods.learned:LearnedDetector",
    "local": "detectors.methods.local:LocalDetector",
    "m3c2": "detectors.methods.peers:M3c2Detector",
    "matched": "detectors.methods.matched:MatchedDetector",
    "plane_ransac": "detectors.methods.peers:PlaneRansacDetector",
    "thesis": "detectors.methods.thesis:ThesisDetector",
}

NEEDED = {"fpfh_memory": "open3d", "m3c2": "py4dgeo", "plane_ransac": "open3d"}
"""Packages of extras, by detector."""

DETECTORS = PlugIns(GROUP, "detector", lambda: BUILT_IN)


def detector_names() -> tuple[str, ...]:
    """Return every known name, sorted."""
    return DETECTORS.names()


def detector_type(name: str) -> Any:
    """Return the class behind a name; its ``settings_type`` is the Config that validates its
    settings. Raises UserError on an unknown name, a name taken twice, a package that is not
    installed, and a plug-in that is not a detector."""
    from harness.vocabulary.config import Config

    offer = DETECTORS.offer(name)
    package = NEEDED.get(name) if offer.built_in else None
    if package is not None:
        require_extra(package, f"detector {name!r}")
    kind = DETECTORS.load(offer)
    settings_type = getattr(kind, "settings_type", None)
    if not (isinstance(settings_type, type) and issubclass(settings_type, Config)):
        raise DETECTORS.broken(
            offer, "it has no `settings_type` that is a harness.vocabulary.config.Config"
        )
    own_name = getattr(kind, "name", None)
    if isinstance(own_name, str) and own_name != name:
        # results use the detector's own name, experiments that of its entry point
        raise DETECTORS.broken(offer, f"it is called {own_name!r}, but offered as {name!r}")
    return kind


def load_detector(name: str, settings: dict[str, Any]) -> Detector:
    """Return the detector of that name with these settings (plain data, as YAML holds it). Raises
    UserError as `detector_type`, and if the settings are not legal (every problem at once)."""
    from harness.vocabulary.declaration.diagnose import settings_of

    kind = detector_type(name)
    settings_type = cast("type[Config]", kind.settings_type)
    return cast(
        "Detector", kind(settings_of(settings_type, settings, f"settings of detector {name!r}"))
    )
