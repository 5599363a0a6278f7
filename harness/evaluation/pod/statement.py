"""What is said of one set of inspections, however it was analysed: the curve, its bounds, and what led to them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from harness.evaluation.pod.curve import Bound, PodCurve

POD, CONFIDENCE = 0.9, 0.95
"""The field's customary statement, a90/95."""
DRAWN = 241
"""Sizes at which curve and band are drawn."""


@dataclass(frozen=True)
class ModelRow:
    """One model that was tried: its name, how far from the data (``criterion``, smaller is better), its sizes."""

    name: str
    criterion: float
    a50: float
    a90: float
    bound: Bound
    chosen: bool


@dataclass(frozen=True)
class SignalModel:
    """The straight line behind a curve from signals: y = b0 + b1 x with deviation ``tau``; y, x logarithms if so said.
    ``left``, ``right``, ``decision`` are signals as read, None where nothing is censored."""

    b0: float
    b1: float
    tau: float
    log_signal: bool
    left: float | None
    right: float | None
    decision: float


@dataclass(frozen=True)
class PodStatement:
    """Sizes are in ``unit`` of the file. ``size``, ``response`` (n,) as read; ``sizes``, ``lower``, ``upper`` (m,) the
    band of POD to be drawn; ``independent``: the bound had every row been a target of its own, None where it was.
    ``numbers``: whatever else the fit says, by name; ``tests``: (what, p-value, how it reads)."""

    path: Path
    kind: str
    unit: str
    size_column: str
    response_column: str
    size: np.ndarray
    response: np.ndarray
    targets: int
    curve: PodCurve
    model: str
    criterion: str
    models: tuple[ModelRow, ...]
    bound: Bound
    others: tuple[Bound, ...]
    independent: Bound | None
    sizes: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    numbers: dict[str, float]
    notes: tuple[str, ...]
    signal: SignalModel | None = None
    tests: tuple[tuple[str, float, str], ...] = ()

    @property
    def a50(self) -> float:
        """The size found half the time."""
        return self.curve.size_at(0.5)

    @property
    def a90(self) -> float:
        """The size found 90 % of the time: an estimate, no bound."""
        return self.curve.size_at(POD)

    @property
    def counts(self) -> str:
        """How many rows, targets and hits the statement stands on."""
        rows = f"{len(self.size)} inspections of {self.targets} targets"
        return rows if self.signal else f"{rows}, {int(self.response.sum())} hits"

    def to_data(self) -> dict[str, Any]:
        """The statement as JSON's types; an infinite size becomes None, and ``why`` says so."""
        curve = self.curve
        return {
            "file": str(self.path),
            "kind": self.kind,
            "unit": self.unit,
            "size_column": self.size_column,
            "response_column": self.response_column,
            "inspections": len(self.size),
            "targets": self.targets,
            "hits": None if self.signal else int(self.response.sum()),
            "model": self.model,
            "curve": {
                "link": curve.link,
                "log_size": curve.log_size,
                "mu": curve.mu,
                "sigma": curve.sigma,
                "covariance_mu_sigma": np.asarray(curve.covariance).tolist(),
                "floor": curve.floor,
                "ceiling": curve.ceiling,
            },
            "a50": finite(self.a50),
            "a90": finite(self.a90),
            "a90_95": _bound_data(self.bound),
            "other_bounds": [_bound_data(one) for one in self.others],
            "if_every_inspection_were_a_target": None if self.independent is None else _bound_data(self.independent),
            "models": [
                {
                    "model": row.name,
                    self.criterion: finite(row.criterion),
                    "a50": finite(row.a50),
                    "a90": finite(row.a90),
                    "a90_95": _bound_data(row.bound),
                    "chosen": row.chosen,
                }
                for row in self.models
            ],
            "numbers": {name: finite(value) for name, value in self.numbers.items()},
            "tests": [{"test": what, "p": finite(p), "reads": reads} for what, p, reads in self.tests],
            "notes": list(self.notes),
        }


def finite(value: float) -> float | None:
    """The number, or None where JSON has none for it."""
    return float(value) if np.isfinite(value) else None


def drawn_sizes(size: np.ndarray, log_size: bool, marks: tuple[float, ...]) -> np.ndarray:
    """Sizes (`DRAWN`,) from just below the smallest to just above the largest, and past those of ``marks`` that are no
    more than twice the largest size away; in equal steps, or in equal ratios where ``log_size``."""
    low, high = float(size.min()), float(size.max())
    high = max([high, *(one for one in marks if np.isfinite(one) and high < one < 2 * high)])
    if log_size:
        margin = (high / low) ** 0.04
        return np.geomspace(low / margin, high * margin, DRAWN)
    margin = 0.04 * (high - low)
    start = max(low - margin, 0.0) if low >= 0 else low - margin
    return np.linspace(start, high + margin, DRAWN)


def _bound_data(bound: Bound) -> dict[str, Any]:
    return {
        "pod": bound.pod,
        "confidence": bound.confidence,
        "method": bound.method,
        "size": finite(bound.value),
        "demonstrated": bound.demonstrated,
        "why": bound.why,
    }
