"""Published figures: what others measured or specified of a camera, and the judgement of the simulation by them.

The file of figures is YAML; adding an entry is all that a further figure needs. Every problem of a file is told at
once, with its place. No change may fall behind the baseline, which names the figures that passed.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from harness.scorecard.bench import Reading
from harness.scorecard.quantities import QUANTITIES, Quantity, in_words
from harness.vocabulary.config import Config
from harness.vocabulary.declaration.diagnose import validated, wrong_choice
from harness.vocabulary.declaration.problems import DeclarationError, Problem
from harness.vocabulary.declaration.shape import child
from harness.vocabulary.declaration.yaml_source import KeyPath, read_yaml
from harness.vocabulary.errors import UserError
from harness.vocabulary.files import write_text
from harness.vocabulary.json_text import strict_json
from harness.vocabulary.limits import TEXT_BYTES, bounded_bytes
from harness.vocabulary.versions import check_version
from scenes.sensor.camera import camera_names

FIGURES_FILE = Path(__file__).with_name("figures.yaml")
BASELINE_FILE = Path(__file__).with_name("baseline.json")
SCORECARD_VERSION = 1
"""Version of a baseline; raised when the meaning of its keys changes."""


class Published(Config):
    """A published value with a tolerance, or a bound. Units are the quantity's."""

    value: float | None = Field(None, description="a value; needs a tolerance")
    tolerance: Annotated[float, Field(ge=0.0)] | None = Field(
        None, description="how far the simulated value may lie from `value`, or beyond a bound (then 0 if left out)"
    )
    below: float | None = Field(None, description="an upper bound")
    above: float | None = Field(None, description="a lower bound")
    between: tuple[float, float] | None = Field(None, description="two bounds, the lower first")

    @model_validator(mode="after")
    def _has_one_form(self) -> Self:
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
    entries = child(source.data, "figures")
    problems: list[Problem] = []
    first: dict[str, int] = {}
    splices: dict[KeyPath, type[Config]] = {}
    for number, data in enumerate(entries if isinstance(entries, list) else []):
        for key, legal in (("quantity", QUANTITIES), ("camera", camera_names())):
            word, at = child(data, key), ("figures", number, key)
            if isinstance(word, str) and word not in legal:
                problems.append(wrong_choice(at, word, legal, source.place_of(at)))
        quantity = child(data, "quantity")
        if isinstance(quantity, str) and quantity in QUANTITIES and isinstance(child(data, "conditions"), dict):
            splices["figures", number, "conditions"] = QUANTITIES[quantity].conditions
        name = child(data, "name")
        if isinstance(name, str) and first.setdefault(name, number) != number:
            here, there = (source.place_of(("figures", n, "name")) for n in (number, first[name]))
            problems.append(Problem(f"two figures have the name {name}", here, other=there, other_says="first used at"))
    file, found = validated(FiguresFile, source, splices)
    if problems or file is None:
        raise DeclarationError(str(path), [*problems, *found])
    return tuple(
        Figure(entry, quantity, quantity.conditions.from_data(entry.conditions))
        for entry in file.figures
        for quantity in [QUANTITIES[entry.quantity]]
    )


# ---- the judgement and the baseline ----------------------------------------------------------------------------------


@dataclass(frozen=True)
class Score:
    """One figure, what the simulation gave, whether it passed in the baseline (None where that does not know it)."""

    figure: Figure
    simulated: Reading
    passed_before: bool | None

    @property
    def passes(self) -> bool:
        """True where the simulated value lies within what was published, tolerance included; False without a value."""
        low, high = self.figure.entry.published.limits
        return bool(np.isfinite(self.simulated.value) and low <= self.simulated.value <= high)

    @property
    def regressed(self) -> bool:
        """True where the figure passed in the baseline and fails now."""
        return self.passed_before is True and not self.passes

    @property
    def verdict(self) -> str:
        """``pass``, ``fail``, or ``FAIL (passed before)``."""
        return "pass" if self.passes else "FAIL (passed before)" if self.regressed else "fail"


def judged(
    figures: Sequence[Figure], simulated: Mapping[str, Reading], baseline: Mapping[str, bool]
) -> tuple[Score, ...]:
    """The scores of figures whose readings are given by name."""
    return tuple(Score(figure, simulated[figure.name], baseline.get(figure.name)) for figure in figures)


def read_baseline(path: Path) -> dict[str, bool]:
    """Read which figures passed, by name; empty where there is no file. Raises UserError where it is no baseline, or a
    baseline of another version."""
    return {name: known["passes"] for name, known in _known(path).items()}


def write_baseline(path: Path, scores: Iterable[Score], known: Iterable[str]) -> None:
    """Write which figures pass, and the simulated values for the reader of a change.

    Entries of other figures stay as they are where their name is among the ``known`` ones.
    """
    figures = {name: entry for name, entry in _known(path).items() if name in set(known)}
    for score in scores:
        value = score.simulated.value
        rounded = float(f"{value:.4g}") if np.isfinite(value) else None
        figures[score.figure.name] = {"passes": score.passes, "simulated": rounded}
    lines = [f"    {json.dumps(name)}: {json.dumps(entry)}" for name, entry in sorted(figures.items())]
    head = f'{{\n  "scorecard_version": {SCORECARD_VERSION},\n  "figures": {{\n'
    write_text(path, head + ",\n".join(lines) + "\n  }\n}\n")


def _known(path: Path) -> dict[str, dict[str, Any]]:
    """Return the entries of a baseline by the figures' names."""
    if not path.exists():
        return {}
    again = "remove it, and write it anew with --update-baseline"
    try:
        data = strict_json(bounded_bytes(path, TEXT_BYTES))
        check_version(data["scorecard_version"], SCORECARD_VERSION, path, "a baseline of the scorecard", again=again)
        figures: dict[str, dict[str, Any]] = data["figures"]
        if not all(isinstance(known["passes"], bool) for known in figures.values()):
            raise ValueError("passes is neither true nor false")
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise UserError(
            f"{path}: is no baseline of the scorecard",
            legal='JSON: {"scorecard_version": 1, "figures": {NAME: {"passes": true or false, "simulated": number}}}',
            fix=again,
        ) from error
    return figures
