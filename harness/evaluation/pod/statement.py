"""The statement on one set of inspections, from hits and misses or from signals: curve, bounds, and their basis."""

from __future__ import annotations

import csv
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from harness.evaluation.pod.ahat import LEVEL, AhatFit, ahat_band, ahat_bound, choose_axes, diagnose
from harness.evaluation.pod.curve import Bound, PodCurve
from harness.evaluation.pod.hit_miss import (
    METHODS,
    Between,
    HitMissFit,
    bound,
    choose_model,
    fit_hit_miss,
    floor_ceiling_test,
    largest_bound,
    near_models,
    widest_band,
)
from harness.vocabulary.errors import UserError
from harness.vocabulary.files import TABLE_BYTES, bounded_bytes

FEWEST_ROWS = 10
"""Too few below this for two parameters and a bound; MIL-HDBK-1823A asks for 60 targets (hit/miss) or 40 (signal)."""
SEPARATORS = (",", ";", "\t")


@dataclass(frozen=True)
class Inspections:
    """One inspection a row: ``size`` (n,) in the file's unit, ``response`` (n,) hits as 0/1 or signals, ``target`` (n,)
    the name of what was inspected, None where every row is a target of its own; ``line`` (n,) of the file, from 1."""

    path: Path
    size_column: str
    response_column: str
    size: np.ndarray
    response: np.ndarray
    target: np.ndarray | None
    line: np.ndarray

    @property
    def targets(self) -> int:
        """Number of different targets."""
        return len(self.size) if self.target is None else len(set(self.target.tolist()))


def read_inspections(path: Path, size: str, response: str, target: str | None = None) -> Inspections:
    """Read the named columns of a UTF-8 file with a header row; comma, semicolon or tab between columns (with the
    latter two a comma within a number is its decimal mark). UserError with the line for what cannot be read."""
    (_, header), *rows = _lines(path)
    header = [name.strip() for name in header]
    chosen = [name for name in (size, response, target) if name is not None]
    for name in chosen:
        if chosen.count(name) > 1:
            raise UserError(f"column {name!r} is chosen twice", fix="name a different column for each option")
        if header.count(name) > 1:
            raise UserError(f"{path}: {header.count(name)} columns are called {name!r}", fix="rename all but one")
        if name not in header:
            from harness.vocabulary.declaration.diagnose import nearest

            near, legal = nearest(name, header), ", ".join(map(repr, header))
            fix = f"did you mean {near!r}?" if near else "name one of these columns"
            raise UserError(f"{path}: no column {name!r}", legal=legal, fix=fix)
    for line, row in rows:
        if len(row) != len(header):
            fix = "put text that holds a separator in double quotes"
            raise UserError(f"{path}, line {line}: {len(row)} fields, and the header has {len(header)}", fix=fix)
    if len(rows) < FEWEST_ROWS:
        legal = f"at least {FEWEST_ROWS}; 60 targets (hit/miss) or 40 (signal) are what the standard asks for"
        raise UserError(f"{path}: {len(rows)} rows are too few for a POD curve", legal=legal)
    lines = np.array([line for line, _ in rows])
    texts = [[row[header.index(name)].strip() for _, row in rows] for name in chosen]
    numbers = []
    for name, column in zip(chosen[:2], texts[:2], strict=True):
        numbers.append(np.array([_number(text) for text in column]))
        if (wrong := ~np.isfinite(numbers[-1])).any():
            text = column[int(np.argmax(wrong))]
            said = f"{path}, line {lines[wrong][0]}: {name} is {repr(text) if text else 'empty'}, not a number"
            raise UserError(said, legal="a finite number in every row", fix="mend the row, or take it out")
    seen: dict[str, int] = {}
    for k, name in enumerate(texts[2] if target else ()):
        if not name:
            raise UserError(f"{path}, line {lines[k]}: {target} is empty", fix="name the target, or take the row out")
        before, now = numbers[0][first := seen.setdefault(name, k)], numbers[0][k]
        if before != now:
            said = f"{path}: target {name!r} has size {before:g} in line {lines[first]} and {now:g} in line {lines[k]}"
            raise UserError(said, fix="give every target one size (the true one), or different targets different names")
    return Inspections(path, size, response, numbers[0], numbers[1], np.array(texts[2]) if target else None, lines)


