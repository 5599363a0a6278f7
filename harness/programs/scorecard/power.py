"""Moves each constant of a camera both ways, and lists the blind figures and families that notice.

A constant is a number that a camera's file states itself, with a tag other than R and D (read in a
public source, or derived from such), and that the simulation of a plane or an edge reads. It is
moved to the ends of its `range`, or by 30 % where none is stated; where no figure of the camera
notices, also in the cameras that inherit it (`like`). A figure notices if its value leaves or
enters a band: that of the source's own tolerance, that of 25 %, or that in which the figure passes;
a family, if its verdict changes. The change must exceed 5 %. Camera and moved camera are measured
with the same noise, in fewer frames than the scorecard's, so verdicts near a limit may differ from
it.

Of an untested constant, the list also names what limits of damage hang on and the move changes by
more than 5 %: noise and its correlation between neighbours, the fixed pattern, missing returns, and
pixels beside an edge, all at 0.7 m. A limit that is stated for the camera hangs on a constant for
which it names something, though no figure says that it is right.

Not moved: the lens, the places and cones of lights, choices of a rule, and numbers that are 0 and
state no range."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from harness.programs.scorecard.bench import BRIEF
from harness.programs.scorecard.families import family_scores
from harness.programs.scorecard.figures import (
    Family,
    Figure,
    FiguresFile,
    Request,
    Score,
    measured,
)
from harness.programs.scorecard.quantities import QUANTITIES, Quantity
from harness.records.schema import Column, Table
from harness.stills.statistics import Reading
from harness.vocabulary.declaration.yaml_source import read_yaml
from harness.vocabulary.errors import UserError
from harness.vocabulary.path_names import camera_title
from harness.vocabulary.provenance import RESULTS_VERSION
from harness.vocabulary.text import Tone
from scenes.sensor.camera import camera_of, load_camera, stated_in
from scenes.sensor.common.config import CameraConfig

SHARE = 0.3  # of a constant without a range
LEAST_CHANGE = 0.05  # share by which a value must change, lest noise near a limit counts
EVIDENT = ("R", "D")  # tags of numbers that are not moved
NOT_MOVED = (
    "lens.",
    "colour.",
    "wavelength_nm",
    "emitter.position_mm",
    "emitter.full_half_angle_deg",
    "emitter.cutoff_half_angle_deg",
    "emitter.mask_slopes",
    "receiver.",
    "photons.calibration_",
)
"""Beginnings of the keys of geometry, and of numbers that only solve for the gain."""
EFFECT_OF = {
    "modulation.wiggling_residual": "wiggling",
    "fixed_pattern.": "fixed_pattern",
    "unit.offset_mm": "unit_offset",
    "unit.drift": "warm_up_drift",
    "unit.j": "frame_jumps",
}
"""Effects without which a constant acts on nothing, by the beginning of its key."""
HALVINGS = 4  # of a step that leads to an illegal number, such as a contrast above 1
NEIGHBOURS = 2  # to which a whole number goes if no step leads to a legal one, such as windows


class Hinge(NamedTuple):
    """Something on which limits of damage hang."""

    words: str
    """Its name."""
    quantity: str
    """What is measured."""
    conditions: dict[str, Any]
    """Its conditions."""

    def request(self, camera: str, numbers: tuple[tuple[str, Any], ...]) -> Request:
        """Return its measurement on a camera with replaced numbers."""
        conditions = QUANTITIES[self.quantity].conditions.from_data(self.conditions)
        return Request(camera, self.quantity, conditions, numbers)


BOARD = {"distance_m": 0.7, "albedo": 0.6}
HINGES = (
    Hinge("noise", "temporal_sigma_mm", BOARD),
    Hinge("correlation", "noise_correlation", BOARD),
    Hinge("pattern", "patch_pattern_mm", {**BOARD, "patch_px": 9}),
    Hinge("missing returns", "valid_fraction", {"distance_m": 0.7, "albedo": 0.1}),
    Hinge("pixels at rims", "flying_pixels_px", {**BOARD, "step_mm": 20.0}),
    Hinge("gaps at rims", "edge_gap_px", {**BOARD, "step_mm": 500.0}),
)
"""On a board of pale wood: holes with a wall close behind have steps of some 20 mm at their rims,
open ones of hundreds."""
NOT_MOVED_WORDS = "not moved"
UNTESTED_FILE = Path(__file__).with_name("untested.yaml")


@dataclass(frozen=True)
class Constant:
    """A number that a camera's file states."""

    camera: str
    """The camera whose file states it."""
    key: str
    """Its dotted key."""
    value: Any
    """A number, or a tuple of numbers."""
    tag: str
    """The kind of its source."""
    limits: tuple[float, float] | None
    """Its stated range."""

    def moved(self, upwards: bool) -> Any:
        """Return the moved value; None if no legal value differs."""
        step = 1.0
        for _ in range(HALVINGS + 1):
            value = self._stepped(upwards, step)
            if value != self.value and _is_legal(self.camera, self.key, value):
                return value
            step /= 2
        if isinstance(self.value, int):
            for distance in range(1, NEIGHBOURS + 1):
                value = self.value + distance if upwards else self.value - distance
                if _is_legal(self.camera, self.key, value):
                    return value
        return None

    def _stepped(self, upwards: bool, step: float) -> Any:
        """Return the value after a share ``step`` of the whole way."""
        if isinstance(self.value, tuple):
            return tuple(self._number_stepped(number, upwards, step) for number in self.value)
        return self._number_stepped(self.value, upwards, step)

    def _number_stepped(self, number: float, upwards: bool, step: float) -> float:
        """Return a number of the value after the step; whole numbers stay whole."""
        factor = 1 + SHARE if upwards else 1 - SHARE
        end = number * factor
        if self.limits is not None:
            end = self.limits[upwards]
        stepped = number + step * (end - number)
        return round(stepped) if isinstance(number, int) else stepped


