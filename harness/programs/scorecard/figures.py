"""Published figures of cameras (measured or specified), the simulated values, and their
comparison.

The file of figures is YAML; a new figure needs only an entry there. All problems of a file are
reported together, each with its place. The file states a reason for each figure that fails; all
others must pass."""

import sys
import time
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple, Self

import numpy as np
from pydantic import Field, model_validator

from harness.evaluation.intervals import Interval
from harness.programs.scorecard.bench import Bench, Effort
from harness.programs.scorecard.quantities import QUANTITIES, Quantity, in_words, scene_of
from harness.records.schema import Column, Table
from harness.stills.statistics import Reading
from harness.vocabulary import system
from harness.vocabulary.config import Config
from harness.vocabulary.declaration.diagnose import validated, wrong_choice
from harness.vocabulary.declaration.shape import child
from harness.vocabulary.declaration.yaml_source import DeclarationError, KeyPath, Problem, read_yaml
from harness.vocabulary.path_names import camera_title
from harness.vocabulary.provenance import RESULTS_VERSION
from harness.vocabulary.seeds import canonical_json
from scenes.sensor.camera import camera_names

FIGURES_FILE = Path(__file__).with_name("figures.yaml")
# a figure of a real camera passes within this share of a published value; a published bound must
# hold
NEAR = 0.25
FEWEST = 4  # figures of a family: with three, a slope has one degree of freedom
PROGRESS_EVERY_S = 10.0


class Request(NamedTuple):
    """A measurement of a simulated camera."""

    camera: str
    """Name of the camera."""
    quantity: str
    """Name of the quantity."""
    conditions: Config
    """All conditions of the measurement."""
    numbers: tuple[tuple[str, Any], ...] = ()
    """Numbers of the camera file that are replaced, by their dotted keys."""


class Published(Config):
    """A published value with a tolerance, or one or two bounds. Units are the quantity's."""

    value: float | None = Field(None, description="a value; needs a tolerance")
    tolerance: Annotated[float, Field(ge=0.0)] | None = Field(
        None, description="largest difference from `value`, or excess over a bound (0 if left out)"
    )
    above: float | None = Field(None, description="a lower bound")
    below: float | None = Field(None, description="an upper bound")

    @model_validator(mode="after")
    def _has_one_form(self) -> Self:
        if (self.value is None) == (self.above is None and self.below is None):
            raise ValueError(
                "give either `value`, or one or both of the bounds `above` and `below`"
            )
        if self.value is not None and self.tolerance is None:
            raise ValueError("a value needs a tolerance")
        if self.ends[0] > self.ends[1]:
            raise ValueError("the bound `above` must be less than the bound `below`")
        return self

    @property
    def ends(self) -> tuple[float, float]:
        """The lowest and highest value that agree with the publication; infinite if there is no
        bound."""
        if self.value is not None:
            return self.value, self.value
        low = -float("inf") if self.above is None else self.above
        high = float("inf") if self.below is None else self.below
        return low, high

    def limits(self, nearest: float, tolerance: float = 0.0) -> tuple[float, float]:
        """Return the lowest and highest value that pass: ``tolerance`` beyond the ends, or a share
        ``nearest`` of the value if that is more."""
        slack = max(tolerance, nearest * abs(self.value or 0.0))
        return self.ends[0] - slack, self.ends[1] + slack

    def in_words(self) -> str:
        """Return a text such as ``1.42 ± 0.05``, ``below 17`` or ``0.15 to 0.35``."""
        if self.value is not None:
            return f"{self.value:g} ± {self.tolerance:g}"
        ends = (("above", self.above), ("below", self.below))
        words = [f"{key} {bound:g}" for key, bound in ends if bound is not None]
        return " to ".join(f"{end:g}" for end in self.ends) if len(words) == 2 else words[0]


