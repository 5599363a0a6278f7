"""Matches the marks of two views, by code or by the distances between marks, and finds the
transform between them.

Two marks and their normals fix a placement (Grimson and Lozano-Perez 1987, without the tree). A
hypothesis is an ordered pair of marks of the larger set with the distance of a pair of the smaller
set; further marks support it if their distances to both fit. More than half of the smaller set
must agree. Normals face the camera, so a mirror image is not a solution.

Kabsch's closed form (1976; Umeyama 1991 for the sign) gives the start; Gauss-Newton with the full
covariances gives the most probable rigid transform and its covariance. Not modelled: marks that
are seen twice, or moved between the views; errors that the points of one set share."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from detectors.rigid_motion import displacement_jacobian, kabsch, moved_by
from detectors.views.marks.mark import LEAST_MARKS, Mark
from harness.vocabulary.geometry import MM, invert, transform_points

MAX_STEPS = 20
# Gauss-Newton, which converges within three to five steps, stops when no point moves by more
SMALL_STEP_M = 1e-10


@dataclass(frozen=True)
class Placement:
    """The most probable rigid transform of points onto their partners."""

    T_to_from: np.ndarray
    """(4, 4): rigid."""
    covariance: np.ndarray
    """(6, 6): of a small error (w, t), by which a point p of the target frame is off by
    w x (p - ``centre_m``) + t, radians and metres."""
    centre_m: np.ndarray
    """(3,): centre of the small rotation."""
    residuals_m: np.ndarray
    """(n, 3): mapped points minus their partners."""
    chi2: float
    """Their sum of squares in units of the covariances, with 3 n - 6 degrees of freedom."""
    iterations: int
    """Number of Gauss-Newton steps."""
    converged: bool
    """Whether these steps came to an end."""


def place(
    from_m: np.ndarray,
    from_spread_m2: np.ndarray,
    to_m: np.ndarray,
    to_spread_m2: np.ndarray,
) -> Placement:
    """Find the most probable rigid transform of points (n, 3) onto (n, 3) with covariances (n, 3,
    3), n >= 3. Raises numpy.linalg.LinAlgError if the points leave it undetermined (two, or all on
    a line)."""

    def state(T: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the residuals (n, 3) and the inverses (n, 3, 3) of their covariances."""
        spread = to_spread_m2 + T[:3, :3] @ from_spread_m2 @ T[:3, :3].T
        residuals = transform_points(T, from_m) - to_m
        return residuals, np.linalg.inv(spread)

    trust = 1.0 / np.trace(from_spread_m2 + to_spread_m2, axis1=1, axis2=2)
    T = kabsch(from_m, to_m, trust)
    centre = np.average(to_m, axis=0, weights=trust)
    converged = False
    steps = 0
    while not converged and steps < MAX_STEPS:
        steps += 1
        residuals, weight = state(T)
        jacobian = displacement_jacobian(residuals + to_m, centre)
        information = np.einsum("nki,nkl,nlj->ij", jacobian, weight, jacobian)
        gradient = np.einsum("nki,nkl,nl->i", jacobian, weight, residuals)
        motion = -np.linalg.solve(information, gradient)
        T = moved_by(motion, centre) @ T
        converged = bool(np.abs(jacobian @ motion).max() < SMALL_STEP_M)
    residuals, weight = state(T)
    chi2 = float(np.einsum("ni,nij,nj->", residuals, weight, residuals))
    covariance = np.linalg.inv(information)
    return Placement(
        T_to_from=T,
        covariance=(covariance + covariance.T) / 2,
        centre_m=centre,
        residuals_m=residuals,
        chi2=chi2,
        iterations=steps,
        converged=converged,
    )


