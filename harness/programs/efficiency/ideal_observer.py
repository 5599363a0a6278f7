"""The ideal observer: the detections of the best possible detector at a wanted rate of false
calls.

It knows the exact signature s of each damage, as far as the camera shows it, and the covariance C
of the noise over cameras. It knows neither the place of the damage nor the undamaged surface, a
polynomial B b with unknown b. Its statistic at each place is the log-likelihood ratio of Gaussian
noise, s' K r / d' with K = C^-1 - C^-1 B (B' C^-1 B)^-1 B' C^-1. It has deviation 1 without damage
and mean d' at the damage, d'^2 = s' K s (Barrett and Myers, Foundations of Image Science (2004),
chapter 13; ICRU Report 54 (1996)). At its threshold, the field of this statistic has the wanted
number of maxima on the pixels. A damage is found if any pixel around its place exceeds the
threshold.

C is stationary except for its scale: C = D R D, with the deviations D of each pixel and the
autocovariance R of noise in deviations, pooled over boards and units and faded out by Parzen's
window. Not modelled: tails that are not Gaussian, noise that differs within damage, information in
missing returns, size and depth as unknowns (with them, a bank of templates has a higher
threshold)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, reduce
from operator import add

import numpy as np
import scipy.fft
from scipy import optimize, special

from harness.vocabulary.seeds import random_stream

LONGEST_LAG_PX = 72
"""Lag at which the autocovariance is 0: ten times the length of known cameras' patterns. The
window smooths the spectrum a little: d' of 50 frames is 1 to 2 % below that with 110 pixels."""
# least power of the noise at any frequency, as a share of the mean; smaller estimates are error
LEAST_POWER = 1e-3
CONVERGED = 1e-4
MOST_ITERATIONS = 200
"""Relative residual of C^-1 s, which is the relative error of d'^2, and the most steps to reach
it."""
# draws of a neighbourhood of the statistic: rates of maxima are then known to 3 %, thresholds to
# 0.01
NORMALS = 4096
AROUND = 3  # half of the lattice of places around a damage at which it may be found, in strides
# places with a smaller correlation to the damage's own place do not add to its detection
NEAR_CORRELATION = 0.2
SHARES = (0.5, 0.9)  # shares of damages found for the comparison of observers
RANGE = (1.0, 12.0)  # range of thresholds, in deviations, in which the wanted one is sought
LAGS = np.arange(-LONGEST_LAG_PX, LONGEST_LAG_PX + 1)


def _padded(height: int, width: int) -> tuple[int, int]:
    """Return the sides of a periodic grid on which points within `LONGEST_LAG_PX` do not overlap
    by wrapping around."""
    high = max(height + LONGEST_LAG_PX, len(LAGS))
    wide = max(width + LONGEST_LAG_PX, len(LAGS))
    return int(scipy.fft.next_fast_len(high, real=True)), int(
        scipy.fft.next_fast_len(wide, real=True)
    )