class Figure(Config):
    """A published figure in the file."""

    name: Annotated[
        str,
        Field(pattern=r"^[a-z0-9_]+$", description="small letters, digits and _; once in the file"),
    ]
    camera: str
    quantity: str
    conditions: dict[str, Any]
    published: Published
    source: Annotated[str, Field(min_length=3)]
    tag: Literal["R", "D", "S", "W", "M"]
    """Kind of source, as on the page."""
    calibration: bool
    """The camera file was, or may have been, fitted to the figure."""
    kind: Literal["reality", "code"] = "reality"
    """A figure of real cameras, or a check of the code against the arithmetic of a stated filter
    or limit."""
    note: str = ""
    """Assumptions."""
    fails: str = ""
    """Why the figure is known to fail; a failure without a reason counts as a regression."""

    @property
    def limits(self) -> tuple[float, float]:
        """The lowest and highest simulated value that pass."""
        nearest = NEAR if self.kind == "reality" else 0.0
        return self.published.limits(nearest, self.published.tolerance or 0.0)

    @property
    def use(self) -> Literal["blind", "calibration", "code"]:
        """The use of the figure; a blind figure tests the model against real cameras and was not
        used to fit it."""
        if self.kind == "code":
            return "code"
        return "calibration" if self.calibration else "blind"

    @cached_property
    def measures(self) -> Quantity:
        """The figure's quantity."""
        return QUANTITIES[self.quantity]

    @cached_property
    def request(self) -> Request:
        """The camera, quantity and complete conditions of the measurement."""
        conditions = self.measures.conditions.from_data(self.conditions)
        return Request(self.camera, self.quantity, conditions)

    def what(self) -> str:
        """Return a text such as ``temporal deviation, 1.5 m, albedo 0.8``."""
        return f"{self.measures.title}, {in_words(self.request.conditions)}"


class Family(Config):
    """Figures of one camera and quantity that differ in one condition."""

    name: Annotated[
        str,
        Field(pattern=r"^[a-z0-9_]+$", description="small letters, digits and _; once in the file"),
    ]
    over: str
    """The condition. An angle of incidence counts by 1 / cos, as the illuminated area does."""
    figures: Annotated[tuple[str, ...], Field(min_length=FEWEST)]
    """Names of the figures."""
    note: str = ""
    """What is known of the family."""
    fails: str = ""
    """Why the family is known to be off or to have a trend."""


def _problem_of(family: Family, figures: Mapping[str, Figure]) -> str:
    """Return what is wrong with a family's figures, by their names; empty if nothing is."""
    unknown = [name for name in family.figures if name not in figures]
    if unknown:
        return f"the family {family.name} names no figure of the file: {', '.join(unknown)}"
    members = [figures[name] for name in family.figures]
    kinds = {(figure.camera, figure.quantity, figure.use) for figure in members}
    if len(kinds) > 1:
        return f"the family {family.name} mixes cameras, quantities or uses"
    if any(not figure.published.value for figure in members):
        return f"the family {family.name} has a figure without a value, or with the value 0"
    conditions = [figure.request.conditions.to_data().get(family.over) for figure in members]
    if None in conditions or len(set(conditions)) == 1:
        return f"the family {family.name} does not vary in {family.over}"
    return ""


class FiguresFile(Config):
    """The file of figures."""

    figures: Annotated[tuple[Figure, ...], Field(min_length=1)]
    """All figures."""
    families: tuple[Family, ...] = ()
    """Families of some of them."""


def read_figures(path: Path = FIGURES_FILE) -> FiguresFile:
    """Read a file of figures. Raises UserError with each missing, unknown or illegal key and its
    place."""
    source = read_yaml(path)
    entries = child(source.data, "figures")
    problems = list[Problem]()
    first: dict[str, int] = {}
    splices: dict[KeyPath, type[Config]] = {}
    if not isinstance(entries, list):
        entries = []
    for number, data in enumerate(entries):
        for key, legal in (("quantity", QUANTITIES), ("camera", camera_names())):
            word = child(data, key)
            yaml_path = ("figures", number, key)
            if not isinstance(word, str) or (key == "camera" and word.endswith(".yaml")):
                continue
            if word not in legal:
                problems.append(wrong_choice(yaml_path, word, legal, source.place_of(yaml_path)))
        quantity = child(data, "quantity")
        name = child(data, "name")
        conditions = child(data, "conditions")
        if isinstance(quantity, str) and quantity in QUANTITIES and isinstance(conditions, dict):
            splices["figures", number, "conditions"] = QUANTITIES[quantity].conditions
        if isinstance(name, str) and first.setdefault(name, number) != number:
            location = source.place_of(("figures", number, "name"))
            used = source.place_of(("figures", first[name], "name"))
            text = f"two figures have the name {name}"
            problems.append(Problem(text, location, other=used, other_says="first used at"))
    file, declared = validated(FiguresFile, source, splices)
    if problems or file is None:
        raise DeclarationError(str(path), [*problems, *declared])
    by_name = {figure.name: figure for figure in file.figures}
    for number, family in enumerate(file.families):
        fault = _problem_of(family, by_name)
        if fault:
            position = source.place_of(("families", number, "figures"))
            problems.append(Problem(fault, position))
    if problems:
        raise DeclarationError(str(path), problems)
    return file