def require_hits(read: Inspections) -> None:
    """Refuse responses that are neither 0 nor 1, or that are all the same."""
    wrong = ~np.isin(read.response, (0.0, 1.0))
    if wrong.any():
        where, value = f"{read.path}, line {read.line[wrong][0]}", read.response[wrong][0]
        fix = "a column of signals is analysed with --ahat and --decision"
        said = f"{where}: {read.response_column} is {value:g}, which is neither hit nor miss"
        raise UserError(said, legal="1 for a hit, 0 for a miss", fix=fix)
    if np.ptp(read.response) == 0:
        kind = "hits" if read.response[0] else "misses"
        said = f"{read.path}: all {len(read.response)} rows of {read.response_column} are {kind}"
        raise UserError(f"{said}, and a curve needs both hits and misses", fix="add targets of other sizes")


def require_positive(read: Inspections, response: bool, why: str) -> None:
    """Refuse a size (or a response) that has no logarithm; ``why`` names the option that asks for it."""
    values, column = (read.response, read.response_column) if response else (read.size, read.size_column)
    wrong = values <= 0
    if wrong.any():
        said = f"{read.path}, line {read.line[wrong][0]}: {column} is {values[wrong][0]:g}, which has no logarithm"
        raise UserError(said, legal=f"values above 0 with {why}", fix=f"leave out {why}, or take out the rows")


def _lines(path: Path) -> list[tuple[int, list[str]]]:
    """(line, fields) of every row that is not blank; the separator is the one that parts the header most."""
    try:
        text = bounded_bytes(path, TABLE_BYTES).decode("utf-8-sig")
    except OSError as error:
        reason = (error.strerror or "no reason given").lower()
        raise UserError(f"{path}: cannot be read ({reason})", fix="name a CSV file") from error
    except UnicodeDecodeError as error:
        raise UserError(f"{path}: is not UTF-8 text", fix="save it as CSV in UTF-8") from error
    first = next((line for line in text.splitlines() if line.strip()), "")
    if not first:
        raise UserError(f"{path}: is empty", legal="a header row with column names, then one row an inspection")
    separator = max(SEPARATORS, key=lambda one: len(next(csv.reader([first], delimiter=one))))
    reader = csv.reader(text.splitlines(keepends=True), delimiter=separator)
    try:
        rows = [(reader.line_num, row) for row in reader if any(field.strip() for field in row)]
    except csv.Error as error:
        raise UserError(f"{path}, line {reader.line_num}: {error}", fix="save the file as CSV") from error
    if separator != ",":  # a comma is then the decimal mark
        return [rows[0], *((line, [field.replace(",", ".") for field in row]) for line, row in rows[1:])]
    return rows


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return float("nan")


POD, CONFIDENCE = 0.9, 0.95
"""The field's customary statement, a90/95."""
DRAWN = 241
"""Sizes at which curve and band are drawn."""
LEAST_TARGETS = 60
"""MIL-HDBK-1823A: independent targets that a hit/miss study should have at least."""
TESTED: dict[Between, str] = {
    "floor": "a floor: hits by chance at any size",
    "ceiling": "a ceiling: misses at any size",
    "both": "floor and ceiling",
}


@dataclass(frozen=True)
class ModelRow:
    """One model that was tried: its name, how far from the data (``criterion``, smaller is better), its sizes;
    ``near``: its bound is one of those of which the statement's is the largest."""

    name: str
    criterion: float
    a50: float
    a90: float
    bound: Bound
    chosen: bool
    near: bool


@dataclass(frozen=True)
class PodStatement:
    """Sizes are in ``unit``. ``size``, ``response`` (n,) as read; ``sizes``, ``lower``, ``upper`` (m,) the band to be
    drawn; ``independent``: the bound had every row been a target of its own, None where it was. ``numbers``: what else
    the fit says; ``tests``: (what, p-value, how it reads); ``signal``: the regression, None of hits. ``fits``: of hits,
    the models over which bounds and band are the widest, that of ``curve`` first."""

    path: Path
    kind: str
    unit: str
    size_column: str
    response_column: str
    size: np.ndarray
    response: np.ndarray
    targets: int
    curve: PodCurve
    a50: float
    a90: float
    model: str
    models: tuple[ModelRow, ...]
    bound: Bound
    others: tuple[Bound, ...]
    independent: Bound | None
    sizes: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    numbers: dict[str, float]
    notes: tuple[str, ...]
    signal: AhatFit | None
    tests: tuple[tuple[str, float, str], ...]
    fits: tuple[HitMissFit, ...] = ()
    criterion: str = "deviance"

    @property
    def counts(self) -> str:
        """Numbers of rows, targets and hits of the statement."""
        rows = f"{len(self.size)} inspections of {self.targets} targets"
        return rows if self.signal else f"{rows}, {int(self.response.sum())} hits"

    def to_data(self) -> dict[str, Any]:
        """The statement as JSON's types; an infinite size becomes None, and ``why`` says so."""
        curve, names = self.curve, ("kind", "unit", "size_column", "response_column", "targets", "model")
        of_curve = {name: getattr(curve, name) for name in ("link", "log_size", "mu", "sigma", "floor", "ceiling")}
        models = [
            {"model": row.name, self.criterion: finite(row.criterion), "a50": finite(row.a50), "a90": finite(row.a90)}
            | {"a90_95": _bound_data(row.bound), "chosen": row.chosen, "in_a90_95": row.near}
            for row in self.models
        ]
        return {
            "file": str(self.path),
            **{name: getattr(self, name) for name in names},
            "inspections": len(self.size),
            "hits": None if self.signal else int(self.response.sum()),
            "curve": {**of_curve, "covariance_mu_sigma": np.asarray(curve.covariance).tolist()},
            "a50": finite(self.a50),
            "a90": finite(self.a90),
            "a90_95": _bound_data(self.bound),
            "other_bounds": [_bound_data(one) for one in self.others],
            "if_every_inspection_were_a_target": None if self.independent is None else _bound_data(self.independent),
            "models": models,
            "numbers": {name: finite(value) for name, value in self.numbers.items()},
            "tests": [{"test": what, "p": finite(p), "reads": reads} for what, p, reads in self.tests],
            "notes": list(self.notes),
        }