@dataclass(frozen=True, eq=False)
class NoiseSums:
    """Sums over the judged pixels of noise fields; m = `LONGEST_LAG_PX`."""

    # Sum of the products of pairs of pixels (2 m + 1, 2 m + 1), by lag
    products: np.ndarray
    # Number of pairs (2 m + 1, 2 m + 1), by lag
    pairs: np.ndarray
    # Sum of fourth powers
    fourth: float
    # Number of pixels
    pixels: float

    def __add__(self, added: NoiseSums) -> NoiseSums:
        """Add the sums over other fields."""
        return NoiseSums(
            products=self.products + added.products,
            pairs=self.pairs + added.pairs,
            fourth=self.fourth + added.fourth,
            pixels=self.pixels + added.pixels,
        )

    def __sub__(self, subtracted: NoiseSums) -> NoiseSums:
        """Remove the sums over some fields."""
        return NoiseSums(
            products=self.products - subtracted.products,
            pairs=self.pairs - subtracted.pairs,
            fourth=self.fourth - subtracted.fourth,
            pixels=self.pixels - subtracted.pixels,
        )

    @cached_property
    def autocovariance(self) -> np.ndarray:
        """R (2 m + 1, 2 m + 1) under Parzen's window, lag 0 in the middle, where it is 1."""
        far = np.minimum(np.hypot(LAGS[:, None], LAGS) / LONGEST_LAG_PX, 1.0)
        parzen = np.where(far <= 0.5, 1.0 - 6.0 * far**2 * (1.0 - far), 2.0 * (1.0 - far) ** 3)
        covariance = parzen * self.products / np.maximum(self.pairs, 1.0)
        return np.asarray(covariance / covariance[LONGEST_LAG_PX, LONGEST_LAG_PX])

    @property
    def kurtosis(self) -> float:
        """Excess kurtosis of the noise: 0 if it is Gaussian."""
        variance = self.products[LONGEST_LAG_PX, LONGEST_LAG_PX] / self.pixels
        return float(self.fourth / self.pixels / variance**2 - 3.0)

    def power(self, shape: tuple[int, int]) -> np.ndarray:
        """Return the power spectrum on a periodic grid of ``shape``, ordered as by
        `scipy.fft.rfft2`."""
        image = np.zeros(shape)
        image[np.ix_(LAGS, LAGS)] = self.autocovariance
        power = scipy.fft.rfft2(image).real
        return np.asarray(np.maximum(power, LEAST_POWER * power.mean()))


def noise_sums(noise: np.ndarray, is_known: np.ndarray) -> NoiseSums:
    """Return the sums over fields ``noise`` (k, h, w), in deviations, at the ``is_known`` (k, h,
    w) pixels."""
    shape = _padded(*noise.shape[1:])

    def by_lag(images: np.ndarray) -> np.ndarray:
        power = sum(np.abs(scipy.fft.rfft2(image, shape)) ** 2 for image in images)
        return np.asarray(scipy.fft.irfft2(power, shape)[np.ix_(LAGS, LAGS)])

    filled = np.where(is_known, noise, 0.0)
    return NoiseSums(
        by_lag(filled),
        by_lag(is_known.astype(float)),
        float((filled**4).sum()),
        float(is_known.sum()),
    )


def inverse_times(images: np.ndarray, is_known: np.ndarray, sums: NoiseSums) -> np.ndarray:
    """Return R^-1 x (n, h, w) of images x (n, h, w) over the ``is_known`` (h, w) pixels, 0
    elsewhere, by conjugate gradients that start from the inverse on a periodic grid; exact for any
    outline.
    """
    h, w = is_known.shape
    shape = _padded(h, w)
    power = sums.power(shape)

    def filtered(image: np.ndarray, response: np.ndarray) -> np.ndarray:
        return np.asarray(
            is_known * scipy.fft.irfft2(response * scipy.fft.rfft2(image, shape), shape)[:h, :w]
        )

    solutions = np.zeros(images.shape)
    for image, solution in zip(images, solutions, strict=True):
        residual = is_known * image
        enough = CONVERGED**2 * float((residual**2).sum())
        direction = np.zeros(residual.shape)
        product = 1.0
        for _ in range(MOST_ITERATIONS):
            if float((residual**2).sum()) <= enough:
                break
            towards = filtered(residual, 1.0 / power)
            before = product
            product = float((residual * towards).sum())
            direction = towards + product / before * direction
            onward = filtered(direction, power)
            step = product / float((direction * onward).sum())
            solution += step * direction
            residual = residual - step * onward
    return solutions


def detectability(
    signals: np.ndarray, surface: np.ndarray, is_known: np.ndarray, sums: NoiseSums
) -> np.ndarray:
    """Return d' (n,) of signals (n, h, w) on an unknown sum of images ``surface`` (p, h, w), both
    in deviations."""
    whitened = inverse_times(np.concatenate([surface, signals]), is_known, sums)
    flat = whitened.reshape(len(whitened), -1)
    gram = flat @ np.concatenate([surface, signals]).reshape(len(flat), -1).T
    p = len(surface)
    explained = gram[p:, :p] @ np.linalg.solve((gram[:p, :p] + gram[:p, :p].T) / 2, gram[:p, p:])
    return np.asarray(np.sqrt(np.maximum(np.diag(gram[p:, p:] - explained), 0.0)))


