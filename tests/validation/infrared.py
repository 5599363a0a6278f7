"""What the infrared image of a recording says of the camera: its lens blur and its noise.

Run ``python tests/validation/infrared.py RECORDING``, half a minute. The infrared image of an Azure
Kinect is the sum of a pixel's own amplitudes, before the filter that depth goes through.

Blur: each straight edge is fitted, in pieces of 31 x 11 pixels, by a step between two shaded sides,
averaged over a pixel and blurred by a Gaussian (the edge spread function of ISO 12233). No depth is
used, so flying pixels and gaps at edges can test the result. A real edge has a width of its own,
which adds to the blur in quadrature: each piece gives an upper bound.

Noise: the variance within patches of 5 x 5 pixels about a quadratic, against their brightness (the
photon transfer curve). Its slope is the shot noise, its constant the read noise, and its quadratic
term the surfaces' own texture.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
from scipy import ndimage, optimize, special

from detectors.recordings.opening import open_capture

HALF_LENGTH_PX = 15
HALF_WIDTH_PX = 5
STEEPEST = 0.5
"""Most pixels across per pixel along an edge: the box of a pixel is nearly that along one axis."""
LEAST_GRADIENT = 0.1
"""Of the brightness, in a pixel: where an edge is looked for."""
LIT_UNITS = 30.0
"""Least brightness of the darker side. The rim of the lit field is cut by the device: 0 beyond."""
BRIGHT_UNITS = 2000.0
"""Most brightness of the brighter side: nearer things are curved, and near saturation."""
LEAST_CONTRAST = 10.0
"""Of the step, in deviations of what the fit leaves."""
MOST_BOW_PX = 0.5
"""Of an edge that counts as straight, at the ends of a piece."""
MOST_ERROR_PX = 0.06
"""Standard error of a blur that counts."""
SHARPEST = 3
PATCH_PX = 5


@dataclass(frozen=True)
class EdgePiece:
    """A fitted piece of an edge."""

    row: int
    """Row of its centre."""
    column: int
    """Column of its centre."""
    blur_px: float
    """Deviation of the Gaussian."""
    blur_error_px: float
    """Its standard error, by what the fit leaves."""
    bow_px: float
    """Departure from a straight line at its ends."""
    dark_units: float
    """Brightness of the darker side."""
    bright_units: float
    """Brightness of the brighter side."""
    contrast: float
    """Step in deviations of what the fit leaves."""

    @property
    def counts(self) -> bool:
        """Whether the piece is a lit, straight and clear edge."""
        return (
            self.dark_units > LIT_UNITS
            and self.bright_units < BRIGHT_UNITS
            and self.contrast > LEAST_CONTRAST
            and self.bow_px < MOST_BOW_PX
            and self.blur_error_px < MOST_ERROR_PX
        )


def spread(distance_px: np.ndarray, blur_px: float, pixel_px: float) -> np.ndarray:
    """Return the light (0 to 1) of pixels at a distance from a blurred step, averaged over a box of
    ``pixel_px`` across the edge."""

    def integral(x: np.ndarray) -> np.ndarray:
        bell = np.exp(-((x / blur_px) ** 2) / 2) / np.sqrt(2 * np.pi)
        return np.asarray(x * special.ndtr(x / blur_px) + blur_px * bell)

    ends = integral(distance_px + pixel_px / 2) - integral(distance_px - pixel_px / 2)
    return np.asarray(ends / pixel_px)


def _shapes(line: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Return the (n, 5) shapes of which a piece is a sum: both sides, their shading across the
    edge, and shading along it. ``line``: place, slope and bow of the edge, and its blur."""
    offset, slope, bow, blur_px = line
    across = 1 / np.sqrt(1 + slope**2)
    distance_px = ((u - (offset + slope * v + bow * v**2)) * across).ravel()
    second = spread(distance_px, max(abs(blur_px), 0.02), across)
    first = 1 - second
    return np.stack([first, second, distance_px * first, distance_px * second, v.ravel()], axis=1)


