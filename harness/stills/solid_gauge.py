"""A solid gauge, printed or machined in one piece: its truth, and corrections by a calliper.

Frame ``gauge``: x right, y up, z out of the plate's face, origin at the face's centre, mm. All
places and sizes are those of the model; `corrected` puts measured sizes in their place."""

import csv
import io
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from harness.vocabulary.config import Config
from harness.vocabulary.declaration.diagnose import settings_of
from harness.vocabulary.errors import UserError
from harness.vocabulary.files import RECORD_BYTES, bounded_bytes, strict_json
from harness.vocabulary.provenance import check_version

SOLID_VERSION = 1
VERSION_KEY = "solid_gauge_version"
CALLIPER_COLUMNS = ("element", "quantity", "nominal_mm", "measured_mm", "uncertainty_mm")
# a calliper that differs from the model by more than this share and length was read incorrectly
WRONG_SHARE = 0.05
WRONG_MM = 1.0
Length = Annotated[float, Field(gt=0, le=2e3)]
PlaceMm = Annotated[float, Field(ge=-2e3, le=2e3)]
Name = Annotated[str, Field(min_length=1, max_length=40)]


class SolidMark(Config):
    """A coded mark, whose black modules are recessed into the face."""

    code: Annotated[int, Field(ge=0, le=999)]
    x_mm: PlaceMm
    y_mm: PlaceMm
    side_mm: Length


class SolidSphere(Config):
    """A sphere on a post, truncated where the post meets it."""

    name: Name
    x_mm: PlaceMm
    y_mm: PlaceMm
    z_mm: PlaceMm
    """Height of its centre above the face."""
    diameter_mm: Length


class SolidStep(Config):
    """A block with a level top."""

    name: Name
    x_mm: PlaceMm
    y_mm: PlaceMm
    side_mm: Length
    """Side of its square top."""
    height_mm: Length


class SolidGroove(Config):
    """A groove along y with round ends, as a cutter leaves it."""

    name: Name
    x_mm: PlaceMm
    y_mm: PlaceMm
    width_mm: Length
    length_mm: Length
    depth_mm: Length


class SolidPocket(Config):
    """A round blind hole with a level floor."""

    name: Name
    x_mm: PlaceMm
    y_mm: PlaceMm
    diameter_mm: Length
    depth_mm: Length


class SolidUncertainty(Config):
    """Standard uncertainties of the piece."""

    place_mm: Annotated[float, Field(ge=0, le=5)]
    """Of a centre or a level, independent for each element."""
    scale: Annotated[float, Field(ge=0, le=0.1)]
    """Of the scale that all elements share (shrinkage), relative."""


class SolidGauge(Config):
    """The truth of a solid gauge."""

    made: Literal["printed", "cut"]
    dictionary: str
    """OpenCV's name of the marks' codes."""
    width_mm: Length
    height_mm: Length
    thickness_mm: Length
    mark_depth_mm: Length
    post_mm: Length
    """Diameter of the spheres' posts."""
    marks: tuple[SolidMark, ...]
    spheres: Annotated[tuple[SolidSphere, ...], Field(min_length=3, max_length=12)]
    steps: Annotated[tuple[SolidStep, ...], Field(min_length=1)]
    grooves: tuple[SolidGroove, ...]
    pockets: tuple[SolidPocket, ...]
    uncertainty: SolidUncertainty

    @property
    def centres_mm(self) -> np.ndarray:
        """Centres (n, 3) of the spheres."""
        return np.array([(ball.x_mm, ball.y_mm, ball.z_mm) for ball in self.spheres])

    @property
    def diameters_mm(self) -> np.ndarray:
        """Diameters (n,) of the spheres."""
        return np.array([ball.diameter_mm for ball in self.spheres])


def read_solid_gauge(path: Path) -> SolidGauge:
    """Read the truth file of a solid gauge. Raises UserError if it cannot be read or is another
    kind of file."""
    legal = "the gauge.json that tofpod gauge --print or --cut wrote"
    try:
        data = strict_json(bounded_bytes(path, RECORD_BYTES))
    except (OSError, ValueError) as error:
        raise UserError(f"--gauge {path}: cannot be read ({error})", legal=legal) from error
    if not isinstance(data, dict) or VERSION_KEY not in data:
        raise UserError(f"--gauge {path}: is not the truth of a solid gauge", legal=legal)
    check_version(data.pop(VERSION_KEY), SOLID_VERSION, path, "a solid gauge")
    return settings_of(SolidGauge, data, f"--gauge {path}")


# ---------------------------------------------------------------- what a calliper corrects


def calliper_sizes(gauge: SolidGauge) -> dict[tuple[str, str], float]:
    """Return the sizes in mm that a calliper can correct, by element and quantity."""
    sizes = {
        ("plate", "width"): gauge.width_mm,
        ("plate", "height"): gauge.height_mm,
    }
    for ball in gauge.spheres:
        sizes[ball.name, "diameter"] = ball.diameter_mm
        sizes[ball.name, "top above face"] = ball.z_mm + ball.diameter_mm / 2
    for step in gauge.steps:
        sizes[step.name, "height"] = step.height_mm
    return sizes