def responses(signal: np.ndarray, sums: NoiseSums) -> np.ndarray:
    """Return s' R^-1 s_k (2 m + 1, 2 m + 1), where s_k is a signal (h, w) in deviations moved by a
    lag k. The middle is d'^2 on an endless board with a known surface; the others, divided by it,
    are the statistic's correlation."""
    rows, columns = np.nonzero(signal)
    image = signal[rows.min() : rows.max() + 1, columns.min() : columns.max() + 1]
    shape = _padded(*image.shape)
    field = scipy.fft.irfft2(np.abs(scipy.fft.rfft2(image, shape)) ** 2 / sums.power(shape), shape)
    return np.asarray(field[np.ix_(LAGS, LAGS)])


# ---------------------------------------------------------------- threshold and probability of
# detection


def _covariance(correlated: np.ndarray, lags: np.ndarray) -> np.ndarray:
    """Return the covariance (n, n) of the statistic at places (n, 2) in pixels."""
    lag_index = lags[:, None] - lags[None] + len(correlated) // 2
    return np.asarray(correlated[lag_index[..., 0], lag_index[..., 1]])


def _root(covariance: np.ndarray) -> np.ndarray:
    """Return a matrix whose product with its transpose is a covariance, which rounding may have
    made indefinite."""
    values, vectors = np.linalg.eigh(covariance)
    return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0)))