def state_hits(
    read: Inspections,
    *,
    link: str | None = None,
    log_size: bool | None = None,
    bounded: Between = "none",
    method: str = "likelihood ratio",
    unit: str = "",
    tested: bool = True,
) -> PodStatement:
    """State the curve of hits and misses: of all links and sizes or their logarithms (of those that ``link``,
    ``log_size`` leave) the fit with the least deviance, with a floor or ceiling where ``bounded``; bounds by all
    `METHODS` that it has, ``method``'s first, each the largest over the `near_models` of those left. Of targets
    inspected more than once also the limit as if every row had its own. ``tested``: for a floor and a ceiling, which
    takes most of the time."""
    from threadpoolctl import threadpool_limits

    # L-BFGS-B hands systems of four unknowns to LAPACK, whose threads wait for each other: 9 s, not 0.6 s, on two
    # busy cores.
    with threadpool_limits(1, user_api="blas"):
        size, hit = read.size, read.response
        tried = choose_model(size, hit, inspections=read.target, bounded=bounded)
        left = [one for one in tried if link in (None, one.curve.link) and log_size in (None, one.curve.log_size)]
        fit, near = left[0], near_models(left)
        curve, notes, tests, independent = fit.curve, list(fit.notes), [], None
        if fit.targets < fit.n:
            # A fit of its own, because where hits and misses separate the penalty counts targets.
            axes = [(one.curve.link, one.curve.log_size, one.bounded) for one in near]
            rows = [fit_hit_miss(size, hit, link=of, log_size=log, bounded=with_) for of, log, with_ in axes]
            independent = largest_bound(rows, method)
        if tested and bounded == "none" and fit.method == "ML":
            model: dict[str, Any] = {"link": curve.link, "log_size": curve.log_size, "inspections": read.target}
            tests = [floor_ceiling_test(size, hit, bounded=one, **model) for one in TESTED]
        models = [(one, bound(one, POD, CONFIDENCE, method)) for one in tried]
        others = [one for one in METHODS if one != method and (bounded == "none" or one != "wald")]
        further = tuple(largest_bound(near, one) for one in others)
        limit = largest_bound(near, method)
        sizes = drawn_sizes(size, curve.log_size, (curve.size_at(POD), limit.value))
        lower, upper = widest_band(near, sizes, method)

    if fit.targets < LEAST_TARGETS:
        notes.append(f"{fit.targets} independent targets; MIL-HDBK-1823A asks for at least {LEAST_TARGETS}")
    if limit.demonstrated and limit.value > (largest := float(size.max())):
        notes.append(f"a90/95 = {limit.value:.4g} lies beyond the largest size inspected, {largest:.4g}")
    if any(test.needed for test in tests):
        likeliest = min(tests, key=lambda test: test.p_value)
        said_p = f"(p = {likeliest.p_value:.2g}): see --bounded {likeliest.bounded}"
        notes.append(f"the curve has no floor or ceiling, and the data speak for {TESTED[likeliest.bounded]} {said_p}")
    said = []
    for test in tests:
        fitted = f"(floor {test.fit.curve.floor:.3f}, ceiling {test.fit.curve.ceiling:.3f})"
        said.append((TESTED[test.bounded], test.p_value, f"{'needed' if test.needed else 'not needed'} {fitted}"))
    errors = np.sqrt(np.diag(fit.covariance)).tolist()
    numbers = {"b0": fit.b0, "b0's standard error": errors[0], "b1": fit.b1, "b1's standard error": errors[1]}
    numbers |= {name: getattr(curve, name) for name in ("mu", "sigma", "floor", "ceiling")}
    numbers |= {"deviance": fit.deviance, "deviance of a constant": fit.null_deviance}
    numbers |= {"log likelihood": fit.log_likelihood, "inspections": float(fit.n)}
    numbers |= {"targets": float(fit.targets), "hits": float(fit.hits)}
    bounds = (limit, further, independent)
    drawn = (sizes, lower, upper)
    return _statement(read, "hit/miss", unit, near, models, bounds, drawn, numbers, notes, said)


