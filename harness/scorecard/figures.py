"""Published figures: what others measured or specified of a camera, what the simulation gives, and its judgement.

The file of figures is YAML; adding an entry is all that a further figure needs. Every problem of a file is told at
once, with its place. No change may fall behind the baseline, which names the figures that passed.
"""

from __future__ import annotations

import json
import sys
import time
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import cached_property
from multiprocessing import get_context
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from harness.evaluation.intervals import Interval
from harness.scorecard.bench import Bench, Effort, Reading
from harness.scorecard.quantities import QUANTITIES, Quantity, RoomConditions, in_words, scene_of
from harness.tables.schema import Column, Table
from harness.tables.text import Tone
from harness.vocabulary.config import Config
from harness.vocabulary.declaration.diagnose import validated, wrong_choice
from harness.vocabulary.declaration.shape import child
from harness.vocabulary.declaration.yaml_source import DeclarationError, KeyPath, Problem, read_yaml
from harness.vocabulary.errors import UserError
from harness.vocabulary.files import TEXT_BYTES, bounded_bytes, strict_json, write_text
from harness.vocabulary.provenance import RESULTS_VERSION, check_version
from harness.vocabulary.seeds import canonical_json
from scenes.sensor.camera import camera_names

FIGURES_FILE = Path(__file__).with_name("figures.yaml")
BASELINE_FILE = Path(__file__).with_name("baseline.json")
SCORECARD_VERSION = 1
NEAR = 0.25
"""A figure of reality passes within this share of a published value; a bound must hold."""
DRAWN = ("azure_kinect_nfov", "kinect_v2", "realsense_l515")
"""Cameras whose curves the page draws unless others are asked for: those of the thesis."""
Request = tuple[str, str, Config]
"""A camera, a quantity, and its conditions."""


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
    def ends(self) -> tuple[float, float]:
        """The lowest and the highest value that agree with what was published; infinite where there is no bound."""
        low, high = self.between or ((self.above, self.below) if self.value is None else (self.value, self.value))
        return (-float("inf") if low is None else low), (float("inf") if high is None else high)

    def limits(self, near: float = 0.0) -> tuple[float, float]:
        """The lowest and highest simulated value that passes: beyond the ends by the tolerance, or by the share
        ``near`` of a published value where that is more."""
        slack = max(self.tolerance or 0.0, near * abs(self.value or 0.0))
        return self.ends[0] - slack, self.ends[1] + slack

    def ratio(self, simulated: float) -> float:
        """Simulated by published, or by the nearer bound; NaN where that is 0."""
        nearest = min(self.ends, key=lambda end: abs(end - simulated))
        return simulated / nearest if nearest else float("nan")

    def in_words(self) -> str:
        """``1.42``, ``below 17``, ``0.15 to 0.35``."""
        if self.between is not None:
            return f"{self.between[0]:g} to {self.between[1]:g}"
        ((key, bound),) = self.model_dump(include={"value", "below", "above"}, exclude_none=True).items()
        return f"{bound:g}" if key == "value" else f"{key} {bound:g}"


class Figure(Config):
    """One published figure as the file holds it; ``calibration``: the camera's file was, or may be, fitted to it.
    ``kind``: a figure of real cameras, or a check of the code against the arithmetic of a stated filter or limit."""

    name: Annotated[str, Field(pattern=r"^[a-z0-9_]+$", description="small letters, digits and _; once in the file")]
    camera: str
    quantity: str
    conditions: dict[str, Any]
    published: Published
    source: Annotated[str, Field(min_length=3)]
    tag: Literal["R", "D", "S", "W", "M"]
    calibration: bool
    kind: Literal["reality", "code"] = "reality"
    note: str = ""

    @property
    def limits(self) -> tuple[float, float]:
        """The lowest and highest simulated value that passes."""
        return self.published.limits(NEAR if self.kind == "reality" else 0.0)

    @property
    def use(self) -> Literal["blind", "calibration", "code"]:
        """Blind: it tests the model against real cameras and was not used for it."""
        return "code" if self.kind == "code" else "calibration" if self.calibration else "blind"

    @cached_property
    def measures(self) -> Quantity:
        """The quantity of its name."""
        return QUANTITIES[self.quantity]

    @cached_property
    def request(self) -> Request:
        """Camera, quantity and complete conditions of what is to be measured."""
        return self.camera, self.quantity, self.measures.conditions.from_data(self.conditions)

    def what(self) -> str:
        """``temporal deviation, 1.5 m, albedo 0.8``."""
        return f"{self.measures.title}, {in_words(self.request[2])}"


class FiguresFile(Config):
    """The file: a list of figures."""

    figures: Annotated[tuple[Figure, ...], Field(min_length=1)]