def _normals(count: int) -> np.ndarray:
    """Return standard normals (`NORMALS`, count): the same every time, each with its opposite."""
    drawn = random_stream(0, "neighbourhoods of the ideal observer", count).standard_normal(
        (NORMALS // 2, count)
    )
    return np.concatenate([drawn, -drawn])


NEIGHBOURS = np.array([(v, u) for v in (-1, 0, 1) for u in (-1, 0, 1) if (v, u) != (0, 0)])


def maxima_per_pixel(correlated: np.ndarray, thresholds: np.ndarray) -> np.ndarray:
    """Return the expected number (t,) per pixel of local maxima of a Gaussian field above
    ``thresholds`` (t,): values that exceed their eight neighbours, by integration over the
    maximum's height."""
    rho = _covariance(correlated, np.concatenate([[(0, 0)], NEIGHBOURS]))
    spread = _normals(len(NEIGHBOURS)) @ _root(rho[1:, 1:] - np.outer(rho[1:, 0], rho[1:, 0])).T
    # a value z exceeds a neighbour of mean rho z and deviation `spread` if z is above spread / (1
    # - rho)
    least = np.sort((spread / np.maximum(1.0 - rho[1:, 0], 1e-12)).max(axis=1))
    # maxima above t: the mean over draws of the normal's tail beyond max(t, least)
    tails = special.ndtr(-np.maximum(least[None], np.asarray(thresholds, float)[:, None]))
    return np.asarray(tails.mean(axis=1))


def threshold_for(correlated: np.ndarray, maxima: float) -> float:
    """Return the threshold with this expected number of maxima per pixel."""
    root = optimize.brentq(
        lambda t: np.log(maxima_per_pixel(correlated, np.array([t]))[0] / maxima), *RANGE, xtol=1e-4
    )
    return float(root)


def needed_indices(correlated: np.ndarray, threshold: float) -> np.ndarray:
    """Return draws (n,) of d' minus one standard normal for which the statistic just exceeds the
    threshold at the best of the near places; its mean is d' at the damage, and d' times its
    correlation around it."""
    middle = len(correlated) // 2
    half = int((correlated[middle, middle:] > 0.5).sum())
    stride = min(max(1, half // AROUND), middle // (2 * AROUND))
    steps = stride * np.arange(-AROUND, AROUND + 1)
    offsets = np.stack(np.meshgrid(steps, steps, indexing="ij"), axis=-1).reshape(-1, 2)
    rho = correlated[offsets[:, 0] + middle, offsets[:, 1] + middle]
    offsets = offsets[rho > NEAR_CORRELATION]
    rho = rho[rho > NEAR_CORRELATION]
    conditional_noise = (
        _normals(len(rho)) @ _root(_covariance(correlated, offsets) - np.outer(rho, rho)).T
    )
    return np.asarray(((threshold - conditional_noise) / rho).min(axis=1))


def detection_probability(needed: np.ndarray, index: float) -> float:
    """Return the probability of detection at d' = ``index``, from `needed_indices`."""
    return float(special.ndtr(index - needed).mean())


def index_for(needed: np.ndarray, share: float) -> float:
    """Return d' at which a share of damages is found, from `needed_indices`."""
    lowest = needed.min() - 5.0
    highest = needed.max() + 5.0
    root = optimize.brentq(
        lambda index: detection_probability(needed, index) - share, lowest, highest
    )
    return float(root)


# ---------------------------------------------------------------- damages of a set-up


@dataclass(frozen=True, eq=False)
class BoardView:
    """One damaged board with n damages as the ideal observer sees it."""

    # Number of the board
    board: int
    # Names of the damages
    holes: tuple[str, ...]
    # Mask (h, w) of the judged pixels
    is_known: np.ndarray
    # Standard deviation (h, w) of the noise, metres
    deviation_m: np.ndarray
    # Signatures (n, h, w) of the damages, metres, 0 where nothing is judged
    signals_m: np.ndarray
    # Polynomials (p, h, w) whose sum the surface is
    surface: np.ndarray
    # Sums over the noise of all units
    sums: NoiseSums
    # Number of units
    units: int
    # Area of a pixel on the face, square metres
    pixel_m2: float
    # Share of the pixels within damage that return nothing
    lost: float


@dataclass(frozen=True, eq=False)
class IdealDamages:
    """The ideal observer on n damages."""

    # Number (n,) of each damage's board
    board: np.ndarray
    # Name (n,) of each damage
    hole: np.ndarray
    # d' (n,)
    index: np.ndarray
    # Threshold (n,) of the statistic; NaN if d' is 0
    threshold: np.ndarray
    # Probability of detection (n,)
    pod: np.ndarray
    # d' (2, n) at which the shares `SHARES` are found
    needed: np.ndarray
    # Number of units whose noise is pooled
    units: int
    # Excess kurtosis of the noise
    kurtosis: float
    # Largest share of a board's pixels within damage that return nothing
    lost: float


def ideal_damages(views: Sequence[BoardView], calls_per_m2: float) -> IdealDamages:
    """Judge the damages of a set-up's boards at a rate of false calls. The noise of all boards is
    pooled."""
    sums = reduce(add, (view.sums for view in views))
    rows: list[tuple[int, str, float, float, float]] = []
    at_shares = []
    for view in views:
        signals = view.signals_m / view.deviation_m * view.is_known
        surface = view.surface / view.deviation_m * view.is_known
        is_seen = signals.any(axis=(1, 2))
        index = np.zeros(len(signals))
        index[is_seen] = detectability(signals[is_seen], surface, view.is_known, sums)
        for hole, signal, d in zip(view.holes, signals, index.tolist(), strict=True):
            if d == 0.0:
                rows.append((view.board, hole, 0.0, np.nan, 0.0))
                at_shares.append([np.nan] * len(SHARES))
                continue
            field = responses(signal, sums)
            square = field[LONGEST_LAG_PX, LONGEST_LAG_PX]
            threshold = threshold_for(field / square, calls_per_m2 * view.pixel_m2)
            needed = needed_indices(field / square, threshold)
            rows.append((view.board, hole, d, threshold, detection_probability(needed, d)))
            at_shares.append([index_for(needed, share) for share in SHARES])
    boards, holes, indices, thresholds, pods = zip(*rows, strict=True)
    return IdealDamages(
        board=np.array(boards),
        hole=np.array(holes),
        index=np.array(indices),
        threshold=np.array(thresholds),
        pod=np.array(pods),
        needed=np.array(at_shares).T,
        units=sum(view.units for view in views),
        kurtosis=sums.kurtosis,
        lost=max(view.lost for view in views),
    )