SHARED_M = 1.0 * MM
"""Standard deviation per axis of an error that a mark's pixels share but two views do not; in no
covariance."""
DISTANCE_SIGMAS = 4.0
"""Largest difference of a distance between two marks, in standard deviations: a true pair is lost
once in 16,000."""
FIT_CHI2 = 21.1
"""Largest chi^2 of a matched mark's place, with three degrees of freedom: a true match is lost
once in 10,000."""
GUESS_SIGMA_M = 50 * MM
"""Root mean square error of the guess at the marks: five degrees over half a metre, and a few
centimetres."""
PAIR_WORTH = 3.0  # logarithm of the odds that a mark of one view is found in the other: 20 to 1
CLEAR_ODDS = 4.5
FEWER = 3
"""Log odds, 90 to 1, that decide between two placements; largest number of pairs that the winner
may lack."""
NO_PAIRS = np.zeros((0, 2), dtype=np.int64)


@dataclass(frozen=True)
class Pairing:
    """The marks of two views that belong together."""

    pairs: np.ndarray
    """(n, 2): indices into the reference's and the view's marks, in the reference's order."""
    problem: str = ""
    """Why they must not be used, else empty."""
    notes: tuple[str, ...] = ()
    """Further remarks."""


def pair_marks(
    reference: Sequence[Mark],
    view: Sequence[Mark],
    T_reference_view_guess: np.ndarray | None,
) -> Pairing:
    """Match the marks of two views by the placement that is best in number of pairs, fit and
    closeness to the guess."""
    counts = f"{len(reference)} marks in the reference and {len(view)} in the view"
    if min(len(reference), len(view)) < LEAST_MARKS:
        return Pairing(NO_PAIRS, f"{counts}, {LEAST_MARKS} needed in each")
    if all(mark.code is not None for mark in (*reference, *view)):
        return _by_code(reference, view)
    ours = _Side(reference)
    theirs = _Side(view)
    swapped = len(view) < len(reference)
    solutions = _solutions(theirs, ours) if swapped else _solutions(ours, theirs)
    if not solutions:
        least = max(LEAST_MARKS, min(len(reference), len(view)) // 2 + 1)
        problem = (
            f"of {counts}, no {least} have matching distances: the targets differ, or other "
            "objects were taken for marks"
        )
        return Pairing(NO_PAIRS, problem)
    away = np.zeros(len(solutions))
    if T_reference_view_guess is not None:
        placed = [
            transform_points(T if swapped else invert(T), theirs.places) for _, T, _ in solutions
        ]
        off = np.stack(placed) - transform_points(T_reference_view_guess, theirs.places)
        away = np.sqrt((off**2).sum(axis=-1).mean(axis=-1))
    number = [len(partners) - partners.count(-1) for partners, _, _ in solutions]
    misfit = np.array([misfit for _, _, misfit in solutions])
    fit = np.array(number) * (PAIR_WORTH - 0.5 * misfit)
    odds = fit - 0.5 * (away / GUESS_SIGMA_M) ** 2
    first, *runners_up = np.argsort(-odds, kind="stable").tolist()
    partner = np.array(solutions[first][0], dtype=np.int64)
    matched = np.flatnonzero(partner >= 0)
    pairs = np.stack([matched, partner[matched]], axis=1)
    if swapped:
        pairs = pairs[:, ::-1][np.argsort(pairs[:, 1])]
    if not runners_up or odds[first] - odds[runners_up[0]] >= CLEAR_ODDS:
        return Pairing(pairs)
    candidates = f"{number[first]} and {number[runners_up[0]]}"
    problem = (
        f"the marks lie symmetrically: two placements bring {candidates} of them together, and "
    )
    if T_reference_view_guess is None:
        return Pairing(pairs, problem + "there is no guess to choose by")
    between = (
        f"the guess lies between: {away[first] / MM:.0f} mm from one, "
        f"{away[runners_up[0]] / MM:.0f} mm from the other"
    )
    return Pairing(pairs, problem + between)


def _by_code(reference: Sequence[Mark], view: Sequence[Mark]) -> Pairing:
    ours = [int(mark.code or 0) for mark in reference]
    theirs = [int(mark.code or 0) for mark in view]
    twice = sorted({code for codes in (ours, theirs) for code in codes if codes.count(code) > 1})
    common = [code for code in ours if code in theirs and code not in twice]
    indices = [(ours.index(code), theirs.index(code)) for code in common]
    pairs = np.array(indices, dtype=np.int64).reshape(-1, 2)
    shown = [", ".join(map(str, sorted(codes))) for codes in (ours, theirs, twice)]
    notes = tuple[str, ...]()
    if twice:
        notes = (f"codes seen more than once in a view, not used: {shown[2]}",)
    shortage = ""
    if len(common) < LEAST_MARKS:
        shortage = (
            f"{len(common)} codes in common, {LEAST_MARKS} needed: the reference shows "
            f"{shown[0]}, "
            f"the view {shown[1]}"
        )
    return Pairing(pairs, shortage, notes)


class _Side:
    """The n marks of one view."""

    def __init__(self, marks: Sequence[Mark]) -> None:
        self.places = np.stack([mark.centre_m for mark in marks])
        """(n, 3): their centres."""
        self.normals = np.stack([mark.normal for mark in marks])
        """(n, 3): of the surface there."""
        stated = np.stack([mark.covariance_m2 for mark in marks])
        covariances = stated + SHARED_M**2 * np.eye(3)
        offsets = self.places[:, None] - self.places[None]
        self.distances = np.linalg.norm(offsets, axis=-1)
        """(n, n): between the marks."""
        along = offsets / np.maximum(self.distances, 1e-12)[..., None]
        variances = np.einsum("ijk,ikl,ijl->ij", along, covariances, along)
        self.variances = variances + variances.T
        """(n, n): of the distances."""
        self.worst = np.linalg.eigvalsh(covariances)[:, -1]
        """(n,): variance of each place in its worst direction."""

    def frames(self, i: np.ndarray, j: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return axes (k, 3, 3) (columns: from i to j, across, mean normal) and middles (k, 3) of
        pairs of marks."""
        along = self.places[j] - self.places[i]
        along /= np.linalg.norm(along, axis=-1, keepdims=True)
        normal = self.normals[i] + self.normals[j]
        normal -= (normal * along).sum(axis=-1, keepdims=True) * along
        length = np.linalg.norm(normal, axis=-1, keepdims=True)
        normal /= np.maximum(length, 1e-12)
        across = np.cross(normal, along)
        axes = np.stack([along, across, normal], axis=-1)
        middles = (self.places[i] + self.places[j]) / 2
        return axes, middles


Solution = tuple[tuple[int, ...], np.ndarray, float]
"""Each mark's partner in the larger set, or -1; (4, 4) larger from smaller; mean square distance
over its variance."""


def _solutions(fewer_side: _Side, larger_side: _Side) -> list[Solution]:
    """Return the placements that match over half of the smaller set and at most `FEWER` pairs less
    than the best."""
    n = len(fewer_side.places)
    least = max(LEAST_MARKS, n // 2 + 1)
    # every set of more than half of the marks contains one of these pairs: disjoint ones, longest
    # first, and for an odd number the last mark with both marks of the first pair
    pairs: list[tuple[int, int]] = []
    free = set(range(n))
    longest_first = sorted(
        combinations(range(n), 2), key=lambda pair: (-fewer_side.distances[pair], pair)
    )
    for i, j in longest_first:
        if i in free and j in free:
            pairs.append((i, j))
            free -= {i, j}
    pairs += [(mark, last) for last in free for mark in pairs[0]]
    solutions: dict[tuple[int, ...], Solution] = {}
    best = least
    for i, j in pairs:
        for solution in _holding(fewer_side, larger_side, i, j, least):
            solutions.setdefault(solution[0], solution)
            best = max(best, n - solution[0].count(-1))
    credible = [
        solution for solution in solutions.values() if n - solution[0].count(-1) >= best - FEWER
    ]
    # leave out solutions that place the marks like a better one, to within half the distance
    # between neighbours
    limit = fewer_side.distances[~np.eye(n, dtype=bool)].min() / 2
    kept: list[Solution] = []
    for solution in sorted(credible, key=lambda s: (s[0].count(-1), s[2], s[0])):
        placed = transform_points(solution[1], fewer_side.places)
        offsets = [placed - transform_points(T, fewer_side.places) for _, T, _ in kept]
        if all(np.linalg.norm(offset, axis=1).max() > limit for offset in offsets):
            kept.append(solution)
    return kept


def _holding(
    fewer_side: _Side,
    larger_side: _Side,
    i: int,
    j: int,
    least: int,
) -> list[Solution]:
    """Return the solutions with at least ``least`` pairs in which marks i and j of the smaller set
    have partners."""
    mismatch = np.abs(larger_side.distances - fewer_side.distances[i, j])
    fits = mismatch < DISTANCE_SIGMAS * np.sqrt(fewer_side.variances[i, j] + larger_side.variances)
    a, b = np.nonzero(fits & ~np.eye(len(mismatch), dtype=bool))
    if len(a) == 0:
        return []
    # partners (k, n) that lie as far from both partners (k,) of the pair as they should ...
    consistent = np.ones((len(a), len(fewer_side.places), len(larger_side.places)), dtype=bool)
    for mark, partner in ((i, a), (j, b)):
        expected_m = fewer_side.distances[mark][None, :, None]
        off = np.abs(expected_m - larger_side.distances[partner][:, None, :])
        expected_m2 = fewer_side.variances[mark][None, :, None]
        variance = expected_m2 + larger_side.variances[partner][:, None, :]
        # a mark's distance to itself is exactly 0 on both sides
        consistent &= off <= DISTANCE_SIGMAS * np.sqrt(variance)
    # ... on the side of the line through them that the normals indicate: the mirror image beyond
    # it lies two heights away; half a height allows for normals wrong by 30 degrees
    (axes,), (middle,) = fewer_side.frames(np.array([i]), np.array([j]))
    axes_there, middle_there = larger_side.frames(a, b)
    local = (fewer_side.places - middle) @ axes
    expected = np.einsum("kij,nj->kni", axes_there, local) + middle_there[:, None, :]
    off = np.linalg.norm(expected[:, :, None, :] - larger_side.places[None, None], axis=-1)
    worst = fewer_side.worst[:, None] + larger_side.worst[None]
    height = np.linalg.norm(local[:, 1:], axis=-1)[:, None]
    consistent &= off < 0.5 * height + DISTANCE_SIGMAS * np.sqrt(worst)
    partner = _mutual(np.where(consistent, off, np.inf))
    partner = partner[(partner >= 0).sum(axis=1) >= least]
    for _ in range(2):
        # the first pass uses the marks with fitting distances, the second those that fit the
        # transform
        if len(partner) == 0:
            return []
        precision = 1.0 / (fewer_side.worst[None] + larger_side.worst[partner])
        weights = np.where(partner >= 0, precision, 0.0)
        from_m = np.broadcast_to(fewer_side.places, (*partner.shape, 3))
        T = kabsch(from_m, larger_side.places[partner], weights)
        placed = np.einsum("kij,nj->kni", T[:, :3, :3], fewer_side.places) + T[:, None, :3, 3]
        offset = placed[:, :, None, :] - larger_side.places[None, None]
        square = (offset**2).sum(axis=-1) / worst
        partner = _mutual(np.where(square < FIT_CHI2, square, np.inf))
        has_partner = partner >= 0
        column = np.where(has_partner, partner, 0)[..., None]
        squares = np.take_along_axis(square, column, axis=-1)[..., 0]
        count = has_partner.sum(axis=1)
        misfit = np.where(has_partner, squares, 0.0).sum(axis=1) / np.maximum(count, 1)
        enough = count >= least
        T = T[enough]
        partner = partner[enough]
        misfit = misfit[enough]
    return [
        (tuple(row), transform, value)
        for row, transform, value in zip(partner.tolist(), T, misfit, strict=True)
    ]


def _mutual(cost: np.ndarray) -> np.ndarray:
    """Return (k, n): for each row of costs (k, n, m) its cheapest column if that is mutual, else
    -1."""
    column = cost.argmin(axis=2)
    row = cost.argmin(axis=1)
    row_back = np.take_along_axis(row, column, axis=1)
    is_mutual = row_back == np.arange(cost.shape[1])
    cheapest = np.take_along_axis(cost, column[..., None], axis=2)[..., 0]
    return np.where(is_mutual & np.isfinite(cheapest), column, -1)
