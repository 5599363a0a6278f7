"""The smallest damage found with a probability of 90 % at each patch of a part, and the poses that
cover most of it.

The damage's signal, in metres, is the detector's score times its unit of score there, less a share
of the residual that the undamaged part has there (the unit's fixed pattern, the surface's misfit),
which adds to it. The share is learnt, as a detector may filter such residuals out. The signal's
logarithm is linear in the logarithms of size and range and quadratic in the cosine of the angle of
incidence. Its normal scatter is proportional to a power of that cosine, because detection at
oblique incidence is less certain. Damage is found if its score exceeds the threshold, so the law
gives POD at every size and place: MIL-HDBK-1823A's signal against size (appendix G), with the
place beside the size. Not modelled: other differences between places of equal angle, range,
residual and unit of score."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from scipy import special

from harness.evaluation.pod.ahat import CensoredFit, fit_censored
from harness.evaluation.pod.statement import POD
from harness.vocabulary.errors import UserError

BEYOND_DEG = 3.0  # largest angle by which a patch may be steeper than all inspected damage
# ratio of score to threshold above which the score is ignored, so that the law holds near the
# threshold
FAR = 1.5
GROWTHS = np.linspace(0.0, 4.0, 17)  # powers of 1 / cosine with which the scatter may grow
# shares of the undamaged part's residual that may add to a signal; below 0 for damage towards the
# camera
SHARES = np.linspace(-1.0, 1.0, 9)
# least share of a score's metres that is signal, where the residual alone comes near the threshold
LEAST_SIGNAL = 0.05
# limits count as rough above this ratio of the sizes found with probabilities of 90 % and 50 %
LOOSE = 2.0
FEWEST = 20  # fewest damages from which the law is fitted


@dataclass(frozen=True, eq=False)
class Patches:
    """Patches of a part's face."""

    # Centres (n, 3), board frame, metres
    points_m: np.ndarray
    # Unit normals (n, 3), board frame, towards the camera
    normals: np.ndarray
    # Areas (n,), square metres
    areas_m2: np.ndarray

    def share(self, chosen: np.ndarray) -> float:
        """Return the share of the area that the patches ``chosen`` (n,) bool cover."""
        covered_m2 = self.areas_m2[chosen].sum()
        return float(covered_m2 / self.areas_m2.sum())


@dataclass(frozen=True, eq=False)
class Seen:
    """The view of n places."""

    # Standard deviation (n,) of the noise, metres; infinite where the detector does not judge
    deviation_m: np.ndarray
    # Cosine (n,) of the angle of incidence
    cosine: np.ndarray
    # Distance (n,) from the camera, metres
    range_m: np.ndarray
    # Mean residual (n,) of the undamaged part, metres
    residual_m: np.ndarray

    def signal_m(self, score: np.ndarray | float, share: float) -> np.ndarray:
        """Return the signal (n,) of damage with a score, without the residual's share."""
        whole_m = score * self.deviation_m
        return np.asarray(np.maximum(whole_m - share * self.residual_m, LEAST_SIGNAL * whole_m))


@dataclass(frozen=True, eq=False)
class ScoredDamage:
    """Inspections of damage, n of them."""

    # The size's name: "diameter", "width" or "depth"
    size_of: str
    # Number (n,) of the damage
    damage: np.ndarray
    # Size (n,), millimetres
    size_mm: np.ndarray
    # View (n,) of the damage's place
    seen: Seen
    # Lowest threshold (n,) at which it is no longer found; NaN if it was missed at the threshold
    # in use, infinite if only missing returns found it
    score: np.ndarray


@dataclass(frozen=True, eq=False)
class Findable:
    """Law of the signal."""

    # The size's name: "diameter", "width" or "depth"
    size_of: str
    # Factors (5,) of the terms of `_design`
    coefficients: np.ndarray
    # Standard deviation of the signal's logarithm in a frontal view
    scatter: float
    # Power of 1 / cosine with which the scatter grows
    growth: float
    # Share of the undamaged part's residual that adds to the signal
    share: float
    # Size found with 90 % over the size found with 50 %, at the median angle
    ratio: float
    # Score above which damage is found
    threshold: float
    # Smallest and largest size inspected, millimetres
    sizes_mm: tuple[float, float]
    # Least cosine of incidence inspected
    steepest: float
    # Number of damages in the fit
    damages: int

    @property
    def statement(self) -> str:
        """The law in a sentence."""
        return (
            f"Learnt from {self.damages} damages: the detector's signal is proportional to "
            f"the {self.size_of} to the "
            f"power {self.coefficients[1]:.2g}, and scatters by {100 * self.scatter:.0f} % "
            "where the face is seen "
            f"frontally, by {100 * self.scatter * 2**self.growth:.0f} % at 60°; {self.share:.2g} "
            "of what the undamaged part shows there adds to it. In a test at ten places of a pipe "
            "limits were right within 1 % on average, within 15 % at seven places, and wrong by "
            "up to 24 % at a single place."
        )

    @property
    def doubt(self) -> str:
        """The reason why the limits are rough; empty if size, angle and distance predict detection
        well."""
        doubts = []
        if self.growth == GROWTHS[-1]:
            doubts.append(
                "the signal scatters more with the angle than the law can describe: limits "
                "may be too small where the "
                "face is tilted, and too large where it is seen frontally"
            )
        if self.ratio > LOOSE:
            doubts.append(
                "what is found depends on more than size, angle and distance: the size "
                "found nine times in ten is "
                f"{self.ratio:.2g} times that found half of the time. Limits are rough and "
                "may be far too large: run a "
                "study in these poses before you rely on them"
            )
        return ". Also, ".join(doubts)

    def limits_mm(self, view: Seen) -> np.ndarray:
        """Return a90 (n,) of places: at least the smallest size inspected, infinite above the
        largest; NaN where nothing is judged or the angle is steeper than all inspected angles."""
        cosine = np.maximum(view.cosine, self.steepest)
        without_size = _design(np.ones(len(cosine)), cosine, view.range_m) @ self.coefficients
        needed = (
            np.log(view.signal_m(self.threshold, self.share))
            + special.ndtri(POD) * self.scatter / cosine**self.growth
        )
        limits_mm = np.maximum(
            np.exp((needed - without_size) / self.coefficients[1]), self.sizes_mm[0]
        )
        limits_mm = np.where(limits_mm > self.sizes_mm[1], np.inf, limits_mm)
        steepest_rad = np.arccos(self.steepest) + np.deg2rad(BEYOND_DEG)
        beyond = np.cos(min(steepest_rad, np.pi / 2))
        is_judged = np.isfinite(view.deviation_m) & (view.cosine >= beyond)
        return np.where(is_judged, limits_mm, np.nan)