def fitted_piece(image: np.ndarray, row: int, column: int) -> EdgePiece | None:
    """Fit an edge that runs along the rows' axis, about a pixel of an image (h, w); None if there
    is none, or it is too slanted."""
    rows = slice(row - HALF_LENGTH_PX, row + HALF_LENGTH_PX + 1)
    columns = slice(column - HALF_WIDTH_PX, column + HALF_WIDTH_PX + 1)
    piece = image[rows, columns]
    v, u = np.mgrid[
        -HALF_LENGTH_PX : HALF_LENGTH_PX + 1, -HALF_WIDTH_PX : HALF_WIDTH_PX + 1
    ].astype(float)
    steps = np.abs(np.diff(ndimage.uniform_filter1d(piece, 5, axis=0), axis=1))
    steps = np.maximum(steps - np.median(steps, axis=1, keepdims=True), 0) ** 2
    between = np.arange(-HALF_WIDTH_PX, HALF_WIDTH_PX) + 0.5
    positions = (steps * between).sum(axis=1) / np.maximum(steps.sum(axis=1), 1e-9)
    slope, offset = np.polyfit(v[:, 0], positions, 1)
    if abs(slope) > STEEPEST:
        return None
    light = piece.ravel()

    def left(line: np.ndarray) -> np.ndarray:
        shapes = _shapes(line, u, v)
        return np.asarray(shapes @ np.linalg.lstsq(shapes, light)[0] - light)

    start = [offset, slope, 0.0, 0.6]
    fit = optimize.least_squares(left, start, x_scale=[0.3, 0.02, 1e-3, 0.2], max_nfev=30)
    variance = 2 * fit.cost / (light.size - 9)
    try:
        covariance = np.linalg.inv(fit.jac.T @ fit.jac) * variance
    except np.linalg.LinAlgError:
        return None
    if abs(fit.x[0]) > HALF_WIDTH_PX / 2:
        return None
    sides = np.linalg.lstsq(_shapes(fit.x, u, v), light)[0][:2]
    return EdgePiece(
        row=row,
        column=column,
        blur_px=abs(float(fit.x[3])),
        blur_error_px=float(np.sqrt(covariance[3, 3])),
        bow_px=abs(float(fit.x[2])) * HALF_LENGTH_PX**2,
        dark_units=float(sides.min()),
        bright_units=float(sides.max()),
        contrast=float(np.ptp(sides) / np.sqrt(variance)),
    )


def edge_pieces(image: np.ndarray) -> list[EdgePiece]:
    """Return the pieces of edges of an image (h, w) that run along the rows' axis and count."""
    smooth = ndimage.gaussian_filter1d(image, 4.0, axis=0)
    gradient = np.abs(np.gradient(smooth, axis=1))
    is_edge = gradient == ndimage.maximum_filter1d(gradient, 9, axis=1)
    is_edge &= gradient > LEAST_GRADIENT * np.maximum(smooth, LIT_UNITS)
    is_edge[:, : HALF_WIDTH_PX + 2] = False
    is_edge[:, -HALF_WIDTH_PX - 3 :] = False
    pieces = []
    for row in range(HALF_LENGTH_PX + 2, len(image) - HALF_LENGTH_PX - 2, HALF_LENGTH_PX):
        for column in np.flatnonzero(is_edge[row]):
            piece = fitted_piece(image, row, int(column))
            if piece is not None and piece.counts:
                pieces.append(piece)
    return pieces