def _is_legal(camera: str, key: str, value: Any) -> bool:
    """Return whether a camera accepts a value of a constant."""
    try:
        camera_of(CameraConfig(name=camera, numbers={key: value}))
    except UserError:
        return False
    return True


def constants_of(camera: str) -> list[Constant]:
    """Return the constants that a camera's own file states, in its order."""
    data = load_camera(camera).to_data()
    constants = []
    for key, owner in stated_in(camera).items():
        fact = _fact(data, key)
        if owner != camera or fact is None or fact["tag"] in EVIDENT:
            continue
        value = _numbers(fact["value"])
        if value is None or key.startswith(NOT_MOVED):
            continue
        limits = tuple(fact["range"]) if fact["range"] else None
        constants.append(
            Constant(camera=camera, key=key, value=value, tag=fact["tag"], limits=limits)
        )
    return constants


def _fact(data: Mapping[str, Any], key: str) -> dict[str, Any] | None:
    """Return the fact at a dotted key of a camera's plain data; None if the camera has none."""
    fact: Any = data
    for word in key.split("."):
        fact = fact.get(word) if isinstance(fact, dict) else None
    return fact


def _numbers(value: Any) -> Any:
    """Return a number, or a tuple of numbers; None for anything else."""
    numbers = value if isinstance(value, list) else [value]
    if not numbers or any(isinstance(number, bool) for number in numbers):
        return None
    if not all(isinstance(number, int | float) for number in numbers):
        return None
    return tuple(value) if isinstance(value, list) else value


@dataclass(frozen=True)
class Moved:
    """A constant, moved both ways, and what notices it."""

    constant: Constant
    """The constant, with the value in its file."""
    lowered: Any
    """The value after the move down; None if no lower value is legal."""
    raised: Any
    """The value after the move up; None if no higher value is legal."""
    noticed_lowered: tuple[str, ...]
    """Names of the figures and families that notice the move down."""
    noticed_raised: tuple[str, ...]
    """Names of those that notice the move up."""
    hinges: tuple[str, ...]
    """What a move of an untested constant changes, of all on which limits of damage hang."""

    @property
    def can_move(self) -> bool:
        """False if no other value is legal, or the value is 0 without a range."""
        return self.lowered is not None or self.raised is not None

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the figures and families that notice either move."""
        return tuple(dict.fromkeys(self.noticed_lowered + self.noticed_raised))

    @property
    def verdict(self) -> str:
        """``noticed``, ``untested``, or ``not moved``."""
        if not self.can_move:
            return "not moved"
        return "noticed" if self.names else "untested"


@dataclass(frozen=True)
class _Move:
    """A constant with another value, and the blind figures of the cameras that use it."""

    constant: Constant
    """The constant that is moved."""
    value: Any
    """Its value after the move."""
    figures: tuple[Figure, ...]
    """The figures that may notice it."""

    def requests(self) -> list[Request]:
        """Return the measurements of the figures with the moved constant."""
        numbers = ((self.constant.key, self.value),)
        return [figure.request._replace(numbers=numbers) for figure in self.figures]

    def noticed(
        self, families: Sequence[Family], readings: Mapping[Request, Reading]
    ) -> tuple[str, ...]:
        """Return the names of the figures and families whose verdict the move changes."""
        before = [Score(figure, readings[figure.request]) for figure in self.figures]
        after = [
            Score(figure, readings[request])
            for figure, request in zip(self.figures, self.requests(), strict=True)
        ]
        names = []
        for old, new in zip(before, after, strict=True):
            if _is_noticed(old, new):
                names.append(new.figure.name)
        old_families = family_scores(families, before)
        new_families = family_scores(families, after)
        for old_family, new_family in zip(old_families, new_families, strict=True):
            log_changes = [
                abs(np.log(new_family.mean / old_family.mean)),
                abs(np.log(new_family.change / old_family.change)),
            ]
            has_other_verdict = old_family.verdict != new_family.verdict
            if has_other_verdict and max(log_changes) > LEAST_CHANGE:
                names.append(new_family.family.name)
        return tuple(names)


def _is_noticed(old: Score, new: Score) -> bool:
    """Return whether a figure's grade changes, and its value by more than noise changes it."""
    old_value = old.simulated.value
    is_evident = _differs(old_value, new.simulated.value, scale=abs(old_value))
    has_no_value = np.isnan([old_value, new.simulated.value]).any()
    return bool(is_evident and (has_no_value or old.grade != new.grade))


