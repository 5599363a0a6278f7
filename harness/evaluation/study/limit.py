"""The detection limit of one set-up: a90/95, its bound over resampled boards, and POD over
diameter and depth.

The quoted limit is the likelihood ratio bound of the hit/miss curve, the largest over models that
fit about equally well (`harness.evaluation.pod.statement.state_hits`). It takes damages as
independent targets, which damages of one board are not quite; so a second bound multiplies the
criterion by the boards' design effect. If the a50 of boards scatters by 2 mm about 6 mm, a90/95 of
the true model covers 88 % (60 boards) and 91 % (20), the second bound 93 % and 95 %; if boards do
not matter, both cover 95 to 97 %. The upper percentile over resampled boards does not replace it:
it covers 86 % with 20 boards (300 studies, ``tests/validation/study_coverage.py``). A study draws
boards at random, not damages, so whole boards are resampled with replacement (cluster bootstrap;
Davison and Hinkley 1997, section 3.8)."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.optimize import linprog
from scipy.stats import chi2

from harness.evaluation.intervals import (
    UNKNOWN,
    FalseCallRate,
    Interval,
    false_call_rate,
    percentiles,
)
from harness.evaluation.pod.curve import (
    CELLS,
    Bound,
    HitsAndMisses,
    PodCurve,
    link_cdf,
    link_ppf,
    maxima,
    penalised_maxima,
    slopes_of_link,
)
from harness.evaluation.pod.hit_miss import METHOD, largest_bound
from harness.evaluation.pod.inspections import Inspections
from harness.evaluation.pod.statement import CONFIDENCE, POD, PodStatement, state_hits
from harness.evaluation.study.record import Inspected, SetUpRecord, Unflawed
from harness.evaluation.study.units import OverUnits, over_units
from harness.vocabulary.errors import UserError
from harness.vocabulary.seeds import random_stream

DRAWS = 500  # the 95 % percentile is then the 475th smallest, known to about one percentile


@dataclass(frozen=True, eq=False)
class Targets:
    """One damage per row. ``size_mm``: (n,). ``hits``: (n,) of ``inspections`` (n,). ``unit``
    (n,): of the camera, if each unit's inspections of a damage are a separate row."""

    board: np.ndarray
    size_mm: np.ndarray
    hits: np.ndarray
    inspections: np.ndarray
    unit: np.ndarray | None = None


def targets_of(
    board: np.ndarray, hole: np.ndarray, size_mm: np.ndarray, hit: np.ndarray
) -> Targets:
    """Combine rows (n,) of inspections into targets: repeats of one damage of one board are one
    target."""
    _, boards = np.unique(board, return_inverse=True)
    _, holes = np.unique(hole, return_inverse=True)
    _, first, which = np.unique(
        boards * (holes.max(initial=0) + 1) + holes, return_index=True, return_inverse=True
    )
    hits = np.bincount(which, np.asarray(hit, float))
    inspections = np.bincount(which).astype(float)
    return Targets(board[first], size_mm[first], hits, inspections)


def _drawn(stream: np.random.Generator, boards: int, draws: int) -> np.ndarray:
    if not boards:
        return np.zeros((draws, 0))
    return stream.multinomial(boards, np.full(boards, 1.0 / boards), size=draws).astype(float)


