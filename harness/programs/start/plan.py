"""Turns answers into an experiment, which varies one that comes with tofpod, and into commands."""

import math
import shlex
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from harness.vocabulary.declaration.yaml_source import read_yaml, to_yaml
from harness.vocabulary.files import shipped

PARTS = {
    "board": "detection_limit",
    "sheet": "panel",
    "pipe": "pipe",
    "wall": "crack",
}
"""Experiments whose part, material and surroundings are taken, by the word for the part."""
KINDS = (
    "through",
    "blind",
    "dent",
    "pressed_dent",
    "pressed_bump",
    "protrusion",
    "slot",
    "gouge",
)
"""Kinds of damage that a question can describe: by one size and one depth."""
IMPLANTED = KINDS[:7]
"""Those of `tofpod implant`."""
FRAMES = [1, 50]
SMALLEST = 1 / 3
LARGEST = 2.0
"""Ends of the sizes on the boards as shares of the tolerance, which lies well between them."""
SLOT_LENGTH_MM = 60.0
GOUGE_WIDTH = 0.2
"""Width of a scratch as a share of the length that must be found."""
HIT_RADIUS_MM = 15.0
ROOM_MM = 10.0
"""Least distance of damages beyond two hit radii, and beyond the largest damage."""
FILLED = 0.3
"""Largest share of a board within half of this distance from damage; random places reach 0.5."""


@dataclass(frozen=True)
class Inquiry:
    """An inspection that a user has in mind."""

    camera: str
    """A camera's name, or the path of its file."""
    recording: Path | None
    """A capture of the part by that camera."""
    part: str
    """One of `PARTS`."""
    kind: str
    """One of `KINDS`."""
    tolerance_mm: float
    """The size that must be found; of holes the diameter, of slots the width, of scratches the
    length."""
    depth_mm: float | None
    """None of what goes through the part."""
    distance_m: float
    """From the camera to the part."""

    @property
    def sizes_mm(self) -> list[float]:
        """Ends of the sizes on the boards. A ball's dent is at least twice as wide as deep."""
        smallest_mm = SMALLEST * self.tolerance_mm
        if self.kind == "dent" and self.depth_mm is not None:
            smallest_mm = max(smallest_mm, 2 * self.depth_mm)
        return [_rounded(smallest_mm), _rounded(LARGEST * self.tolerance_mm)]


def experiment_text(inquiry: Inquiry, name: str) -> str:
    """Return the YAML of an experiment that measures the limit."""
    data = dict(read_yaml(shipped("experiments") / f"{PARTS[inquiry.part]}.yaml").data)
    data["name"] = name
    data["title"] = f"Is a damage of {inquiry.tolerance_mm:g} mm ({inquiry.kind}) found?"
    target = dict(data["source"]["target"])
    target["damage"] = _damage(inquiry, target)
    target["apart_mm"] = _apart_mm(inquiry)
    target["distance_m"] = inquiry.distance_m
    data["source"] = {**data["source"], "target": target, "camera": {"name": inquiry.camera}}
    data["matching"] = {"radius_mm": HIT_RADIUS_MM, "overlap": 0.5}
    data["sweep"] = {"detector.name": ["thesis", "matched"], "capture.frames": FRAMES}
    data.pop("unknowns", None)
    head = (
        f"# Written by tofpod start; part and surroundings as in {PARTS[inquiry.part]}.yaml of\n"
        "# tofpod. All keys: tofpod ls keys.\n"
    )
    return head + to_yaml(data)


def commands(inquiry: Inquiry, file: Path) -> list[tuple[str, str]]:
    """Return three commands to run, each with what it tells."""
    sweep = f"tofpod sweep {shlex.quote(str(file))}"
    if inquiry.recording is None:
        return [
            (f"{sweep} --dry-run", "what will be computed, and how long it takes"),
            (f"{sweep} --quick", "a first page with a third of the boards"),
            (sweep, "the limit with its interval, as a page"),
        ]
    recording = shlex.quote(str(inquiry.recording))
    first = f"tofpod detect {recording} --tolerance width={inquiry.tolerance_mm:g}mm --out findings"
    second = f"{sweep} --quick"
    purpose = "a first page of the simulated limit"
    if inquiry.kind in IMPLANTED:
        second = _implant(inquiry, recording)
        purpose = "the limit of your camera on this part, by virtual damage"
    return [
        (first, "the damage in the recording, and whether the part conforms"),
        (second, purpose),
        (sweep, "the simulated limit with its interval"),
    ]


def _implant(inquiry: Inquiry, recording: str) -> str:
    low_mm, high_mm = inquiry.sizes_mm
    words = [
        f"tofpod implant {recording} --camera {shlex.quote(inquiry.camera)}",
        f"--damage {inquiry.kind} --diameters {low_mm:g}:{high_mm:g}",
    ]
    if inquiry.depth_mm is not None:
        words.append(f"--depths {inquiry.depth_mm:g}:{inquiry.depth_mm:g}")
    if inquiry.kind == "slot":
        words.append(f"--lengths {SLOT_LENGTH_MM:g}:{SLOT_LENGTH_MM:g}")
    return " ".join([*words, "--out implanted"])


def _damage(inquiry: Inquiry, target: Mapping[str, Any]) -> dict[str, Any]:
    """Return the drawn damage, as many on a board as leave room between them."""
    board = target["board"]
    apart_mm = _apart_mm(inquiry)
    area_mm2 = board["width_mm"] * board["height_mm"]
    room = int(FILLED * area_mm2 / (math.pi / 4 * apart_mm**2))
    sizes_mm = inquiry.sizes_mm
    damage: dict[str, Any] = {
        "kind": inquiry.kind,
        "per_board": max(1, min(target["damage"]["per_board"], room)),
    }
    if inquiry.kind == "slot":
        damage["width_mm"] = sizes_mm
        damage["length_mm"] = [SLOT_LENGTH_MM, SLOT_LENGTH_MM]
    elif inquiry.kind == "gouge":
        width_mm = _rounded(GOUGE_WIDTH * inquiry.tolerance_mm)
        damage["length_mm"] = sizes_mm
        damage["width_mm"] = [width_mm, width_mm]
    else:
        damage["diameter_mm"] = sizes_mm
    if inquiry.depth_mm is not None:
        damage["depth_mm"] = [inquiry.depth_mm, inquiry.depth_mm]
    return damage


def _apart_mm(inquiry: Inquiry) -> float:
    """Return the least distance of two centres."""
    widest_mm = inquiry.sizes_mm[1]
    if inquiry.kind == "slot":
        widest_mm = math.hypot(widest_mm, SLOT_LENGTH_MM)
    elif inquiry.kind == "gouge":
        widest_mm = math.hypot(widest_mm, GOUGE_WIDTH * inquiry.tolerance_mm)
    return _rounded(max(2 * HIT_RADIUS_MM, widest_mm) + ROOM_MM)


def _rounded(length_mm: float) -> float:
    """Return a length with three significant digits, as a person would write it."""
    return float(f"{length_mm:.3g}")