def power_of(file: FiguresFile, cameras: Sequence[str], jobs: int) -> list[Moved]:
    """Move each constant of the cameras both ways and measure blind figures, ``jobs`` scenes at a
    time: those of the camera itself, and where none notices either move those of the cameras that
    inherit the constant."""
    constants = [constant for camera in cameras for constant in constants_of(camera)]
    moves = {}
    for constant in constants:
        for upwards in (False, True):
            moves[constant, upwards] = constant.moved(upwards)
    owners = {camera: stated_in(camera) for camera in cameras}
    noticed: dict[tuple[Constant, bool], tuple[str, ...]] = dict.fromkeys(moves, ())
    readings: dict[Request, Reading] = {}
    for is_own in (True, False):
        tried = {}
        for (constant, upwards), value in moves.items():
            is_noticed = noticed[constant, False] or noticed[constant, True]
            if value is not None and not is_noticed:
                figures = _figures(file, constant, owners, is_own)
                tried[constant, upwards] = _Move(constant, value, figures)
        requests = {request for move in tried.values() for request in move.requests()}
        requests |= {request._replace(numbers=()) for request in requests}
        missing = sorted(requests - readings.keys(), key=repr)
        readings |= measured(missing, BRIEF, jobs)
        for key, move in tried.items():
            noticed[key] = move.noticed(file.families, readings)
    untested_moves = {}
    for (constant, upwards), value in moves.items():
        is_noticed = noticed[constant, False] or noticed[constant, True]
        if value is not None and not is_noticed:
            untested_moves[constant, upwards] = value
    hinges = _hinges_of(untested_moves, jobs)
    return [
        Moved(
            constant=constant,
            lowered=moves[constant, False],
            raised=moves[constant, True],
            noticed_lowered=noticed[constant, False],
            noticed_raised=noticed[constant, True],
            hinges=hinges.get(constant, ()),
        )
        for constant in constants
    ]


def _hinges_of(
    moves: Mapping[tuple[Constant, bool], Any], jobs: int
) -> dict[Constant, tuple[str, ...]]:
    """Return what each constant changes when it is moved, of all on which limits hang."""
    requests = {}
    for (constant, upwards), value in moves.items():
        for hinge in HINGES:
            if _acts(constant.key, QUANTITIES[hinge.quantity]):
                request = hinge.request(constant.camera, ((constant.key, value),))
                requests[constant, upwards, hinge.words] = request
    distinct = set(requests.values())
    distinct |= {request._replace(numbers=()) for request in distinct}
    readings = measured(sorted(distinct, key=repr), BRIEF, jobs)
    changed: dict[Constant, dict[str, None]] = {}
    for (constant, _, words), request in requests.items():
        before = readings[request._replace(numbers=())].value
        after = readings[request].value
        is_in_mm = QUANTITIES[request.quantity].unit == "mm"
        if _differs(before, after, scale=abs(before) if is_in_mm else 1.0):
            changed.setdefault(constant, {})[words] = None
    return {constant: tuple(words) for constant, words in changed.items()}


def _differs(before: float, after: float, scale: float) -> bool:
    """Return whether a reading changed by more than noise changes it, or appeared or went."""
    if np.isnan(before) or np.isnan(after):
        return bool(np.isnan(before) != np.isnan(after))
    return abs(after - before) > LEAST_CHANGE * scale


