"""A whole study judged: every set-up's limit and curves, limits over the axes, and the limits of validity."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from harness.evaluation.study.axes import AxisLine, axis_lines
from harness.evaluation.study.chance import ChanceHits, chance_hits
from harness.evaluation.study.curves import (
    FreeResponse,
    PixelCurves,
    Roc,
    free_response,
    pixel_curves,
    roc_curves,
)
from harness.evaluation.study.limit import SetUpLimit, SizeRow, limit_of, pod_at
from harness.evaluation.study.over_boards import DRAWS
from harness.evaluation.study.record import SetUpRecord, StudyRecord
from harness.evaluation.study.surface import PodSurface, surface_of
from harness.evaluation.study.validity import Section, validity_of
from harness.tables.trials import ResultTables

if TYPE_CHECKING:
    import pandas as pd

NOISE_SHARE = 0.95
"""Signals up to this quantile of those at unflawed places are noise's: censored in the regression of signals."""


@dataclass(frozen=True, eq=False)
class SetUpResult:
    """One set-up: ``limit``; ``chance`` hits (None: nothing to lay them over); ``roc`` over sites by classes of size;
    ``free_response``; ``pixels`` (None where not counted); ``surface`` over diameter and depth, or ``surface_why``
    there is none; ``sizes``: POD at the diameters that were asked for; ``noise_floor``: signal of unflawed places."""

    limit: SetUpLimit
    chance: ChanceHits | None
    roc: tuple[Roc, ...]
    free_response: FreeResponse | None
    pixels: PixelCurves | None
    surface: PodSurface | None
    surface_why: str
    sizes: tuple[SizeRow, ...]
    noise_floor: float


@dataclass(frozen=True, eq=False)
class StudyResult:
    """All set-ups in the record's order, lines of limits over the swept axes, and the limits of validity as headings
    with their sentences."""

    record: StudyRecord
    set_ups: tuple[SetUpResult, ...]
    axes: tuple[AxisLine, ...]
    validity: tuple[Section, ...]

    @property
    def limits(self) -> tuple[SetUpLimit, ...]:
        """Every set-up's limit."""
        return tuple(one.limit for one in self.set_ups)


def evaluate_study(
    record: StudyRecord,
    tables: ResultTables,
    facts: Mapping[str, Any],
    *,
    diameters_mm: Sequence[float] = (),
    draws: int = DRAWS,
) -> StudyResult:
    """Judge a study. ``facts``: its resolved experiment as plain data; ``diameters_mm``: where POD is wanted in a
    table. Deterministic; a set-up without a curve is no error (its limit says why)."""
    set_ups = tuple(_set_up(one, tables, record.hit_radius_mm, diameters_mm, draws) for one in record.set_ups)
    limits = [one.limit for one in set_ups]
    validity = validity_of(record, limits, [one.chance for one in set_ups], facts)
    return StudyResult(record, set_ups, axis_lines(limits), validity)


def _set_up(
    record: SetUpRecord, tables: ResultTables, radius_mm: float, diameters_mm: Sequence[float], draws: int
) -> SetUpResult:
    def own(table: pd.DataFrame) -> pd.DataFrame:
        if table.empty:
            return table
        return table[(table["variant"] == record.variant) & (table["frames"] == record.frames)]

    holes, sites, runs = own(tables.holes), own(tables.sites), own(tables.runs)
    floor = _noise_floor(sites)
    limit = limit_of(record, draws=draws, noise_floor=floor)
    surface, surface_why = surface_of(record, draws)
    classes = (limit.a50_mm, limit.a90_mm) if limit.statement else (np.nan, np.nan)
    chance = None
    if not holes.empty and not runs.empty:
        chance = chance_hits(holes, sites, runs, own(tables.findings), radius_mm, limit.false_calls, draws)
    return SetUpResult(
        limit=limit,
        chance=chance,
        roc=roc_curves(holes, sites, record.threshold, *classes, draws),
        free_response=free_response(own(tables.operating), runs, holes, classes[0], draws),
        pixels=pixel_curves(own(tables.pixels), draws),
        surface=surface,
        surface_why=surface_why,
        sizes=pod_at(limit, diameters_mm),
        noise_floor=floor,
    )


def _noise_floor(sites: pd.DataFrame) -> float:
    signal = sites["signal"].to_numpy(float) if len(sites) else np.zeros(0)
    signal = signal[np.isfinite(signal)]
    return float(np.quantile(signal, NOISE_SHARE)) if len(signal) else np.nan
