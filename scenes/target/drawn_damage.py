"""What damage the boards of a drawn family have: kind, number, sizes and depths."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Annotated, Literal

import numpy as np
from pydantic import AfterValidator, Field

from harness.vocabulary.config import Config
from scenes.target.checks import SHALLOWEST_BEND
from scenes.target.custom import DentConfig, HoleConfig


def _ascending(limits: tuple[float, float]) -> tuple[float, float]:
    if limits[0] > limits[1]:
        raise ValueError(f"the lower limit {limits[0]:g} is above the upper limit {limits[1]:g}")
    return limits


Diameter = Annotated[float, Field(ge=0.2, le=1e3)]
Diameters = Annotated[tuple[Diameter, Diameter], AfterValidator(_ascending)]
Depth = Annotated[float, Field(ge=0.04, le=500.0)]
Depths = Annotated[tuple[Depth, Depth], AfterValidator(_ascending)]


class _Drawn(Config):
    """How many damages a board has, and how large they are.

    The range of sizes is parted into ``per_board`` equal parts, and every board has one size from each, uniform within
    it: over all boards sizes are uniform, and each board covers the range evenly.
    """

    per_board: Annotated[int, Field(ge=1, le=100)]
    diameter_mm: Diameters
    sizes: Literal["uniform", "log"] = Field(
        default="uniform",
        description="uniform in the diameter, as MIL-HDBK-1823A advises for the sizes of targets, or in its logarithm",
    )

    def diameters_mm(self, rng: np.random.Generator) -> list[float]:
        """One from each part of the range, ascending."""
        low, high = self.diameter_mm
        quantiles = (np.arange(self.per_board) + rng.random(self.per_board)) / self.per_board
        sizes = low * (high / low) ** quantiles if self.sizes == "log" else low + (high - low) * quantiles
        drawn: list[float] = np.clip(sizes, low, high).tolist()
        return drawn


class DrawnThrough(_Drawn):
    """Holes drilled through."""

    kind: Literal["through"]


class DrawnBlind(_Drawn):
    """Holes with a flat bottom. Depths are uniform, one from each of ``per_board`` equal parts of their range, in
    random order: size and depth are independent."""

    kind: Literal["blind"]
    depth_mm: Depths


class DrawnDents(_Drawn):
    """Spherical caps. Depths as of blind holes, but of that part of the range which is legal for the dent's size: no
    deeper than its radius, and on a bent face no shallower than its ball allows (`scenes.target.checks`)."""

    kind: Literal["dent"]
    depth_mm: Depths

    def legal_depths_mm(self, diameter_mm: float, bend_per_mm: float) -> tuple[float, float]:
        """The declared depths that a dent of this size can have on a face of this curvature; none if low > high."""
        low_mm, high_mm = self.depth_mm
        return max(low_mm, shallowest_mm(diameter_mm, bend_per_mm)), min(high_mm, diameter_mm / 2)


DrawnDamage = Annotated[DrawnThrough | DrawnBlind | DrawnDents, Field(discriminator="kind")]


def shallowest_mm(diameter_mm: float, bend_per_mm: float) -> float:
    """Depth of a dent whose ball's radius is `SHALLOWEST_BEND` of a face's radius of curvature; 0 on a flat one."""
    reach = diameter_mm / 2 * bend_per_mm / SHALLOWEST_BEND * (1 + 1e-9)
    if reach >= 1:
        return diameter_mm / 2
    return diameter_mm / 2 * reach / (1 + math.sqrt(1 - reach**2))


def depth_problems(
    damage: DrawnThrough | DrawnBlind | DrawnDents, thickness_mm: float, bend_per_mm: float
) -> list[str]:
    """Depths that a board so thick, with a face so bent, cannot have."""
    if isinstance(damage, DrawnThrough):
        return []
    low_mm, high_mm = damage.depth_mm
    problems = []
    if high_mm >= thickness_mm:
        problems.append(f"damage.depth_mm: {high_mm:g} mm is not less than the board's thickness, {thickness_mm:g} mm")
    if isinstance(damage, DrawnBlind):
        return problems
    # Both limits grow with the diameter, so the ends of the sizes tell for all.
    for diameter_mm in sorted(set(damage.diameter_mm)):
        least_mm, most_mm = damage.legal_depths_mm(diameter_mm, bend_per_mm)
        if least_mm > most_mm:
            shallowest = shallowest_mm(diameter_mm, bend_per_mm)
            problems.append(
                f"damage.depth_mm: a dent {diameter_mm:g} mm wide on this face can be {shallowest:.3g} to "
                f"{diameter_mm / 2:g} mm deep, not {low_mm:g} to {high_mm:g} mm"
            )
    return problems


def damages_of(
    damage: DrawnThrough | DrawnBlind | DrawnDents,
    diameters_mm: Sequence[float],
    depth_quantiles: Sequence[float],
    places_mm: np.ndarray,
    bend_per_mm: float,
) -> tuple[tuple[HoleConfig, ...], tuple[DentConfig, ...]]:
    """Holes and dents of one board: ids from 1 in the order given, each depth at its quantile of what is legal."""
    holes, dents = [], []
    rows = zip(diameters_mm, depth_quantiles, places_mm.tolist(), strict=True)
    for number, (size, quantile, (x, y)) in enumerate(rows, start=1):
        if isinstance(damage, DrawnDents):
            depth = _between(damage.legal_depths_mm(size, bend_per_mm), quantile)
            dents.append(DentConfig(id=number, diameter_mm=size, depth_mm=depth, centre_mm=(x, y)))
        else:
            blind = _between(damage.depth_mm, quantile) if isinstance(damage, DrawnBlind) else None
            holes.append(HoleConfig(id=number, diameter_mm=size, centre_mm=(x, y), kind=damage.kind, depth_mm=blind))
    return tuple(holes), tuple(dents)


def _between(limits: tuple[float, float], quantile: float) -> float:
    return float(min(limits[0] + (limits[1] - limits[0]) * quantile, limits[1]))