@dataclass(frozen=True)
class Score:
    """A published figure and its simulated value."""

    figure: Figure
    simulated: Reading

    @property
    def ratio(self) -> float:
        """The simulated value divided by the published value, or by the nearer bound; NaN if that
        is 0."""
        value = self.simulated.value
        nearest = min(self.figure.published.ends, key=lambda end: abs(end - value))
        return value / nearest if nearest else float("nan")

    @property
    def passes(self) -> bool:
        """True if the simulated value lies within the figure's limits; False without a value."""
        low, high = self.figure.limits
        return bool(low <= self.simulated.value <= high)

    @property
    def strict(self) -> bool | None:
        """True if the simulated value lies within `NEAR` of the published value; None for bounds
        and checks of the code."""
        if self.figure.kind != "reality" or self.figure.published.value is None:
            return None
        low, high = self.figure.published.limits(NEAR)
        return bool(low <= self.simulated.value <= high)

    @property
    def passes_by_tolerance(self) -> bool:
        """True if a figure of a real camera passes only by the source's tolerance, which is wider
        than `NEAR`."""
        if self.figure.kind != "reality" or not self.passes:
            return False
        low, high = self.figure.published.limits(NEAR)
        return not low <= self.simulated.value <= high

    @property
    def grade(self) -> int:
        """The number of bands that hold a value: that in which it passes, that of the source's own
        tolerance, and that of `NEAR`. 1 for a bound that holds."""
        published = self.figure.published
        if published.value is None:
            return int(self.passes)
        low, high = published.limits(0.0, published.tolerance or 0.0)
        is_within_own = low <= self.simulated.value <= high
        return int(self.passes) + int(is_within_own) + int(bool(self.strict))

    @property
    def fell_behind(self) -> bool:
        """True if the figure fails and the file gives no reason."""
        return not self.passes and not self.figure.fails

    @property
    def verdict(self) -> str:
        """The verdict: ``pass``, ``pass (tolerance)``, ``fail`` with a reason in the file, or
        ``FAIL (new)``."""
        if self.passes_by_tolerance:
            return "pass (tolerance)"
        if self.passes:
            return "pass"
        return "FAIL (new)" if self.fell_behind else "fail"


def measured(requests: Iterable[Request], effort: Effort, jobs: int) -> dict[Request, Reading]:
    """Measure all requests, ``jobs`` scenes at a time. The results do not depend on ``jobs`` or on
    the order."""
    scenes: dict[str, list[Request]] = defaultdict(list)
    for request in requests:
        scene = [request.camera, request.numbers, *scene_of(request.conditions)]
        scenes[canonical_json(scene)].append(request)
    groups = list(scenes.values())
    results: dict[Request, Reading] = {}
    last_s = time.monotonic()
    with ProcessPoolExecutor(jobs, system.new_processes()) as pool:
        mapped = map if jobs == 1 else pool.map
        measurements = mapped(measure_group, groups, [effort] * len(groups))
        for group, readings in zip(groups, measurements, strict=True):
            results |= zip(group, readings, strict=True)
            if time.monotonic() - last_s > PROGRESS_EVERY_S:
                last_s = time.monotonic()
                progress = f"measured {len(results)} of {sum(map(len, groups))} numbers"
                print(progress, file=sys.stderr, flush=True)
    return results


def measure_group(group: Sequence[Request], effort: Effort) -> list[Reading]:
    """Measure quantities of a camera on a single scene, in this process."""
    readings = []
    for request in group:
        bench = Bench(request.camera, effort, request.numbers)
        readings.append(QUANTITIES[request.quantity].measure(bench, request.conditions))
    return readings


SCORE_FILE: dict[str, Any] = {"formats": ("csv",), "digits": "%.9g"}


@dataclass(frozen=True)
class Beside:
    """A reading of the capture and of the simulation."""

    where: str
    """Plane, edge, or simulated set-up."""
    quantity: str
    at: str
    """Condition of the reading."""
    unit: str
    """Unit of the values; empty for shares."""
    pixels: int
    """Number of pixels, of holes, or of lines across an edge."""
    measured: Reading
    simulated: Reading


def number(value: float) -> str:
    """Return three significant digits, or ``none`` if there is no value."""
    if np.isnan(value):
        return "none"
    if 0.0995 <= abs(value) < 99.95:
        return f"{value:#.3g}"
    if abs(value) >= 99.95 or value == 0:
        return f"{value:.3g}"
    return f"{value:.2g}"


