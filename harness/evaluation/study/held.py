"""What an experiment's declaration says was varied and what was held, in sentences, from its plain data."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

SPREADS = {
    "distance_jitter_mm": "its distance by ±{} mm",
    "offset_mm": "its place across the view by ±{} mm, both ways",
    "tilt_deg": "its tilt by ±{}° about two axes",
    "roll_deg": "its roll by ±{}°",
}
"""Of a family of boards: half-widths of uniform distributions, by the key that declares them."""
DRAWN = {"diameter_mm": "diameter", "depth_mm": "depth"}
"""Of each damage: ranges, by the key that declares them."""
GROUPS = (
    ("Boards", ("source.target",)),
    ("Camera", ("source.camera",)),
    ("Views", ("source.views",)),
    ("Averaging", ("capture",)),
    ("Map", ("mapping",)),
    ("Detector", ("detector",)),
    ("Render", ("source.render",)),
)
"""What is held, under one heading for each part of the declaration."""
NOT_HELD = ("source.target.seed", "source.target.damage", "source.target.sizes")
"""Drawn at random, or told elsewhere."""


def number(value: float) -> str:
    """Three significant digits without an exponent where four figures will do."""
    if value != 0 and (abs(value) >= 1e4 or abs(value) < 1e-3):
        return f"{value:.3g}"
    return f"{value:.3g}" if abs(value) < 1000 else f"{value:.0f}"


def varied_sentences(facts: Mapping[str, Any]) -> tuple[str, ...]:
    """What was drawn anew for every board of a family: sizes, depths, places, pose, grain; not where it was swept."""
    target = _at(facts, "source.target")
    if not isinstance(target, Mapping) or target.get("name") != "drawn":
        return ()
    damage = target.get("damage", {})
    drawn = [
        f"{name} from {_range(damage[key])} mm"
        for key, name in DRAWN.items()
        if key in damage and not is_swept(facts, f"source.target.damage.{key}")
    ]
    law = {"uniform": "uniform", "log": "uniform in its logarithm"}.get(str(damage.get("sizes")), "")
    said = []
    if drawn:
        parts = f"one from each of {damage.get('per_board')} equal parts of its range on every board"
        how = f", the diameter {law}, {parts}" if law else ""
        said.append(f"Drawn for every damage: {' and '.join(drawn)}{how}; and its place on the board.")
    pose = [
        text.format(f"{target[key]:g}")
        for key, text in SPREADS.items()
        if target.get(key) and not is_swept(facts, f"source.target.{key}")
    ]
    if pose:
        said.append(f"Drawn uniformly for every board: {', '.join(pose)}.")
    if target.get("material", {}).get("grain_contrast"):
        said.append("Every board has a grain of its own.")
    return tuple(said)


def is_swept(facts: Mapping[str, Any], path: str) -> bool:
    """Whether an axis changes what stands at a dotted path, with its surroundings or in part."""
    return any(_under(path, [axis]) or _under(axis, [path]) for axis in facts.get("sweep") or {})


def swept_sentences(facts: Mapping[str, Any]) -> tuple[str, ...]:
    """The axes of the experiment with their values."""
    sweep = facts.get("sweep") or {}
    return tuple(f"{path}: {', '.join(_plain(value) for value in values)}." for path, values in sweep.items())


def held_sentences(facts: Mapping[str, Any]) -> tuple[str, ...]:
    """Everything that was the same for all: one sentence for each part of the declaration."""
    swept = tuple(facts.get("sweep") or {})
    said = []
    for name, roots in GROUPS:
        leaves = [leaf for root in roots for leaf in _leaves(_at(facts, root), root)]
        kept = [
            f"{path.removeprefix(roots[0]).lstrip('.')} {value}"
            for path, value in leaves
            if not _under(path, NOT_HELD) and not _under(path, swept) and path.rsplit(".", 1)[-1] not in SPREADS
        ]
        if kept:
            said.append(f"{name}: {', '.join(kept)}.")
    return tuple(said)


def _leaves(value: Any, path: str) -> Iterator[tuple[str, str]]:
    """(dotted path, text) of everything that was given; nothing for what was not."""
    if isinstance(value, Mapping):
        for key, inner in value.items():
            yield from _leaves(inner, f"{path}.{key}")
    elif value is not None and value != [] and value != () and value != "":
        yield path, _plain(value)


def _under(path: str, roots: Sequence[str]) -> bool:
    return any(path == root or path.startswith(f"{root}.") for root in roots)


def _at(facts: Mapping[str, Any], path: str) -> Any:
    value: Any = facts
    for key in path.split("."):
        if not isinstance(value, Mapping) or key not in value:
            return None
        value = value[key]
    return value


def _range(limits: Any) -> str:
    if isinstance(limits, Sequence) and len(limits) == 2:
        return f"{limits[0]:g} to {limits[1]:g}"
    return _plain(limits)


def _plain(value: Any) -> str:
    if isinstance(value, bool):
        return "on" if value else "off"
    if isinstance(value, int | float):
        return f"{value:g}"
    if isinstance(value, Mapping):
        return "{" + ", ".join(f"{key} {_plain(inner)}" for key, inner in value.items()) + "}"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(_plain(one) for one in value) + "]"
    return str(value)