def _design(size_mm: np.ndarray, cosine: np.ndarray, range_m: np.ndarray) -> np.ndarray:
    """Return the terms (n, 5) in which the logarithm of the signal is linear."""
    return np.column_stack(
        [np.ones(len(size_mm)), np.log(size_mm), cosine, cosine**2, np.log(range_m)]
    )


def findable(scored: ScoredDamage, threshold: float) -> Findable:
    """Fit the law to inspections of damage where the detector judges. Raises UserError if these do
    not suffice."""
    judged = np.isfinite(scored.seen.deviation_m) & (scored.seen.cosine > 0)
    damages = len(np.unique(scored.damage[judged]))
    total = len(np.unique(scored.damage))
    if damages < FEWEST:
        fix = "check the detector's crop, and the sizes of the damage"
        raise UserError(
            f"only {damages} of {total} damages were judged: no limit can be learnt", fix=fix
        )
    size_mm = scored.size_mm[judged]
    score = scored.score[judged]
    visibility = Seen(
        deviation_m=scored.seen.deviation_m[judged],
        cosine=scored.seen.cosine[judged],
        range_m=scored.seen.range_m[judged],
        residual_m=scored.seen.residual_m[judged],
    )
    cosine = visibility.cosine
    design = _design(size_mm, cosine, visibility.range_m)
    below = np.isnan(score)
    found_scores = np.sort(score[score > threshold])
    lowest_scores = found_scores[np.isfinite(found_scores)][:FEWEST]
    far = max([FAR * threshold, *lowest_scores])
    above = score > far
    clipped = np.minimum(np.where(below, threshold, score), far)
    exact = ~(below | above)

    def fitted(growth: float, share: float) -> tuple[float, CensoredFit]:
        """Return the log-likelihood of scores with a scatter proportional to cosine^-growth, and
        the fit to weighted rows."""
        weight = cosine**growth
        signal_m = visibility.signal_m(clipped, share)
        fit = fit_censored(design * weight[:, None], np.log(signal_m) * weight, below, above)
        # the densities of ln signal in those of ln score, which all laws have in common
        stretch = weight * clipped * visibility.deviation_m / signal_m
        return fit.log_likelihood + float(np.log(stretch[exact]).sum()), fit

    laws = list(product(GROWTHS.tolist(), SHARES.tolist()))
    fits = [fitted(growth, share) for growth, share in laws]
    best = int(np.nanargmax([likelihood for likelihood, _ in fits]))
    growth, share = laws[best]
    _, best_fit = fits[best]
    coefficients, scatter, _, _ = best_fit
    if coefficients[1] <= 0:
        message = (
            f"what is found does not follow the {scored.size_of} of the damage: no limit can be "
            "learnt"
        )
        raise UserError(
            message, fix="ask for fewer or less tilted poses, or run a study in the pose wanted"
        )
    ratio = np.exp(special.ndtri(POD) * scatter / np.median(cosine) ** growth / coefficients[1])
    sizes_mm = (float(size_mm.min()), float(size_mm.max()))
    return Findable(
        size_of=scored.size_of,
        coefficients=coefficients,
        scatter=scatter,
        growth=growth,
        share=share,
        ratio=float(ratio),
        threshold=threshold,
        sizes_mm=sizes_mm,
        steepest=float(cosine.min()),
        damages=damages,
    )


def in_turn(
    patches: Patches, found_patches: Sequence[np.ndarray], given_count: int, further_count: int
) -> list[tuple[int, float, float]]:
    """Return the first ``given_count`` poses, then up to ``further_count`` others, always the one
    that adds most. ``found_patches``: by pose, the patches (n,) bool on which damage is found. A
    row has the pose's index, the share of the area that it adds, and the share that all poses so
    far cover."""
    covered = np.zeros(len(patches.areas_m2), bool)
    rows = list[tuple[int, float, float]]()
    for turn in range(given_count + further_count):
        gains = [patches.share(patch_mask & ~covered) for patch_mask in found_patches]
        best = turn if turn < given_count else int(np.argmax(gains))
        if turn >= given_count and gains[best] <= 0:
            break
        covered = covered | found_patches[best]
        rows.append((best, gains[best], patches.share(covered)))
    return rows