def state_signals(
    read: Inspections,
    *,
    decision: float,
    left: float | None = None,
    right: float | None = None,
    log_size: bool | None = None,
    log_signal: bool | None = None,
    unit: str = "",
) -> PodStatement:
    """State the curve of signals against sizes. Of all pairs of axes the data allow (of those with ``log_size``,
    ``log_signal`` where not None) the one with the least deviance; bounds by the delta method on x."""
    tried = choose_axes(read.size, read.response, decision=decision, left=left, right=right, inspections=read.target)
    fits = [fit for fit in tried if log_size in (None, fit.log_size) and log_signal in (None, fit.log_signal)]
    if not fits:
        fix = "leave out --log or --log-signal"
        raise UserError(f"{read.path}: the axes asked for need logarithms of values <= 0", fix=fix)
    fit, curve = fits[0], fits[0].curve
    limit = ahat_bound(fit, POD, CONFIDENCE)
    sizes = drawn_sizes(read.size, fit.log_size, (curve.size_at(POD), limit.value))
    rows = ahat_bound(fit, POD, CONFIDENCE, rows_are_targets=True) if fit.targets < fit.n else None
    (of_mu, common), (_, of_sigma) = curve.covariance.tolist()
    numbers = {"b0": fit.b0, "b1": fit.b1, "tau": fit.tau, "mu": curve.mu, "sigma": curve.sigma}
    numbers |= {"variance of mu": of_mu, "covariance of mu, sigma": common, "variance of sigma": of_sigma}
    numbers |= {"signals at or below --left": float(fit.below.sum())}
    numbers |= {"signals at or above --right": float(fit.above.sum()), "decision": fit.decision}
    models = [(one, ahat_bound(one, POD, CONFIDENCE)) for one in tried]
    drawn = (sizes, *ahat_band(fit, sizes, CONFIDENCE))
    reads = {True: f"doubtful at {LEVEL:.0%}", False: f"nothing against it at {LEVEL:.0%}"}
    said = [(f"{one.assumption} ({one.test})", one.p_value, reads[one.p_value < LEVEL]) for one in diagnose(fit)]
    kind, bounds = "signal against size", (limit, (), rows)
    return _statement(read, kind, unit, (fit,), models, bounds, drawn, numbers, list(fit.notes), said)


def _statement(
    read: Inspections,
    kind: str,
    unit: str,
    fits: tuple[Any, ...],
    models: list[tuple[Any, Bound]],
    bounds: tuple[Bound, tuple[Bound, ...], Bound | None],
    drawn: tuple[np.ndarray, np.ndarray, np.ndarray],
    numbers: dict[str, float],
    notes: list[str],
    tests: list[tuple[str, float, str]],
) -> PodStatement:
    """The statement of the first of ``fits``, all of them among ``models`` (fits with their limits). ``bounds``: limit,
    others, of rows."""
    fit: HitMissFit | AhatFit = fits[0]

    def name(one: HitMissFit | AhatFit) -> str:
        size = "ln size" if one.curve.log_size else "size"
        if isinstance(one, AhatFit):
            return f"{'ln signal' if one.log_signal else 'signal'} against {size}"
        bounded = {"none": "", "both": ", floor and ceiling"}.get(one.bounded, f", {one.bounded}")
        return f"{one.curve.link}, {size}{bounded}"

    rows = [
        ModelRow(
            name(one), one.deviance, one.curve.size_at(0.5), one.curve.size_at(POD), limit, one is fit, one in fits
        )
        for one, limit in models
    ]
    a50, a90, signal = fit.curve.size_at(0.5), fit.curve.size_at(POD), fit if isinstance(fit, AhatFit) else None
    columns = (read.size_column, read.response_column, read.size, read.response, read.targets)
    what = (fit.curve, a50, a90, name(fit), tuple(rows))
    of_hits = fits if signal is None else ()
    first = (read.path, kind, unit, *columns, *what)
    return PodStatement(*first, *bounds, *drawn, numbers, tuple(notes), signal, tuple(tests), of_hits)


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
    told = {name: getattr(bound, name) for name in ("pod", "confidence", "method", "demonstrated", "why")}
    return {**told, "size": finite(bound.value)}
