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


def scene_svg(facts: Mapping[str, Any]) -> Markup:
    """Return the picture with its caption; empty if ``facts``, the resolved experiment, hold no
    simulated target."""
    cameras = _values(facts, "source.camera.name")
    distances = _values(facts, "source.target.distance_m")
    if not (cameras and distances):
        return Markup("")
    names = [camera_title(name) for name in cameras]
    named = names[0] if len(names) == 1 else f"{len(names)} cameras"
    distance = (
        value_text("distance_m", [distances[0], distances[-1]])
        if len(distances) > 1
        else f"{distances[0]:g} m"
    )
    gaps = [gap for path in BEHIND for gap in _values(facts, path)]
    gap = (
        " or ".join(f"{gap_mm:g} mm" for gap_mm in gaps)
        if len(gaps) < 3
        else f"{min(gaps):g} to {max(gaps):g} mm"
    )
    behind = f", {gap} in front of another surface" if gaps else ""
    target = facts["source"]["target"].get("name", "target")
    target = {
        "drawn": "target with damage drawn at random",
        "thesis": "board with eleven holes",
    }.get(target, target)
    words = f"{', '.join(names)} at {distance} from a {target}{behind}. Not to scale."
    labels = {
        "words": words,
        "camera": named,
        "distance": distance,
        "target": "target",
        "behind": gap,
    }
    return Markup(template("scene.html").render(**labels))


def _values(facts: Mapping[str, Any], path: str) -> list[Any]:
    """Return a setting's values: those of its axis, or the experiment's single value; empty if it
    has none."""
    if path in (axes := facts.get("sweep") or {}):
        return [value for value in axes[path] if value is not None]
    value = shape.get(facts, tuple(path.split(".")))
    return [] if value is None else [value]
