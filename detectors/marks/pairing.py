"""Matches of the marks of two views: by code, or by the distances between marks, which no move changes.

Search over pairs, as in the interpretation trees of Grimson and Lozano-Perez (1987), without the tree. Two marks and
their normals fix a placement; so each ordered pair of marks of the larger set that is as far apart as a pair of the
smaller set is a hypothesis, and each further mark counts for it whose distances to both fit. Pairs of the smaller set
that have no mark in common are tried in turn: a solution with k of n marks holds one of any n - k + 1 such pairs, so
the search ends when none nearly as good can have been missed. More than half of the smaller set must agree.
The normals face the camera on both sides, so a mirror image is no solution.
Not modelled: marks that are seen twice, marks that moved between the views.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from detectors.marks.mark import Mark
from detectors.marks.placing import kabsch
from harness.vocabulary.geometry import invert, transform_points
from harness.vocabulary.units import MM

SHARED_M = 1.0 * MM
"""Standard deviation per axis of what the pixels of a mark share and two views do not: the range's offset at another
distance and angle (wiggling), the lens's calibration. It is in no mark's covariance; the Azure Kinect's data sheet
allows more (11 mm + 0.1 % of the distance), nearly all of which the marks of one view share."""
DISTANCE_SIGMAS = 4.0
"""A distance between two marks may differ by so many standard deviations: a true pair is lost once in 16,000."""
FIT_CHI2 = 21.1
"""Limit of chi^2 of a matched mark's place, three degrees of freedom: a true one is lost once in 10,000."""
LEAST_PAIRS = 3
GUESS_SIGMA_M = 50 * MM
"""Error of the guess at marks, root mean square: five degrees over half a metre, and some centimetres."""
PAIR_WORTH = 3.0
"""Logarithm of the odds that a mark of one view is found in the other: 20 to 1."""
CLEAR_ODDS = 4.5
"""Logarithm of the odds, 90 to 1, at which one placement is taken before another: two marks more without a guess."""
FEWER = 3
"""Placements with so many pairs fewer than the best are looked for, since the guess may prefer one of them."""
NO_PAIRS = np.zeros((0, 2), dtype=np.int64)


@dataclass(frozen=True)
class Pairing:
    """``pairs`` (n, 2): indices into the reference's marks and into the view's, in the reference's order. ``problem``:
    why they must not be used, empty where they may. ``notes``: what else to know."""

    pairs: np.ndarray
    problem: str = ""
    notes: tuple[str, ...] = ()


def pair_marks(reference: Sequence[Mark], view: Sequence[Mark], T_reference_view_guess: np.ndarray | None) -> Pairing:
    """Match the marks of two views; the guess is used only to choose between placements that fit."""
    if len(reference) < LEAST_PAIRS or len(view) < LEAST_PAIRS:
        return Pairing(
            NO_PAIRS,
            f"{len(reference)} marks in the reference and {len(view)} in the view, {LEAST_PAIRS} needed in each",
        )
    if all(mark.code is not None for mark in (*reference, *view)):
        return _by_code(reference, view)
    ours, theirs = _Side.of(reference), _Side.of(view)
    swapped = len(view) < len(reference)
    solutions = _solutions(theirs, ours) if swapped else _solutions(ours, theirs)
    return _chosen(ours, theirs, solutions, swapped, T_reference_view_guess)


def _by_code(reference: Sequence[Mark], view: Sequence[Mark]) -> Pairing:
    ours, theirs = [mark.code for mark in reference], [mark.code for mark in view]
    twice = sorted({code for codes in (ours, theirs) for code in codes if code is not None and codes.count(code) > 1})
    common = [code for code in ours if code in theirs and code not in twice]
    pairs = np.array([(ours.index(code), theirs.index(code)) for code in common], dtype=np.int64).reshape(-1, 2)
    notes = (f"codes seen more than once in a view, not used: {_listed(twice)}",) if twice else ()
    if len(common) < LEAST_PAIRS:
        return Pairing(
            pairs,
            f"{len(common)} codes in common, {LEAST_PAIRS} needed: the reference shows {_listed(ours)},"
            f" the view {_listed(theirs)}",
            notes,
        )
    return Pairing(pairs, "", notes)


def _listed(codes: Sequence[int | None]) -> str:
    return ", ".join(str(code) for code in sorted(code for code in codes if code is not None)) or "none"