def weights_in_blocks(
    draws: int, *rows: tuple[np.ndarray, str]
) -> Iterator[tuple[np.ndarray, ...]]:
    """Resample boards for one or several (board (n,), population). Yield, in blocks of draws to
    limit the memory, how often each draw has the board of each row, (draws, n). Draws are the same
    for equal numbers of boards of a population, so set-ups are paired; two populations ("damaged",
    "hole-free") are drawn independently."""
    found = [(*np.unique(board, return_inverse=True), population) for board, population in rows]
    streams = [
        random_stream(0, "boards drawn again", population, len(names))
        for names, _, population in found
    ]
    at_once = max(1, CELLS // max(1, *(len(which) for _, which, _ in found)))
    for first in range(0, draws, at_once):
        count = min(at_once, draws - first)
        drawn = zip(streams, found, strict=True)
        yield tuple(
            _drawn(stream, len(names), count)[:, which] for stream, (names, which, _) in drawn
        )


def refitted_sizes(
    targets: Targets, curve: PodCurve, pods: tuple[float, ...], draws: int = DRAWS
) -> np.ndarray:
    """Refit ``curve``'s link and axis to resampled boards: sizes (len(pods), draws) in mm, by
    Firth's likelihood if hits and misses are separated. Infinite if nothing is found or POD does
    not grow; smallest if all is found."""
    rows = [(targets.board, "damaged")] + (
        [] if targets.unit is None else [(targets.unit, "units")]
    )
    blocks = (
        _refitted(targets, curve, pods, np.multiply.reduce(w))
        for w in weights_in_blocks(draws, *rows)
    )
    return np.concatenate(list(blocks), axis=1)


def _refitted(
    targets: Targets, curve: PodCurve, pods: tuple[float, ...], weights: np.ndarray
) -> np.ndarray:
    """Refit the curve to targets with ``weights`` (draws, n)."""
    x = np.log(targets.size_mm) if curve.log_size else targets.size_mm
    centre = float(x.mean())
    spread = float(x.std()) or 1.0
    z = (x - centre) / spread
    hits = weights * targets.hits
    misses = weights * (targets.inspections - targets.hits)
    largest_miss = np.where(misses > 0, z, -np.inf).max(axis=1)
    smallest_hit = np.where(hits > 0, z, np.inf).min(axis=1)
    repeats = (weights @ targets.inspections) / weights.sum(axis=1)
    data = HitsAndMisses(np.column_stack([np.ones_like(z), z]), hits, misses, curve.link)
    start = np.array([(centre - curve.mu) / curve.sigma, spread / curve.sigma])
    b = np.full((len(weights), 2), np.nan)
    overlap = largest_miss > smallest_hit
    b[overlap] = maxima(data.of(overlap), start)
    apart = np.isfinite(largest_miss) & np.isfinite(smallest_hit) & ~overlap
    if apart.any():
        separated = HitsAndMisses(
            data.design, hits[apart], misses[apart], curve.link, repeats[apart]
        )
        b[apart] = penalised_maxima(separated, 1e-6)
    at = crossings(b, curve.link, pods)
    at[:, largest_miss == -np.inf] = z.min()
    with np.errstate(over="ignore"):
        return np.asarray(np.exp(centre + spread * at) if curve.log_size else centre + spread * at)


def crossings(b: np.ndarray, link: str, pods: tuple[float, ...]) -> np.ndarray:
    """Return the sizes (len(pods), draws) at which curves ``b`` (draws, 2) have these PODs;
    infinite if none."""
    levels = link_ppf(link, np.array(pods))[:, None]
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(b[:, 1] > 0, (levels - b[:, 0]) / b[:, 1], np.inf)


def design_effect(targets: Targets, curve: PodCurve, pod: float) -> float:
    """Return the variance of the size with this POD with boards as units over that with damages as
    units: 1 if damages of one board are no more alike than those of two. Both are sandwich
    variances (Liang and Zeger, Biometrika 73 (1986), 13) with G / (G - 1) for G units. NaN below
    two boards."""
    if len(np.unique(targets.board)) < 2 or len(targets.board) < 3:
        return np.nan
    x = np.log(targets.size_mm) if curve.log_size else targets.size_mm
    up, down, _ = slopes_of_link(curve.link, (x - curve.mu) / curve.sigma)
    slope = targets.hits * up - (targets.inspections - targets.hits) * down
    design = np.column_stack([np.ones_like(x), x])
    # x_p = (level - b0) / b1: its slopes by b0 and b1.
    gradient = -curve.sigma * np.array(
        [1.0, curve.mu + curve.sigma * float(link_ppf(curve.link, np.array(pod)))]
    )
    information = design.T @ ((targets.inspections * up * down)[:, None] * design)
    influence = (design * slope[:, None]) @ np.linalg.solve(information, gradient)
    _, which = np.unique(targets.board, return_inverse=True)
    units = (np.bincount(which, influence), influence)
    of_boards, of_targets = (float((unit**2).sum() * len(unit) / (len(unit) - 1)) for unit in units)
    return of_boards / of_targets if of_targets > 0 else np.nan


LINKS = ("logit", "probit")
# ratio of the deepest to the shallowest damage from which a coefficient of depth is estimated
LEAST_RATIO = 1.2
# number of diameters at which the depth found is drawn, in equal ratios over those inspected
STEPS = 25


@dataclass(frozen=True, eq=False)
class PodSurface:
    """POD over diameter a and depth d. ``b`` (4,): coefficients of 1, ln a, ln d and ln a ln d,
    sizes in mm; the last is 0 unless its p-value, ``interaction_p``, is below 5 %. ``d90_mm``
    (k,): the depth found 90 % of the time at each ``diameter_mm`` (k,), infinite if depth does not
    help. ``d90_low_mm``, ``d90_high_mm`` (k,): its 95 % percentiles over boards, which hold the
    truth in 87 % of studies of 30 boards. ``depth_range_mm``: inspected."""

    link: str
    b: np.ndarray
    interaction_p: float
    deviance: float
    diameter_mm: np.ndarray
    d90_mm: np.ndarray
    d90_low_mm: np.ndarray
    d90_high_mm: np.ndarray
    depth_range_mm: tuple[float, float]
    note: str = ""

    def pod(self, diameter_mm: np.ndarray, depth_mm: np.ndarray) -> np.ndarray:
        """Return POD at diameters and depths of a common shape."""
        a = np.log(diameter_mm)
        d = np.log(depth_mm)
        return link_cdf(self.link, self.b[0] + self.b[1] * a + self.b[2] * d + self.b[3] * a * d)


def depth_varies(depth_mm: np.ndarray) -> bool:
    """Return whether depths (n,) differ enough to matter."""
    return bool(len(depth_mm) and depth_mm.max() >= LEAST_RATIO * depth_mm.min())


def surface_of(record: SetUpRecord, draws: int = DRAWS) -> tuple[PodSurface | None, str]:
    """Fit the surface; None, and the reason, if there is none."""
    seen = record.inspected
    hit = seen.hit
    if not len(hit) or hit.all() or not hit.any():
        return None, "all damages had the same outcome: there is no surface to fit"
    diameters = (float(seen.diameter_mm.min()), float(seen.diameter_mm.max()))
    depths = (float(seen.depth_mm.min()), float(seen.depth_mm.max()))
    if depths[0] <= 0 or not depth_varies(seen.depth_mm):
        return None, "depth does not vary: {:g} to {:g} mm".format(*depths)
    if diameters[0] == diameters[1]:
        return None, f"{seen.size_of} does not vary: {diameters[0]:g} mm"
    a = np.log(seen.diameter_mm)
    d = np.log(seen.depth_mm)
    crossed = np.stack([np.ones_like(a), a, d, a * d], axis=1)
    if _separated(crossed[:, :3], hit):
        return (
            None,
            f"hits and misses do not overlap over {seen.size_of} and depth (separation): no surface fits",
        )
    repeats = len(hit) / len({*zip(seen.board.tolist(), seen.hole.tolist(), strict=True)})

    def fit(link: str, design: np.ndarray) -> tuple[float, np.ndarray, str]:
        """Return deviance, coefficients (4,) and link."""
        hits = hit.astype(float)
        b = _coefficients(design, hits[None], 1 - hits[None], link)[0]
        return (
            float(-2 * HitsAndMisses(design, hits, 1 - hits, link).value(b)),
            np.pad(b, (0, 4 - len(b))),
            link,
        )

    deviance, b, link = min((fit(link, crossed[:, :3]) for link in LINKS), key=lambda made: made[0])
    if b[1] <= 0:
        return None, f"the probability of detection does not grow with {seen.size_of}"
    p = np.nan
    terms = 3
    note = "POD falls with depth" if b[2] < 0 else ""
    if not _separated(crossed, hit):
        least, bent, _ = fit(link, crossed)
        p = float(chi2.sf(max(deviance - least, 0.0) / repeats, 1))
        rises = (
            min(bent[1] + bent[3] * np.log(depths).min(), bent[1] + bent[3] * np.log(depths).max())
            > 0
        )
        if p < 0.05 and rises:
            deviance = least
            b = bent
            terms = 4
        elif p < 0.05:
            interaction = (
                f"{seen.size_of} and depth interact (p = {p:.2g}), which the surface leaves out"
            )
            note = "; ".join(filter(None, (note, interaction)))
    level = float(link_ppf(link, np.array(POD)))
    columns = crossed[:, :terms]
    blocks = weights_in_blocks(draws, (seen.board, "damaged"))
    again = np.concatenate(
        [_coefficients(columns, w * hit, w * ~hit, link, b[:terms]) for (w,) in blocks]
    )
    b0, b1, b2, b3 = np.vstack([b, np.pad(again, ((0, 0), (0, 4 - terms)))]).T[..., None]
    many = len(np.unique(seen.board)) > 1

    at_mm = np.geomspace(*diameters, STEPS)
    slope = b2 + b3 * np.log(at_mm)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        found = np.where(slope > 0, np.exp((level - b0 - b1 * np.log(at_mm)) / slope), np.inf)
    ends = [percentiles(column) if many else UNKNOWN for column in found[1:].T]
    low, high = np.array([(end.low, end.high) for end in ends]).T
    return PodSurface(link, b, p, deviance, at_mm, found[0], low, high, depths, note), ""


def _coefficients(
    design: np.ndarray,
    hits: np.ndarray,
    misses: np.ndarray,
    link: str,
    start: np.ndarray | None = None,
) -> np.ndarray:
    """Return coefficients (draws, p). The first column is the constant; the others are scaled for
    the search."""
    centre = design[:, 1:].mean(axis=0)
    scale = design[:, 1:].std(axis=0)
    back = np.eye(design.shape[1])
    back[1:, 1:] = np.diag(1 / scale)
    back[0, 1:] = -centre / scale
    z = np.column_stack([np.ones(len(design)), (design[:, 1:] - centre) / scale])
    first = np.zeros(design.shape[1]) if start is None else np.linalg.solve(back, start)
    return maxima(HitsAndMisses(z, hits, misses, link), first) @ back.T


def _separated(design: np.ndarray, hit: np.ndarray) -> bool:
    """Return whether a plane separates hits from misses (Albert and Anderson, Biometrika 71
    (1984), 1), by linear programming: the largest sum of one-sided margins is 0 if hits and misses
    overlap."""
    scaled = np.column_stack(
        [np.ones(len(design)), (design[:, 1:] - design[:, 1:].mean(0)) / design[:, 1:].std(0)]
    )
    signed = np.where(hit, 1.0, -1.0)[:, None] * scaled
    found = linprog(
        -signed.sum(axis=0),
        A_ub=-signed,
        b_ub=np.zeros(len(signed)),
        bounds=(-1, 1),
        method="highs",
    )
    return bool(-found.fun > 1e-7 * len(signed))


ALL_FOUND = int(np.ceil(np.log(1 - CONFIDENCE) / np.log(POD)))
"""29: with a POD below 90 %, this many targets are all found in less than 5 % of studies (0.9^29 =
0.047)."""
WIDER = 1.1  # boards matter if the limit over boards exceeds a90/95 by more than this factor


@dataclass(frozen=True, eq=False)
class SetUpLimit:
    """Sizes in mm, diameters or depths (`Inspected.limit_of`). ``statement``: curve, band and
    bounds from hits; None if no curve can be fitted, and ``why``. ``a90_95``: the limit to quote;
    infinite if not demonstrated. ``a90_draws_mm`` (B,): over resampled boards (and units), in one
    order for all set-ups with equally many boards. ``over_boards``: a90/95 with the measured
    similarity of damages of one board. If everything is found, the estimates are upper bounds: the
    smallest size inspected. If nothing is, or POD does not grow with size, they are NaN and their
    draws infinite. ``beside``: findings on damaged boards that match no damage. ``size_error_mm``:
    median error of the size of the ``sized`` hits that a model measured. ``seconds_detect``:
    median per cloud."""

    record: SetUpRecord
    statement: PodStatement | None
    why: str
    a90_95: Bound
    a50_mm: float
    a90_mm: float
    a90_draws_mm: np.ndarray
    a50_interval_mm: Interval
    a90_interval_mm: Interval
    over_boards: Bound
    design_effect: float
    boards: int
    targets: int
    hits: int
    inspections: int
    false_calls: FalseCallRate | None
    false_calls_interval_per_m2: Interval
    largest_mm: float
    over_units: OverUnits | None
    beside: FalseCallRate | None
    size_error_mm: float = np.nan
    sized: int = 0
    seconds_detect: float = np.nan

    @property
    def is_at_most(self) -> bool:
        """Return whether everything was found, so that ``a50_mm`` and ``a90_mm`` are upper bounds."""
        return self.statement is None and bool(np.isfinite(self.a90_mm))

    def beyond(self, size_mm: float) -> bool:
        """Return whether a size lies beyond ``largest_mm``, where only the curve gives a POD."""
        return bool(size_mm > self.largest_mm)

    @property
    def boards_matter(self) -> bool:
        """Return whether the limit over boards exceeds a90/95 by more than 10 %, with a known
        design effect."""
        return bool(
            np.isfinite(self.design_effect) and self.over_boards.value > WIDER * self.a90_95.value
        )


def limit_of(record: SetUpRecord, *, draws: int = DRAWS, tested: bool = False) -> SetUpLimit:
    """Return the limit of ``record``. ``tested``: whether to test for a floor and a ceiling, with
    a note. Deterministic. Data without a curve are not an error: ``why`` gives the reason."""
    seen = record.inspected
    targets = targets_of(seen.board, seen.hole, seen.size_mm, seen.hit)
    statement: PodStatement | None = None
    why = "no damage was inspected"
    effect = np.nan
    n = len(seen.hit)
    units: OverUnits | None = None
    if n:
        try:
            statement = state_hits(_rows(record), unit="mm", tested=tested)
            why = ""
        except UserError as error:
            why = error.message
    if statement is not None:
        if seen.limit_of != "depth" and depth_varies(seen.depth_mm):
            low = seen.depth_mm.min()
            high = seen.depth_mm.max()
            note = f"depths from {low:.3g} to {high:.3g} mm: one curve over all depths"
            statement = replace(statement, notes=(*statement.notes, note))
        a90_95 = statement.bound
        a50 = statement.a50
        a90 = statement.a90
        apart = targets
        if record.units > 1:
            unit = seen.repeat % record.units
            ones = np.ones(n)
            apart = Targets(seen.board, seen.size_mm, seen.hit.astype(float), ones, unit)
        of_a50, of_a90 = np.maximum(refitted_sizes(apart, statement.curve, (0.5, POD), draws), 0.0)
        over_boards = a90_95
        if statement.fits[0].method == "ML":
            effects = [design_effect(targets, fit.curve, POD) for fit in statement.fits]
            effect = effects[0]
            at_least_one = [max(1.0, each) for each in effects]
            if max(at_least_one) > 1:
                over_boards = largest_bound(statement.fits, at_least_one)
        if apart.unit is not None:
            units = over_units(
                apart.size_mm,
                seen.hit,
                target_names(seen),
                apart.unit,
                statement.curve,
                over_boards,
            )
    elif n and seen.hit.all():
        # If the POD of the 29th smallest target were below 90 %, so would that of the 28 smaller
        # ones, and all 29 would be found in less than 5 % of studies. So a90 lies below its size,
        # provided that POD
        # grows with size.
        a50 = a90 = float(targets.size_mm.min())
        a90_95 = _all_found(targets.size_mm, "targets")
        smallest = [
            targets.size_mm[targets.board == board].min() for board in np.unique(targets.board)
        ]
        over_boards = _all_found(
            np.array(smallest), "targets, one a board"
        )  # independent for certain
        of_a50 = of_a90 = np.full(draws, a90)
    else:
        a50 = a90 = np.nan
        a90_95 = over_boards = Bound(POD, CONFIDENCE, METHOD, np.inf, f"not demonstrated: {why}")
        of_a50 = of_a90 = np.full(draws, np.inf)
    calls, calls_interval = _false_calls(record.unflawed, draws, "hole-free")
    beside, _ = _false_calls(record.beside, draws, "damaged")
    ends = (UNKNOWN, UNKNOWN) if statement is None else (percentiles(of_a50), percentiles(of_a90))
    counts = (len(np.unique(targets.board)), len(targets.board), int(seen.hit.sum()), n)
    estimates = (a90_95, a50, a90, of_a90, *ends, over_boards, effect)
    largest_mm = float(seen.size_mm.max()) if n else np.nan
    return SetUpLimit(
        record,
        statement,
        why,
        *estimates,
        *counts,
        calls,
        calls_interval,
        largest_mm,
        units,
        beside,
    )


def target_names(seen: Inspected) -> np.ndarray:
    """Return a name (n,) for what each row inspects; repeats of one damage of one board share it."""
    return np.array(
        [f"{board}:{hole}" for board, hole in zip(seen.board, seen.hole, strict=True)], dtype=str
    )


def _false_calls(
    runs: Unflawed | None, draws: int, population: str
) -> tuple[FalseCallRate | None, Interval]:
    """Return the rate of false calls in runs, and its interval over boards; unknown without runs
    or calls."""
    if runs is None or not len(runs.board):
        return None, UNKNOWN
    rate = false_call_rate(int(runs.calls.sum()), float(runs.area_m2.sum()))
    if not rate.calls or len(np.unique(runs.board)) < 2:
        return rate, UNKNOWN
    blocks = weights_in_blocks(draws, (runs.board, population))
    return rate, percentiles(
        np.concatenate([(w @ runs.calls) / (w @ runs.area_m2) for (w,) in blocks])
    )


def _rows(record: SetUpRecord) -> Inspections:
    seen = record.inspected
    names = target_names(record.inspected)
    target = names if len(np.unique(names)) < len(names) else None
    lines = np.arange(1, len(names) + 1)
    return Inspections(
        Path(record.label),
        seen.limit_of,
        "hit",
        seen.size_mm,
        seen.hit.astype(float),
        target,
        lines,
    )


def _all_found(size_mm: np.ndarray, what: str) -> Bound:
    method = f"all found: binomial on the {ALL_FOUND} smallest {what}"
    if len(size_mm) >= ALL_FOUND:
        return Bound(POD, CONFIDENCE, method, float(np.sort(size_mm)[ALL_FOUND - 1]))
    reason = (
        f"not demonstrated: all of {len(size_mm)} {what} were found, but {ALL_FOUND} are needed"
    )
    return Bound(POD, CONFIDENCE, method, np.inf, reason)
