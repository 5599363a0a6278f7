"""Published figures: what others measured or specified of a camera, as data beside the quantities it is judged by.

The file is YAML; adding an entry is all that a further figure needs. Every problem of a file is told at once, with its
place.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import Field, ValidationError, model_validator

from harness.scorecard.conditions import in_words
from harness.scorecard.quantities import QUANTITIES, Quantity
from harness.vocabulary.config import Config
from harness.vocabulary.declaration.diagnose import problems_of, validated, wrong_choice
from harness.vocabulary.declaration.problems import DeclarationError, Problem
from harness.vocabulary.declaration.shape import Declared
from harness.vocabulary.declaration.yaml_source import Source, read_yaml
from scenes.sensor.camera import camera_names

FIGURES_FILE = Path(__file__).with_name("figures.yaml")


class Published(Config):
    """What was published: a value with a tolerance, or a bound. Units are the quantity's."""

    value: float | None = Field(None, description="a value; needs a tolerance")
    tolerance: Annotated[float, Field(ge=0.0)] | None = Field(
        None, description="how far the simulated value may lie from `value`, or beyond a bound (then 0 if left out)"
    )
    below: float | None = Field(None, description="an upper bound")
    above: float | None = Field(None, description="a lower bound")
    between: tuple[float, float] | None = Field(None, description="two bounds, the lower first")

    @model_validator(mode="after")
    def _one_of_them(self) -> Self:
        given = [key for key in ("value", "below", "above", "between") if getattr(self, key) is not None]
        if len(given) != 1:
            raise ValueError(
                f"exactly one of value, below, above and between says what was published; here: {given or 'none'}"
            )
        if self.value is not None and self.tolerance is None:
            raise ValueError("a value needs a tolerance")
        if self.between is not None and not self.between[0] < self.between[1]:
            raise ValueError("between: the first bound must be below the second")
        return self

    @property
    def limits(self) -> tuple[float, float]:
        """The lowest and highest simulated value that passes, tolerance included."""
        slack = self.tolerance or 0.0
        if self.value is not None:
            return self.value - slack, self.value + slack
        low, high = self.between or (self.above, self.below)
        return (-float("inf") if low is None else low - slack), (float("inf") if high is None else high + slack)

    def in_words(self) -> str:
        """``1.42``, ``below 17``, ``0.15 to 0.35``."""
        if self.value is not None:
            return f"{self.value:g}"
        if self.between is not None:
            return f"{self.between[0]:g} to {self.between[1]:g}"
        return f"below {self.below:g}" if self.below is not None else f"above {self.above:g}"


class FigureEntry(Config):
    """One published figure as the file holds it; ``conditions`` are those of its quantity.

    ``calibration``: whether the camera's file was, or may be, fitted to it; such a figure is no test of the model.
    ``note`` says what was assumed where the source leaves conditions open.
    """

    name: Annotated[str, Field(pattern=r"^[a-z0-9_]+$", description="small letters, digits and _; once in the file")]
    camera: str
    quantity: str
    conditions: dict[str, Any]
    published: Published
    source: Annotated[str, Field(min_length=3)]
    tag: Literal["R", "D", "S", "W", "M"]
    calibration: bool
    note: str = ""


class FiguresFile(Config):
    """The file: a list of figures."""

    figures: Annotated[tuple[FigureEntry, ...], Field(min_length=1)]


@dataclass(frozen=True)
class Figure:
    """One published figure with its quantity and its complete conditions."""

    entry: FigureEntry
    quantity: Quantity
    conditions: Config

    @property
    def name(self) -> str:
        """The key of the figure in the baseline."""
        return self.entry.name

    def what(self) -> str:
        """``temporal deviation, 1.5 m, albedo 0.8``."""
        return f"{self.quantity.title}, {in_words(self.conditions)}"


def read_figures(path: Path = FIGURES_FILE) -> tuple[Figure, ...]:
    """The figures of a file. Raises UserError naming each key that is missing, unknown or impossible, and where."""
    source = read_yaml(path)
    file, problems = validated(FiguresFile, source, {})
    entries = source.data.get("figures") if isinstance(source.data, dict) else None
    figures: list[Figure] = []
    for number, data in enumerate(entries if isinstance(entries, list) else []):
        if isinstance(data, dict):
            conditions, found = _conditions(data, number, source)
            problems += found + _unknown_camera(data, number, source)
            if file is not None and conditions is not None:
                figures.append(Figure(file.figures[number], QUANTITIES[data["quantity"]], conditions))
    problems += _names_twice(entries, source)
    if problems:
        raise DeclarationError(str(path), problems)
    return tuple(figures)


def _conditions(data: dict[str, Any], number: int, source: Source) -> tuple[Config | None, list[Problem]]:
    """The conditions of an entry by its quantity's model."""
    name, path = data.get("quantity"), ("figures", number)
    if not isinstance(name, str):
        return None, []
    if name not in QUANTITIES:
        return None, [wrong_choice((*path, "quantity"), name, QUANTITIES, source.place_of((*path, "quantity")))]
    given = data.get("conditions")
    if not isinstance(given, dict):
        return None, []
    model, at = QUANTITIES[name].conditions, (*path, "conditions")
    try:
        return model.from_data(given), []
    except ValidationError as error:
        return None, problems_of(error, Declared(FiguresFile, source.data, {at: model}), source, at)


def _unknown_camera(data: dict[str, Any], number: int, source: Source) -> list[Problem]:
    name, path = data.get("camera"), ("figures", number, "camera")
    if not isinstance(name, str) or name in camera_names():
        return []
    return [wrong_choice(path, name, camera_names(), source.place_of(path))]


def _names_twice(entries: Any, source: Source) -> list[Problem]:
    first: dict[str, int] = {}
    problems = []
    for number, data in enumerate(entries if isinstance(entries, list) else []):
        name = data.get("name") if isinstance(data, dict) else None
        if not isinstance(name, str):
            continue
        if name in first:
            here, there = (source.place_of(("figures", n, "name")) for n in (number, first[name]))
            problems.append(Problem(f"two figures have the name {name}", here, other=there, other_says="first used at"))
        first.setdefault(name, number)
    return problems