def read_figures(path: Path = FIGURES_FILE) -> tuple[Figure, ...]:
    """The figures of a file. Raises UserError naming each key that is missing, unknown or impossible, and where."""
    source = read_yaml(path)
    entries, problems = child(source.data, "figures"), list[Problem]()
    first: dict[str, int] = {}
    splices: dict[KeyPath, type[Config]] = {}
    for number, data in enumerate(entries if isinstance(entries, list) else []):
        for key, legal in (("quantity", QUANTITIES), ("camera", camera_names())):
            word, at = child(data, key), ("figures", number, key)
            if isinstance(word, str) and word not in legal:
                problems.append(wrong_choice(at, word, legal, source.place_of(at)))
        quantity, name = child(data, "quantity"), child(data, "name")
        if isinstance(quantity, str) and quantity in QUANTITIES and isinstance(child(data, "conditions"), dict):
            splices["figures", number, "conditions"] = QUANTITIES[quantity].conditions
        if isinstance(name, str) and first.setdefault(name, number) != number:
            here, there = (source.place_of(("figures", n, "name")) for n in (number, first[name]))
            problems.append(Problem(f"two figures have the name {name}", here, other=there, other_says="first used at"))
    file, found = validated(FiguresFile, source, splices)
    if problems or file is None:
        raise DeclarationError(str(path), [*problems, *found])
    return file.figures


@dataclass(frozen=True)
class Score:
    """One figure, what the simulation gave, whether it passed in the baseline (None where that does not know it)."""

    figure: Figure
    simulated: Reading
    passed_before: bool | None

    @property
    def passes(self) -> bool:
        """True where the simulated value lies within the entry's limits; False without a value."""
        low, high = self.figure.limits
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
    """Read which figures passed; empty where there is no file. Raises UserError where it is no baseline of today's."""
    return {name: known["passes"] for name, known in _known(path).items()}


def write_baseline(path: Path, scores: Iterable[Score], known: Iterable[str]) -> None:
    """Write which figures pass, and the simulated values; entries of other ``known`` figures stay as they are."""
    kept = set(known)
    figures = {name: entry for name, entry in _known(path).items() if name in kept}
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
        legal = 'JSON: {"scorecard_version": 1, "figures": {NAME: {"passes": true or false, "simulated": number}}}'
        raise UserError(f"{path}: is no baseline of the scorecard", legal=legal, fix=again) from error
    return figures


SAID_EVERY_S = 10.0


def measured(requests: Iterable[Request], effort: Effort, renders: Path, jobs: int) -> dict[Request, Reading]:
    """Measure all requests, ``jobs`` scenes at a time. The numbers do not depend on ``jobs`` or on the order."""
    scenes: dict[str, list[Request]] = defaultdict(list)
    for request in requests:
        scenes[canonical_json([request[0], *scene_of(request[2])])].append(request)
    # scenes that take seconds are begun first, so that no process ends on one alone
    groups = sorted(scenes.values(), key=lambda group: not isinstance(group[0][2], RoomConditions))
    results: dict[Request, Reading] = {}
    said = time.monotonic()
    # processes that start anew: a forked one would share the locks of this one's libraries
    with ProcessPoolExecutor(jobs, get_context("spawn")) as pool:
        mapped = map if jobs == 1 else pool.map
        count = len(groups)
        found = mapped(measure_group, groups, [effort] * count, [renders] * count)
        for group, readings in zip(groups, found, strict=True):
            results |= zip(group, readings, strict=True)
            if time.monotonic() - said > SAID_EVERY_S:
                said = time.monotonic()
                print(f"measured {len(results)} of {sum(map(len, groups))} numbers", file=sys.stderr, flush=True)
    return results


def measure_group(group: Sequence[Request], effort: Effort, renders: Path) -> list[Reading]:
    """Measure quantities of one camera on one scene, in this process."""
    return [QUANTITIES[name].measure(Bench(camera, effort, renders), conditions) for camera, name, conditions in group]


CONDITIONS = tuple(dict.fromkeys(name for each in QUANTITIES.values() for name in each.conditions.model_fields))
SCORE_FILE: dict[str, Any] = {"formats": ("csv",), "digits": "%.9g"}


@dataclass(frozen=True)
class CurvePoint:
    """One point of a curve of one camera; ``curve``: the picture that it belongs to."""

    curve: str
    camera: str
    quantity: Quantity
    conditions: Config
    simulated: Reading


@dataclass(frozen=True)
class Beside:
    """One number of the capture and of the simulation; ``at``: the condition."""

    where: str
    quantity: str
    at: str
    unit: str
    pixels: int
    measured: Reading
    simulated: Reading

    @property
    def ratio(self) -> float:
        """Simulated by measured; NaN for what may be 0."""
        return self.simulated.value / self.measured.value if self.unit == "mm" and self.measured.value else float("nan")


def number(value: float) -> str:
    """Three significant digits; ``none`` where there is no value."""
    if np.isnan(value):
        return "none"
    if 0.0995 <= abs(value) < 99.95:
        return f"{value:#.3g}"
    return f"{value:.3g}" if abs(value) >= 99.95 or value == 0 else f"{value:.2g}"


def _interval(between: Interval) -> str:
    high = number(between.high) if np.isfinite(between.high) else "inf"
    return f"{number(between.low)} to {high}" if between.known else "–"