@dataclass(frozen=True)
class _Side:
    """The marks of one view: ``places`` and ``normals`` (n, 3), ``distances`` (n, n), the ``variances`` (n, n) of
    these, and ``worst`` (n,), each place's variance in its worst direction."""

    places: np.ndarray
    normals: np.ndarray
    distances: np.ndarray
    variances: np.ndarray
    worst: np.ndarray

    @classmethod
    def of(cls, marks: Sequence[Mark]) -> _Side:
        places = np.stack([mark.centre_m for mark in marks])
        covariances = np.stack([mark.covariance_m2 for mark in marks]) + SHARED_M**2 * np.eye(3)
        apart = places[:, None] - places[None]
        distances = np.linalg.norm(apart, axis=-1)
        along = apart / np.maximum(distances, 1e-12)[..., None]
        own = np.einsum("ijk,ikl,ijl->ij", along, covariances, along)
        worst = np.linalg.eigvalsh(covariances)[:, -1]
        return cls(places, np.stack([mark.normal for mark in marks]), distances, own + own.T, worst)

    def frames(self, i: np.ndarray, j: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return axes (k, 3, 3) (columns: from i to j, across, mean normal) and middles (k, 3) of pairs of marks."""
        along = self.places[j] - self.places[i]
        along /= np.linalg.norm(along, axis=-1, keepdims=True)
        normal = self.normals[i] + self.normals[j]
        normal -= (normal * along).sum(axis=-1, keepdims=True) * along
        normal /= np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-12)
        axes = np.stack([along, np.cross(normal, along), normal], axis=-1)
        return axes, (self.places[i] + self.places[j]) / 2


@dataclass(frozen=True)
class _Solution:
    """``partner`` (n,): of each mark of the smaller set its mark in the larger, -1 for none. ``T`` (4, 4): larger from
    smaller. ``misfit``: mean square of the pairs' distances, in units of their worst variance."""

    partner: tuple[int, ...]
    T: np.ndarray
    misfit: float

    @property
    def count(self) -> int:
        return sum(mark >= 0 for mark in self.partner)


def _solutions(few: _Side, many: _Side) -> list[_Solution]:
    """Find all placements that bring more than half of the smaller set's marks together and at most `FEWER` less than
    the best, which comes first."""
    n = len(few.places)
    least = max(LEAST_PAIRS, n // 2 + 1)
    found: dict[tuple[int, ...], _Solution] = {}
    best = least
    for tried, (i, j) in enumerate(_pairs_in_turn(few.distances), start=1):
        for solution in _holding(few, many, i, j, least):
            found.setdefault(solution.partner, solution)
            best = max(best, solution.count)
        # a solution leaves out n - count marks, each of which spoils one of the disjoint pairs
        if n - max(best - FEWER, least) < tried <= n // 2:
            break
    near = [solution for solution in found.values() if solution.count >= best - FEWER]
    # without those that place the marks as a better one does, to within half the distance between neighbours
    limit = (few.distances + np.where(np.eye(n, dtype=bool), np.inf, 0.0)).min() / 2
    kept: list[_Solution] = []
    for solution in sorted(near, key=lambda s: (-s.count, s.misfit, s.partner)):
        placed = transform_points(solution.T, few.places)
        if all(np.linalg.norm(placed - transform_points(k.T, few.places), axis=1).max() > limit for k in kept):
            kept.append(solution)
    return kept


def _pairs_in_turn(distances: np.ndarray) -> list[tuple[int, int]]:
    """Return pairs of marks of which every set of more than half of the marks holds one: disjoint ones, the longest
    first, and of an odd number the last mark with both marks of the first pair."""
    n = len(distances)
    pairs: list[tuple[int, int]] = []
    free = set(range(n))
    for i, j in sorted(combinations(range(n), 2), key=lambda pair: (-distances[pair], pair)):
        if i in free and j in free:
            pairs.append((i, j))
            free -= {i, j}
    return pairs + [(mark, last) for last in sorted(free) for mark in pairs[0]]


def _holding(few: _Side, many: _Side, i: int, j: int, least: int) -> list[_Solution]:
    """Find the solutions with at least so many pairs in which marks i and j of the smaller set have partners."""
    apart = np.abs(many.distances - few.distances[i, j])
    a, b = np.nonzero(
        (apart < DISTANCE_SIGMAS * np.sqrt(few.variances[i, j] + many.variances)) & ~np.eye(len(apart), dtype=bool)
    )
    if len(a) == 0:
        return []
    partner = _by_distances(few, many, (i, j), (a, b))
    partner = partner[(partner >= 0).sum(axis=1) >= least]
    for _ in range(2):
        # once from the marks that the distances gave, once more from those that fitted
        if len(partner) == 0:
            return []
        weights = np.where(partner >= 0, 1.0 / (few.worst[None] + many.worst[partner]), 0.0)
        T = kabsch(np.broadcast_to(few.places, (*partner.shape, 3)), many.places[partner], weights)
        partner, misfit = _by_place(few, many, T)
        enough = (partner >= 0).sum(axis=1) >= least
        T, partner, misfit = T[enough], partner[enough], misfit[enough]
    return [
        _Solution(tuple(row), transform, float(value))
        for row, transform, value in zip(partner.tolist(), T, misfit, strict=True)
    ]


def _by_distances(
    few: _Side, many: _Side, pair: tuple[int, int], partners: tuple[np.ndarray, np.ndarray]
) -> np.ndarray:
    """Return partners (k, n), -1 for none, that lie as far from both partners (k,) of the pair as they should, on the
    side of the line through them that the normals tell."""
    consistent = np.ones((len(partners[0]), len(few.places), len(many.places)), dtype=bool)
    for mark, partner in zip(pair, partners, strict=True):
        apart = np.abs(few.distances[mark][None, :, None] - many.distances[partner][:, None, :])
        variance = few.variances[mark][None, :, None] + many.variances[partner][:, None, :]
        # a mark's distance to itself is exactly 0 on both sides
        consistent &= apart <= DISTANCE_SIGMAS * np.sqrt(variance)
    i, j = (np.array([mark]) for mark in pair)
    axes, middle = few.frames(i, j)
    local = (few.places - middle) @ axes[0]
    axes_there, middle_there = many.frames(*partners)
    expected = np.einsum("kij,nj->kni", axes_there, local) + middle_there[:, None, :]
    off = np.linalg.norm(expected[:, :, None, :] - many.places[None, None], axis=-1)
    # the mirror image beyond the line lies two heights away; half a height allows for normals wrong by 30 degrees
    height = np.linalg.norm(local[:, 1:], axis=-1)
    slack = DISTANCE_SIGMAS * np.sqrt(few.worst[:, None] + many.worst[None])
    consistent &= off < (0.5 * height[:, None] + slack)[None]
    return _mutual(np.where(consistent, off, np.inf))


def _by_place(few: _Side, many: _Side, T: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the partners (k, n), -1 for none, to which transforms (k, 4, 4) bring the marks; their mean square
    misfit."""
    placed = np.einsum("kij,nj->kni", T[:, :3, :3], few.places) + T[:, None, :3, 3]
    square = ((placed[:, :, None, :] - many.places[None, None]) ** 2).sum(axis=-1)
    square /= few.worst[:, None] + many.worst[None]
    partner = _mutual(np.where(square < FIT_CHI2, square, np.inf))
    own = np.take_along_axis(square, np.maximum(partner, 0)[..., None], axis=-1)[..., 0]
    paired = partner >= 0
    return partner, np.where(paired, own, 0.0).sum(axis=1) / np.maximum(paired.sum(axis=1), 1)


def _mutual(cost: np.ndarray) -> np.ndarray:
    """Return (k, n) of each row of costs (k, n, m) its cheapest column, where it is that column's cheapest row; else
    -1."""
    column, row = cost.argmin(axis=2), cost.argmin(axis=1)
    back = np.take_along_axis(row, column, axis=1) == np.arange(cost.shape[1])
    finite = np.isfinite(np.take_along_axis(cost, column[..., None], axis=2)[..., 0])
    return np.where(back & finite, column, -1)


def _chosen(
    reference: _Side, view: _Side, solutions: list[_Solution], swapped: bool, T_reference_view_guess: np.ndarray | None
) -> Pairing:
    """Choose the solution that the number of its pairs, their fit and the guess favour, if clearly."""
    if not solutions:
        few = min(len(reference.places), len(view.places))
        return Pairing(
            NO_PAIRS,
            f"the distances between the marks fit nowhere: of {len(reference.places)} and {len(view.places)} marks no"
            f" {max(LEAST_PAIRS, few // 2 + 1)} lie alike; other targets, or other things taken for marks",
        )
    T_reference_view = [s.T if swapped else invert(s.T) for s in solutions]
    away = np.zeros(len(solutions))
    if T_reference_view_guess is not None:
        guessed = transform_points(T_reference_view_guess, view.places)
        off = np.stack([transform_points(T, view.places) for T in T_reference_view]) - guessed
        away = np.sqrt((off**2).sum(axis=-1).mean(axis=-1))
    fit = np.array([s.count * (PAIR_WORTH - 0.5 * s.misfit) for s in solutions])
    odds = fit - 0.5 * (away / GUESS_SIGMA_M) ** 2
    first, *rest = np.argsort(-odds, kind="stable").tolist()
    partner = solutions[first].partner
    pairs = np.array([(mark, other) for mark, other in enumerate(partner) if other >= 0], dtype=np.int64)
    pairs = pairs[:, ::-1][np.argsort(pairs[:, 1])] if swapped else pairs
    if not rest or odds[first] - odds[rest[0]] >= CLEAR_ODDS:
        return Pairing(pairs)
    counts = " and ".join(str(solutions[number].count) for number in (first, rest[0]))
    problem = f"the marks lie symmetrically: two placements bring {counts} of them together, and "
    if T_reference_view_guess is None:
        return Pairing(pairs, problem + "there is no guess to choose by")
    between = f"the guess lies between: {away[first] / MM:.0f} mm from one, {away[rest[0]] / MM:.0f} mm from the other"
    return Pairing(pairs, problem + between)