def calliper_form(gauge: SolidGauge) -> str:
    """Return the table that a user fills in: a measured size and its standard uncertainty beside
    each nominal size."""
    buffer = io.StringIO()
    writer = csv.writer(buffer, lineterminator="\n")
    writer.writerow(CALLIPER_COLUMNS)
    for (element, quantity), nominal_mm in calliper_sizes(gauge).items():
        writer.writerow([element, quantity, f"{nominal_mm:g}", "", ""])
    return buffer.getvalue()


def corrected(gauge: SolidGauge, path: Path) -> SolidGauge:
    """Return the gauge with the sizes of a filled-in form; empty rows keep the nominal size.

    The plate's sides scale all places in x and y; a sphere's top and diameter place its centre.
    The common uncertainty of scale becomes that of the plate's sides if both are measured, and
    that of places the largest of a step's height and a sphere's centre (top and half of the
    diameter) if all elements are. Raises UserError for a malformed row."""
    measured = _measured(gauge, path)
    sizes = calliper_sizes(gauge)

    def size(element: str, quantity: str) -> float:
        key = (element, quantity)
        return measured[key][0] if key in measured else sizes[key]

    x_scale = size("plate", "width") / gauge.width_mm
    y_scale = size("plate", "height") / gauge.height_mm

    def moved(element: Config) -> dict[str, float]:
        return {"x_mm": element.x_mm * x_scale, "y_mm": element.y_mm * y_scale}  # type: ignore[attr-defined]

    spheres = []
    for ball in gauge.spheres:
        diameter_mm = size(ball.name, "diameter")
        z_mm = size(ball.name, "top above face") - diameter_mm / 2
        sizes_mm = {"diameter_mm": diameter_mm, "z_mm": z_mm}
        spheres.append(ball.model_copy(update=moved(ball) | sizes_mm))
    steps = []
    for step in gauge.steps:
        height_mm = size(step.name, "height")
        steps.append(step.model_copy(update=moved(step) | {"height_mm": height_mm}))
    changed = {
        "width_mm": size("plate", "width"),
        "height_mm": size("plate", "height"),
        "spheres": tuple(spheres),
        "steps": tuple(steps),
    }
    for kind in ("marks", "grooves", "pockets"):
        elements = getattr(gauge, kind)
        changed[kind] = tuple(one.model_copy(update=moved(one)) for one in elements)
    changed["uncertainty"] = _uncertainty(gauge, measured)
    return gauge.model_copy(update=changed)


def _uncertainty(
    gauge: SolidGauge, measured: dict[tuple[str, str], tuple[float, float]]
) -> SolidUncertainty:
    """Return the uncertainty after corrections (size, standard uncertainty) in mm."""
    place_mm = gauge.uncertainty.place_mm
    scale = gauge.uncertainty.scale
    of_elements = [key for key in calliper_sizes(gauge) if key[0] != "plate"]
    if all(key in measured for key in of_elements):
        of_steps_mm = [measured[step.name, "height"][1] for step in gauge.steps]
        of_spheres_mm = [
            float(np.hypot(measured[name, "top above face"][1], measured[name, "diameter"][1] / 2))
            for name in (ball.name for ball in gauge.spheres)
        ]
        place_mm = max(*of_steps_mm, *of_spheres_mm)
    sides = [("plate", "width"), ("plate", "height")]
    if all(side in measured for side in sides):
        scale = max(measured[side][1] / measured[side][0] for side in sides)
    return SolidUncertainty(place_mm=place_mm, scale=scale)


def _measured(gauge: SolidGauge, path: Path) -> dict[tuple[str, str], tuple[float, float]]:
    """Return the filled-in rows: size and standard uncertainty in mm, by element and quantity."""
    legal = f"the calliper.csv of tofpod gauge, with columns {', '.join(CALLIPER_COLUMNS)}"
    try:
        text = bounded_bytes(path, RECORD_BYTES).decode("utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise UserError(f"--calliper {path}: cannot be read ({error})", legal=legal) from error
    reader = csv.DictReader(io.StringIO(text))
    if tuple(reader.fieldnames or ()) != CALLIPER_COLUMNS:
        raise UserError(f"--calliper {path}: has other columns", legal=legal)
    sizes = calliper_sizes(gauge)
    measured = {}
    for line, row in enumerate(reader, start=2):
        where = f"--calliper {path}, line {line}"
        key = (row["element"], row["quantity"])
        if key not in sizes:
            raise UserError(f"{where}: the gauge has no {key[0]} with a {key[1]}", legal=legal)
        size_text = (row["measured_mm"] or "").strip()
        if not size_text:
            continue
        try:
            size_mm = float(size_text)
            uncertainty_mm = float(row["uncertainty_mm"] or "")
        except ValueError as error:
            problem = f"{where}: needs two numbers: measured_mm and uncertainty_mm"
            raise UserError(problem, legal="millimetres, such as 29.93,0.03") from error
        off_mm = abs(size_mm - sizes[key])
        if not off_mm <= WRONG_SHARE * sizes[key] + WRONG_MM:
            problem = f"{where}: {size_mm:g} mm is far from the nominal {sizes[key]:g} mm"
            raise UserError(problem, fix="check the reading, or leave measured_mm empty")
        if not 0 <= uncertainty_mm <= WRONG_MM:
            problem = f"{where}: an uncertainty of {uncertainty_mm:g} mm"
            raise UserError(problem, legal=f"0 to {WRONG_MM:g} mm (one standard deviation)")
        measured[key] = (size_mm, uncertainty_mm)
    return measured
