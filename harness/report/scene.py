"""Draws the scene of an experiment: camera, target and the surface behind it, from the side and
not to scale."""

from collections.abc import Mapping
from typing import Any

from markupsafe import Markup

from harness.report.blocks import template
from harness.vocabulary.declaration import shape
from harness.vocabulary.path_names import camera_title, value_text

BEHIND = ("source.target.backing.distance_mm", "source.target.backing_distance_mm")
"""Paths of settings for the distance between a target and the surface behind it."""


TARGETS = {"drawn": "target with damage drawn at random", "thesis": "board with eleven holes"}
"""Targets in words; others keep their names."""


def scene_svg(facts: Mapping[str, Any]) -> Markup:
    """Return the picture with its caption; empty if ``facts``, the resolved experiment, hold no
    simulated target."""
    names = _values(facts, "source.camera.name")
    distances_m = _values(facts, "source.target.distance_m")
    if not (names and distances_m):
        return Markup("")
    cameras = [camera_title(name) for name in names]
    distance = f"{distances_m[0]:g} m"
    if len(distances_m) > 1:
        distance = value_text("distance_m", [distances_m[0], distances_m[-1]])
    gaps_mm = [gap_mm for path in BEHIND for gap_mm in _values(facts, path)]
    gap = " or ".join(f"{gap_mm:g} mm" for gap_mm in gaps_mm)
    if len(gaps_mm) > 2:
        gap = f"{min(gaps_mm):g} to {max(gaps_mm):g} mm"
    behind = f", {gap} in front of another surface" if gaps_mm else ""
    target_name = facts["source"]["target"].get("name", "target")
    target = TARGETS.get(target_name, target_name)
    words = f"{', '.join(cameras)} at {distance} from a {target}{behind}. Not to scale."
    picture = template("scene.html").render(
        words=words,
        camera=cameras[0] if len(cameras) == 1 else f"{len(cameras)} cameras",
        distance=distance,
        target="target",
        behind=gap,
    )
    return Markup(picture)


def _values(facts: Mapping[str, Any], path: str) -> list[Any]:
    """Return a setting's values: those of its axis, or the experiment's single value; empty if it
    has none."""
    axes = facts.get("sweep") or {}
    if path in axes:
        return [value for value in axes[path] if value is not None]
    value = shape.get(facts, tuple(path.split(".")))
    return [] if value is None else [value]