def _interval(between: Interval) -> str:
    if not between.known:
        return "–"
    high = number(between.high) if np.isfinite(between.high) else "inf"
    return f"{number(between.low)} to {high}"


def _reading(name: str, low: str, high: str, note: str) -> tuple[Column, ...]:
    """Return the columns of a reading, its value and the ends of its interval: three in a file,
    two on a page."""
    return (
        Column(name, name, f"{name}.value", note, number),
        Column(low, "", f"{name}.interval.low", "lower end of its 95 % interval"),
        Column(high, "", f"{name}.interval.high", "upper end of its 95 % interval"),
        Column("", "95 %", f"{name}.interval", text=_interval),
    )


def _ratio(row: Beside) -> str:
    measured = row.measured.value
    simulated = row.simulated.value
    is_comparable = row.unit == "mm" and measured > 0 and np.isfinite(simulated)
    return f"{simulated / measured:.2f}" if is_comparable else "–"


def _named(score: Score) -> str:
    return f"{score.figure.what()}\n{score.figure.name}"


def _yes_or_no(strict: bool | None) -> str:
    if strict is None:
        return "–"
    return "yes" if strict else "no"


def _remarks(score: Score) -> str:
    why = f"Why it fails: {score.figure.fails}. " if score.figure.fails else ""
    return why + score.figure.note[:1].upper() + score.figure.note[1:]


VERSION = Column(
    "results_version", "", lambda row: RESULTS_VERSION, "version of the tables' format"
)
SCORES = Table(
    "scorecard",
    "one row per published figure",
    (
        Column("name", "", "figure.name", "name in the file of figures"),
        Column("camera", "", "figure.camera", "simulated camera"),
        Column("", "camera", lambda score: camera_title(score.figure.camera)),
        Column("figure", "", lambda score: score.figure.what(), "quantity and conditions in words"),
        Column("", "figure", _named, brief=lambda text: text.partition("\n")[0]),
        Column("quantity", "", "figure.quantity", "quantity that is measured"),
        Column("unit", "", "figure.measures.unit", "unit of all values"),
        *_reading("simulated", "low", "high", "simulated value"),
        Column("published", "", lambda score: score.figure.published.in_words(), "published value"),
        Column(
            "",
            "published",
            lambda score: f"{score.figure.published.in_words()} {score.figure.measures.unit}",
        ),
        Column(
            "ratio",
            "ratio",
            "ratio",
            "simulated divided by published value, or by the nearer bound",
            number,
        ),
        Column("passes_from", "", lambda score: score.figure.limits[0], "lowest value that passes"),
        Column("passes_to", "", lambda score: score.figure.limits[1], "highest value that passes"),
        Column(
            "verdict",
            "verdict",
            "verdict",
            "whether it passes",
            tone=lambda score: "good" if score.passes else "bad",
        ),
        Column(
            "strict",
            "strict",
            "strict",
            "whether it lies within 25 % of the published value; empty for bounds and checks",
            _yes_or_no,
        ),
        Column(
            "use",
            "use",
            "figure.use",
            "blind, calibration (the camera file may be fitted to it) or code",
        ),
        Column(
            "tag",
            "",
            "figure.tag",
            "R read, D derived, S secondary, W measured on captures, M a guess",
        ),
        Column("source", "", "figure.source", "source of the published value"),
        Column("", "source", lambda score: f"[{score.figure.tag}] {score.figure.source}"),
        Column("note", "", "figure.note", "assumptions"),
        Column("fails", "", "figure.fails", "why it is known to fail"),
        Column("", "note", _remarks, brief=False),
        VERSION,
    ),
    left=20,
    kind="scores",
    **SCORE_FILE,
)
BESIDE = Table(
    "capture",
    "one row per reading of a capture, beside that of its simulation",
    (
        Column("where", "where", "where", "plane or edge"),
        Column("quantity", "quantity", "quantity", "quantity that is measured"),
        Column("at", "at", "at", "condition"),
        Column("unit", "", "unit", "unit of the values"),
        Column("pixels", "pixels", "pixels", "pixels, or lines across an edge"),
        *_reading("measured", "measured_low", "measured_high", "value in the capture"),
        *_reading("simulated", "simulated_low", "simulated_high", "value in its simulation"),
        Column("", "ratio", _ratio),
        Column("", "unit", lambda row: row.unit or "–"),
        VERSION,
    ),
    left=3,
    **SCORE_FILE,
)