def photon_transfer(image: np.ndarray) -> np.ndarray:
    """Return the constant, slope and quadratic term of the variance of patches of an image (h, w)
    against their brightness S: units^2, units and 1."""
    v, u = np.mgrid[:PATCH_PX, :PATCH_PX].reshape(2, -1) - PATCH_PX // 2
    quadratic = np.column_stack([np.ones(len(u)), u, v, u**2, u * v, v**2])
    off_quadratic = np.eye(len(u)) - quadratic @ np.linalg.pinv(quadratic)
    height = len(image) // PATCH_PX
    width = image.shape[1] // PATCH_PX
    cut = image[: height * PATCH_PX, : width * PATCH_PX]
    squares = cut.reshape(height, PATCH_PX, width, PATCH_PX).swapaxes(1, 2)
    patches = squares.reshape(height * width, PATCH_PX**2)
    lit = patches[(patches.min(axis=1) > LIT_UNITS) & (patches.max(axis=1) < BRIGHT_UNITS)]
    brightness = lit.mean(axis=1)
    freedom = len(u) - quadratic.shape[1]
    variance = ((lit @ off_quadratic) ** 2).sum(axis=1) / freedom
    middles = []
    for low, high in pairwise(LEVELS):
        inside = (brightness >= low) & (brightness < high)
        # the median of chi-square over its mean; edges and texture are in the upper tail
        noise = np.median(variance[inside]) / (1 - 2 / (9 * freedom)) ** 3
        middles.append((brightness[inside].mean(), noise))
    level, noise = np.array(middles).T
    terms = np.column_stack([np.ones(len(level)), level, level**2])
    return np.asarray(np.linalg.lstsq(terms / noise[:, None], np.ones(len(level)))[0])


LEVELS = (75.0, 100.0, 130.0, 180.0, 260.0, 360.0, 500.0, 700.0, 1000.0)
IMAGE_GAIN = 0.9697
"""Infrared image over the sum of amplitudes (OpenK4A)."""


def electrons(terms: np.ndarray, contrasts: float) -> tuple[float, float]:
    """Return electrons per unit and read noise in electrons, by a photon transfer curve.

    With three phases an amplitude has 2/3 of a sample's variance, (N + 2 r^2) / g^2 for N electrons
    in both wells, and is c N / g; ``contrasts`` is the sum of c over three frequencies.
    """
    constant, slope, _ = terms
    per_unit = 2 * IMAGE_GAIN / contrasts / slope
    return float(per_unit), float(np.sqrt(constant * per_unit**2 / (4 * IMAGE_GAIN**2)))


def main() -> None:
    parser = argparse.ArgumentParser(prog="python tests/validation/infrared.py")
    parser.add_argument("recording", type=Path)
    (frame, *_) = open_capture([parser.parse_args().recording]).frames()
    assert frame.amplitude is not None
    image = frame.amplitude.astype(float)
    pieces = [("down", piece) for piece in edge_pieces(image)]
    pieces += [("across", piece) for piece in edge_pieces(np.ascontiguousarray(image.T))]
    for direction, piece in pieces:
        label = f"row {piece.row:3}, column {piece.column:3}"
        if direction == "across":
            label = f"row {piece.column:3}, column {piece.row:3}"
        print(
            f"{label}, {direction:6}: blur {piece.blur_px:.2f} +- {piece.blur_error_px:.2f} px, "
            f"{piece.dark_units:.0f} to {piece.bright_units:.0f} units"
        )
    blurs_px = np.sort([piece.blur_px for _, piece in pieces])
    print(
        f"{len(blurs_px)} pieces: blur {blurs_px[0]:.2f} to {blurs_px[-1]:.2f} px, the {SHARPEST} "
        f"sharpest {blurs_px[:SHARPEST].mean():.2f}, median {np.median(blurs_px):.2f}"
    )
    terms = photon_transfer(image)
    per_unit, read_noise = electrons(terms, 0.87 + 0.88 + 0.96)
    print(
        f"noise: {terms[0]:.0f} + {terms[1]:.2f} S + {terms[2]:.1e} S^2 units^2 at S units: "
        f"{per_unit:.2f} electrons per unit, read noise {read_noise:.1f} electrons per well"
    )


if __name__ == "__main__":
    main()