def _figures(
    file: FiguresFile, constant: Constant, owners: Mapping[str, Mapping[str, str]], is_own: bool
) -> tuple[Figure, ...]:
    """Return the blind figures on which a constant can act: those of its camera, or those of the
    cameras that inherit it. ``owners``: by camera, who states each number."""
    figures = []
    for figure in file.figures:
        is_of_camera = figure.camera == constant.camera
        if figure.use != "blind" or is_of_camera != is_own:
            continue
        uses = owners.get(figure.camera, {}).get(constant.key) == constant.camera
        if uses and _acts(constant.key, figure.measures):
            figures.append(figure)
    return tuple(figures)


def _acts(key: str, quantity: Quantity) -> bool:
    """Return whether the effect by which a constant acts is on while a quantity is measured."""
    for beginning, effect in EFFECT_OF.items():
        if key.startswith(beginning):
            return bool(getattr(quantity.effects, effect))
    return True


UntestedConstants = dict[str, dict[str, str]]
"""By camera and key: what the constant changes of all on which limits hang, or ``not moved``."""


def untested(results: Sequence[Moved]) -> UntestedConstants:
    """Return the constants that nothing notices."""
    constants: UntestedConstants = {}
    for result in results:
        if not result.names:
            words = ", ".join(result.hinges) if result.can_move else NOT_MOVED_WORDS
            constants.setdefault(result.constant.camera, {})[result.constant.key] = words or "none"
    return constants


def untested_text(constants: Mapping[str, Mapping[str, str]]) -> str:
    """Return the file of untested constants."""
    lines = [
        "# The constants of the cameras that no blind figure or family of figures.yaml notices",
        "# when they are moved, each with what it changes of all on which limits of damage hang.",
        "# `tofpod validate --power` writes it, and fails where it disagrees.",
    ]
    for camera, words_by_key in constants.items():
        lines += [f"{camera}:", *(f"  {key}: {words}" for key, words in words_by_key.items())]
    return "\n".join(lines) + "\n"


def stored_untested(cameras: Sequence[str]) -> UntestedConstants:
    """Return the constants on file for some cameras."""
    data = read_yaml(UNTESTED_FILE).data
    return {camera: data[camera] for camera in cameras if camera in data}


def _value_text(value: Any) -> str:
    """Return a constant's value; a dash for a move that no legal value allows."""
    if value is None:
        return "–"
    numbers = value if isinstance(value, tuple) else (value,)
    return ", ".join(f"{number:.4g}" for number in numbers)


def _names_text(names: tuple[str, ...]) -> str:
    """Return all names, for the table in a file."""
    return ", ".join(names) or "–"


def _names_brief(names: tuple[str, ...]) -> str:
    """Return the first name and the number of others, for a narrow table."""
    if len(names) < 2:
        return _names_text(names)
    return f"{names[0]} and {len(names) - 1} more"


TONES: dict[str, Tone] = {"noticed": "good", "untested": "bad", "not moved": ""}
POWER = Table(
    "power",
    "one row per constant of a camera that was moved",
    (
        Column("camera", "", "constant.camera", "camera whose file states the constant"),
        Column("", "camera", lambda row: camera_title(row.constant.camera)),
        Column("constant", "constant", "constant.key", "dotted key in the file"),
        Column("tag", "tag", "constant.tag", "kind of its source"),
        Column(
            "value", "value", "constant.value", "value in the file", _value_text, brief=_value_text
        ),
        Column(
            "lowered",
            "lowered to",
            "lowered",
            "value after the move down",
            _value_text,
            brief=_value_text,
        ),
        Column(
            "raised",
            "raised to",
            "raised",
            "value after the move up",
            _value_text,
            brief=_value_text,
        ),
        Column(
            "noticed_lowered",
            "noticed by, lowered",
            "noticed_lowered",
            "figures and families that notice the move down",
            _names_text,
            brief=_names_brief,
        ),
        Column(
            "noticed_raised",
            "noticed by, raised",
            "noticed_raised",
            "figures and families that notice the move up",
            _names_text,
            brief=_names_brief,
        ),
        Column(
            "verdict",
            "verdict",
            "verdict",
            "noticed, untested, or not moved (0 without a range, or no other legal value)",
            tone=lambda row: TONES[row.verdict],
        ),
        Column(
            "hinges",
            "limits hang on its",
            "hinges",
            "what the moves of an untested constant change, of all on which limits hang",
            _names_text,
            brief=_names_text,
        ),
        Column("results_version", "", lambda row: RESULTS_VERSION, "version of the format"),
    ),
    left=3,
    kind="scores",
)