def _conditions(conditions: Config) -> dict[str, Any]:
    return {key: conditions.to_data().get(key) for key in CONDITIONS}


def _reading(name: str, low: str, high: str, note: str, label: str = "") -> tuple[Column, ...]:
    """A reading: its value and its interval's ends in three columns of a file, and in two of a page."""
    return (
        Column(name, label, f"{name}.value", note, number),
        Column(low, "", f"{name}.interval.low", "lower end of its 95 % interval"),
        Column(high, "", f"{name}.interval.high", "upper end of its 95 % interval"),
        Column("", "95 %" if label else "", f"{name}.interval", text=_interval),
    )


def _tone(score: Score) -> Tone:
    return "good" if score.passes else "bad"


def _ratio(score: Score) -> float:
    return score.figure.published.ratio(score.simulated.value)


def _ratio_text(score: Score) -> str:
    """The ratio, or why a score passes whose ratio looks as if it failed: both values are nearly nothing."""
    ratio, tolerance = _ratio(score), score.figure.published.tolerance
    return "within tolerance" if tolerance and score.passes and not 0.5 <= ratio <= 2 else number(ratio)


SIMULATED = _reading("simulated", "low", "high", "simulated value", "simulated")
VERSION = Column("results_version", "", lambda row: RESULTS_VERSION, "version of the tables' meaning")
SCORES = Table(
    "scorecard",
    "one row per published figure",
    (
        Column("name", "", "figure.name", "name in the file of figures"),
        Column("camera", "camera", "figure.camera", "simulated camera"),
        Column("figure", "figure", lambda score: score.figure.what(), "quantity and conditions in words"),
        Column("quantity", "", "figure.quantity", "quantity that is measured"),
        Column("unit", "", "figure.measures.unit", "unit of all values"),
        Column("conditions", "", lambda score: _conditions(score.figure.request[2]), "conditions", spread=True),
        *SIMULATED,
        Column("published", "published", lambda score: score.figure.published.in_words(), "published value"),
        Column(
            "tolerance",
            "tolerance",
            "figure.published.tolerance",
            "how far beyond it the simulated value may lie",
            lambda tolerance: f"±{tolerance:g}" if tolerance else "–",
        ),
        Column("", "unit", lambda score: score.figure.measures.unit or "–"),
        Column("ratio", "", _ratio, "simulated by published, or by the nearer bound"),
        Column("", "ratio", _ratio_text),
        Column("passes_from", "", lambda score: score.figure.limits[0], "lowest value that passes"),
        Column("passes_to", "", lambda score: score.figure.limits[1], "highest value that passes"),
        Column("verdict", "verdict", "verdict", "whether the simulated value passes", tone=_tone),
        Column("passed_before", "", "passed_before", "whether it passed in the baseline; empty where that lacks it"),
        Column(
            "use", "use", "figure.use", "blind, calibration (the camera's file was, or may be, fitted to it) or code"
        ),
        Column("tag", "", "figure.tag", "R read, D derived, S secondary, W measured on captures, M a guess"),
        Column(
            "first_hand",
            "first hand",
            lambda score: "yes" if score.figure.tag in "RW" else "no",
            "whether the source itself was read, or the capture measured",
        ),
        Column("source", "", "figure.source", "source of the published value"),
        Column("", "source", lambda score: f"[{score.figure.tag}] {score.figure.source}"),
        Column("note", "note", "figure.note", "what was assumed", brief=False),
        VERSION,
    ),
    left=20,
    kind="scores",
    **SCORE_FILE,
)
CURVES = Table(
    "curves",
    "one row per point of a curve",
    (
        Column("curve", "", "curve", "picture that it belongs to"),
        Column("camera", "", "camera", "simulated camera"),
        Column("quantity", "", "quantity.name", "quantity that is measured"),
        Column("unit", "", "quantity.unit", "unit of the value"),
        Column("conditions", "", lambda row: _conditions(row.conditions), "conditions", spread=True),
        *SIMULATED[:3],
        VERSION,
    ),
    **SCORE_FILE,
)
BESIDE = Table(
    "capture",
    "one row per number of a capture beside its simulation",
    (
        Column("where", "where", "where", "plane or edge"),
        Column("quantity", "quantity", "quantity", "quantity that is measured"),
        Column("at", "at", "at", "condition"),
        Column("unit", "", "unit", "unit of the values"),
        Column("pixels", "pixels", "pixels", "pixels, or lines across an edge"),
        *_reading("measured", "measured_low", "measured_high", "measured on the capture", "measured"),
        *_reading("simulated", "simulated_low", "simulated_high", "measured on its simulation", "simulated"),
        Column("", "ratio", "ratio", text=lambda ratio: f"{ratio:.2f}" if np.isfinite(ratio) else "–"),
        Column("", "unit", lambda row: row.unit or "–"),
        VERSION,
    ),
    left=3,
    **SCORE_FILE,
)
