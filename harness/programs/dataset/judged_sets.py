"""Sets of pictures on which anomaly maps are judged: tofpod's own, and those of others."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from harness.programs.dataset.boards import read_arrays, read_index, read_truth
from harness.vocabulary.errors import UserError

LINK_M = 0.010  # longest step within a finding, as in `detectors.score_map`
VALIDATION = "validation"


@dataclass(frozen=True, eq=False)
class JudgedPicture:
    """A picture with its truth."""

    inspected: np.ndarray
    """Pixels (h, w) bool that count."""
    places_m: np.ndarray
    """Place (h, w, 2) of each pixel on the face; NaN off it."""
    damage: np.ndarray
    """Number (h, w) of the damage at each pixel; 0: none."""
    link_m: float
    """Longest step between pixels of one finding."""


class JudgedSet(Protocol):
    """Pictures by name, ``<category>/<split>/<label>/<number>``."""

    name: str
    """Name of the set."""
    content: str
    """Digest of what it holds."""
    false_calls_per_m2: float | None
    """Rate of false calls that it was made for; None if nobody stated one."""
    hit_radius_mm: float
    """Largest distance from a damage to the centre of a finding that hits it."""
    hit_overlap: float | None
    """Share of a finding's pixels on a damage from which it is a hit; None if not used."""
    categories: Mapping[str, Mapping[str, Any]]
    """Facts of each category: ``frames`` and ``units``."""

    def wanted(self, named: set[str]) -> set[str]:
        """Return the pictures that need a map, given those that have one."""
        ...

    def picture(self, name: str) -> JudgedPicture:
        """Read a picture. Raises UserError."""
        ...

    def damages(self, name: str) -> tuple[int, list[dict[str, Any]]]:
        """Read a picture's number and its damages, as ``truth.json`` of `tofpod dataset` has them:
        id, line_m, diameter_mm, depth_mm, x_board_mm, y_board_mm, size_of. Raises UserError."""
        ...

    def quiet_split(self, category: str, named: Sequence[str]) -> str:
        """Return the split whose good pictures set the threshold. Raises UserError."""
        ...


class BoardSet:
    """A folder that `tofpod dataset` wrote."""

    def __init__(self, folder: Path) -> None:
        """Read the index. Raises UserError, also for an unfinished set."""
        index = read_index(folder)
        if index["samples"] is None:
            fix = "run the command that wrote it again; it continues"
            raise UserError(f"{folder}: is not finished", fix=fix)
        self.folder = folder
        self.name: str = index["name"]
        self.content: str = index["content"]
        self.false_calls_per_m2: float | None = index["false_calls_per_m2"]
        self.hit_radius_mm: float = index["hit_radius_mm"]
        self.hit_overlap: float | None = index["hit_overlap"]
        self.categories: Mapping[str, Mapping[str, Any]] = index["categories"]
        self._samples: list[str] = index["samples"]

    def wanted(self, named: set[str]) -> set[str]:
        """Return the boards of `VALIDATION` and ``test``."""
        return {name for name in self._samples if name.split("/")[1] in (VALIDATION, "test")}

    def learning(self, category: str) -> list[str]:
        """Return the good boards of ``train`` in a category."""
        return sorted(name for name in self._samples if name.startswith(f"{category}/train/good/"))

    def picture(self, name: str) -> JudgedPicture:
        """Read a board."""
        inspected, places_m, damage = read_arrays(
            self.folder, name, "inspected", "board_xy_m", "damage"
        )
        return JudgedPicture(inspected, places_m.astype(float), damage, LINK_M)

    def damages(self, name: str) -> tuple[int, list[dict[str, Any]]]:
        """Read a board's truth."""
        truth = read_truth(self.folder, name)
        return truth["board"], truth["damages"]

    def quiet_split(self, category: str, named: Sequence[str]) -> str:
        """Return `VALIDATION`, which no limit is judged on."""
        if not any(name.startswith(f"{category}/{VALIDATION}/") for name in named):
            raise UserError(f"{self.folder}: {category} has no board of {VALIDATION}")
        return VALIDATION
