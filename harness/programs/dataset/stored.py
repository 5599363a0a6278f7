"""Checks of a data set before maps are scored on it: its index, the truth of a board, and a
board's arrays. They may have been edited, or damaged on their way."""

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from harness.vocabulary.errors import UserError

AGAIN = "write or copy the data set again"
Real = Annotated[float, Field(allow_inf_nan=False)]
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
PART = r"[^/\\.][^/\\]*"
"""A part of a name: no folder above it."""
SampleName = Annotated[str, Field(pattern=rf"^{PART}/(train|validation|test)/{PART}/[0-9]+$")]
Point = Annotated[list[Real], Field(min_length=2, max_length=2)]


class StoredFacts(BaseModel):
    """Facts as they are stored: types are not converted, and further facts are legal."""

    model_config = ConfigDict(strict=True, extra="ignore")


class CategoryFacts(StoredFacts):
    """A category of an index."""

    units: Annotated[int, Field(ge=1)]
    """Number of units of the camera."""
    frames: Annotated[int, Field(ge=1)]
    """Number of averaged frames."""


class IndexFacts(StoredFacts):
    """The part of ``dataset.json`` that a score needs."""

    name: str
    """Name of the experiment."""
    content: str
    """Digest of all that determines the files."""
    samples: list[SampleName] | None
    """Names of all boards; None while the data set is unfinished."""
    categories: dict[str, CategoryFacts]
    """The categories by name."""
    false_calls_per_m2: Positive
    """The wanted rate of false calls."""
    hit_radius_mm: Positive
    """Largest distance of a hit."""
    hit_overlap: Annotated[float, Field(gt=0, le=1)] | None
    """Least overlap of a hit; None if only the distance counts."""


class DamageFacts(StoredFacts):
    """One damage of a board."""

    id: Annotated[int, Field(ge=1)]
    """Its number on the board, and in the mask."""
    line_m: Annotated[list[Point], Field(min_length=1)]
    """Its centre or centre line on the face."""
    diameter_mm: Positive
    """Its true size."""
    depth_mm: Annotated[float, Field(ge=0, allow_inf_nan=False)]
    """Its true depth."""
    x_board_mm: Real
    """Its centre on the board, to the right."""
    y_board_mm: Real
    """Its centre on the board, upwards."""
    size_of: str = "diameter"
    """What the size is: diameter, width or length."""


class TruthFacts(StoredFacts):
    """The part of a board's ``truth.json`` that a score needs."""

    board: Annotated[int, Field(ge=0)]
    """Number of the board."""
    damages: list[DamageFacts]
    """Its damage."""


def refuse_odd_facts(file: Path, facts: Mapping[str, Any], form: type[StoredFacts]) -> None:
    """Raise UserError if a file's facts do not have this form."""
    try:
        form.model_validate(facts)
    except ValidationError as error:
        first = error.errors()[0]
        path_text = ".".join(str(part) for part in first["loc"])
        problem = f"{file}: {path_text[:100]}: {first['msg'].lower()}"
        raise UserError(problem, legal="as tofpod dataset writes it", fix=AGAIN) from error


def refuse_odd_arrays(file: Path, arrays: Mapping[str, np.ndarray]) -> None:
    """Raise UserError if a board's arrays ``inspected`` (h, w) bool, ``board_xy_m`` (h, w, 2) and
    ``damage`` (h, w) do not belong together, or no pixel is inspected. Others are not looked at."""
    inspected = arrays.get("inspected")
    if inspected is None:
        return
    shape = inspected.shape
    reason = ""
    if inspected.dtype != bool or len(shape) != 2 or min(shape) < 2:
        reason = f"inspected is {inspected.dtype} {shape}, not a mask"
    for name, kinds, wanted in (("board_xy_m", "f", (*shape, 2)), ("damage", "iu", shape)):
        array = arrays.get(name)
        if array is not None and (array.dtype.kind not in kinds or array.shape != wanted):
            reason = reason or f"{name} is {array.dtype} {array.shape} beside a mask {shape}"
    if not reason and not inspected.any():
        reason = "no pixel is inspected"
    if not reason and not np.isfinite(arrays.get("board_xy_m", np.zeros(1))).any():
        reason = "no pixel has a place on the face"
    if not reason and "damage" in arrays and arrays["damage"].min() < 0:
        reason = "a number of a damage is below 0"
    if reason:
        raise UserError(f"{file}: {reason}", legal="as tofpod dataset writes it", fix=AGAIN)
