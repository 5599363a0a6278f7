"""Dotted paths and their values as tables show them: ``source.target.distance_m`` becomes
"distance", in m."""

import contextlib
import json
import re
from collections.abc import Iterable
from functools import cache
from importlib import resources
from pathlib import Path
from typing import Any

from harness.vocabulary.text import many

UNITS = {
    "_mrad": "mrad",
    "_deg": "°",
    "_mm": "mm",
    "_nm": "nm",
    "_px": "px",
    "_hz": "Hz",
    "_percent": "%",
    "_m": "m",
}
"""Endings of keys that name a unit; longer endings come first."""
CHOICES = (
    "name",
    "kind",
    "method",
)  # keys that select one of several kinds of what the key before them names
# axes whose values explain themselves
NAMED = ("camera", "detector", "damage", "shape", "compared with")
SHAPES = {"flat": "flat board", "panel": "door panel", "casting": "ribbed casting"}
"""Kinds of a target's shape, in words; others are words."""
ABSENT = "none"
"""Text of a value that is null."""
UNKNOWNS = "unknowns"
"""Key of an experiment's unknowns, and axis of such a study: whether its boards have the stated
values or drawn ones."""
LONGEST = 60  # Characters of a value that a table can show


def names_of(paths: Iterable[str]) -> dict[str, str]:
    """Return a name without unit for each path: its last meaningful key, or the whole path if that
    is not unique."""
    short = {path: _split(path)[0] for path in paths}
    return {
        path: name if list(short.values()).count(name) == 1 else path
        for path, name in short.items()
    }


def unit_of(path: str) -> str:
    """Return the unit that the ending of the last key names, or an empty text."""
    return _split(path)[1]


def value_text(path: str, value: Any) -> str:
    """Return a value with its unit on one short line; a mapping as its kind, then its keys and
    values."""
    name = _split(path)[0]
    if name == "compared with":
        return _reference_text(value)
    if value is None:
        return ABSENT
    if isinstance(value, dict) and value:
        choice = next((key for key in CHOICES if key in value), "")
        parts = []
        if choice:
            kind = str(value[choice])
            parts.append(SHAPES.get(kind, kind) if name == "shape" else kind)
        for key, setting in value.items():
            text = value_text(key, setting)
            if key == "shape":
                parts.append(text)
            elif key != choice:
                parts.append(f"{_split(key)[0]} {text}")
        return on_one_line(", ".join(parts))
    unit = unit_of(path)
    if unit and isinstance(value, list | tuple) and len(value) == 2 and all(map(_is_number, value)):
        low, high = value
        return f"{low:g} {unit}" if low == high else f"{low:g} to {high:g} {unit}"
    text = on_one_line(
        Path(value).stem if path.endswith("camera.name") and str(value).endswith(".yaml") else value
    )
    return f"{value:g} {unit}" if _is_number(value) and unit else text


def _reference_text(value: Any) -> str:
    """Return what boards are compared with, in words."""
    if value is None:
        return "no reference"
    if "parts" in value:
        return many(value["parts"], "good part")
    kinds = {"scan": "an earlier scan", "mesh": "the drawing"}
    return kinds[value["kind"]]


@cache
def camera_title(name: str) -> str:
    """Return the title of one of tofpod's cameras without commas; for any other name or path, its
    words."""
    if re.fullmatch(r"\w+", name):
        file = resources.files("scenes") / "cameras" / f"{name}.yaml"
        title = (
            re.search(r"^title: (.+)$", file.read_text(encoding="utf-8"), re.MULTILINE)
            if file.is_file()
            else None
        )
        if title:
            return title[1].replace(",", "")
    return name.rpartition("/")[2].removesuffix(".yaml").replace("_", " ")


def in_words(variant: str) -> str:
    """Return a set-up's name in words: ``camera=kinect_v2, distance=0.5 m, filter=none`` becomes
    "Kinect v2, distance 0.5 m, no filter"."""
    return ", ".join(_setting_in_words(part) for part in re.split(r", (?=[^=,]+=)", variant))


def _setting_in_words(part: str) -> str:
    name, is_set, text = part.partition("=")
    if not is_set or name.endswith(" "):  # a label of the user's own
        return part
    if re.fullmatch(r"\w+(\.\w+)+", name):
        with contextlib.suppress(ValueError):
            text = value_text(name, json.loads(text))
        name = _split(name)[0]
    if name in NAMED:
        return camera_title(text)
    if text == ABSENT:
        return f"no {name}"
    if re.fullmatch(r"\w+", text):
        text = {"true": "on", "false": "off"}.get(text, text.replace("_", " "))
    albedo = re.fullmatch(r"(.*albedo) (\d+)", name)
    if albedo:
        return f"{albedo[1]} {text} at {albedo[2]} nm"
    return f"{name} {text}".strip()


def differing(value: Any, siblings: Iterable[Any]) -> Any:
    """Return a mapping without the entries that all ``siblings`` share, and with the kind alone of
    an inner mapping that is of another kind in each; return any other value unchanged."""
    sibling_values = list(siblings)
    if not all(isinstance(item, dict) for item in (value, *sibling_values)):
        return value
    kept = {}
    for key, part in value.items():
        parts = [item.get(key) for item in sibling_values]
        if any(other != part for other in parts):
            kept[key] = {"kind": part["kind"]} if _differ_in_kind(parts) else part
    return kept


def _differ_in_kind(values: Iterable[Any]) -> bool:
    """Return whether values are mappings whose kinds all differ, but for equal values."""
    different: list[Any] = []
    for value in values:
        if not isinstance(value, dict) or "kind" not in value:
            return False
        if value not in different:
            different.append(value)
    return len({value["kind"] for value in different}) == len(different)


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def on_one_line(value: Any) -> str:
    """Return a value as text of at most `LONGEST` characters; a mapping starts with its kind, as
    in ``flat {...}``."""
    choice = next((key for key in CHOICES if key in value), "") if isinstance(value, dict) else ""
    if choice:
        settings = {key: part for key, part in value.items() if key != choice}
        text = f"{value[choice]} {json.dumps(settings, ensure_ascii=False)}".replace(
            '"', ""
        ).removesuffix(" {}")
    else:
        text = value if isinstance(value, str) else json.dumps(value, ensure_ascii=False)
    return text if len(text) <= LONGEST else text[: LONGEST - 1] + "…"


def _split(path: str) -> tuple[str, str]:
    keys = path.split(".")
    key = keys[-2] if keys[-1] in CHOICES and len(keys) > 1 else keys[-1]
    ending = next((unit for unit in UNITS if key.endswith(unit) and len(key) > len(unit)), "")
    return key.removesuffix(ending).replace("_", " "), UNITS.get(ending, "")
