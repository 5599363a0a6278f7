"""Groups of pixels whose colour differs from the target's own colour: candidates for marks, with
their rims.

A smooth polynomial fitted over the target removes uneven light. The scatter of the remainder
(minimum covariance determinant, Rousseeuw 1985) measures the variation of the target's own colour;
the threshold is extrapolated from its tail to a given rate of false pixels. Marks may cover a
quarter of the target. Not modelled: hard shadows."""

from dataclasses import dataclass

import cv2
import numpy as np

from detectors.pixels.masks import grown, parts_with, shrunk
from detectors.pixels.noise import sigma_of
from detectors.surfaces.surface import SurfaceConfig, fit_surface
from harness.vocabulary.geometry import Cloud

FALSE_RATE = 1e-5
"""Share of the target's own pixels beyond the threshold by the extrapolated tail. Real tails have
ten (Gauss) to a hundred (Laplace) times as many, which form no mark, because a mark has nine
pixels that touch."""
# degree of the polynomial: the light of one lamp, or of two of different colour, bends once over a
# board
DEGREE = 2
SAMPLE = 4096
STEPS = 6
CORE = 0.6
"""Number of pixels in the fit, number of steps of the scatter, and share of the pixels on which
the scatter rests."""
CORE_SHRINKS = {
    1: 0.2146,
    2: 0.3891,
}  # variance of the innermost part (`CORE`) of a Gaussian in one and two dimensions
GAUSSIAN_LIMITS = {1: 4.4172, 2: 4.7985}
"""Distances that a share `FALSE_RATE` of a Gaussian exceeds, in one and two dimensions."""
# reach of a camera's smearing of colour: JPEG stores one value for 2 x 2 pixels, in blocks of
# eight
NEARBY_PX = 16
TAIL = (
    0.4,
    0.7,
)  # quantiles from which the tail is extrapolated; pixels above them may belong to marks


def chromaticity(rgb: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the shares (n, 2) of red and blue in the sum of the channels of colours (n, 3) uint8,
    and the variance (n,) of each from rounding to whole counts. Half a count is added, so that
    black has a share."""
    counts = rgb.astype(np.float64) + 0.5
    total = counts.sum(axis=1)
    shares = counts[:, [0, 2]] / total[:, None]
    return shares, 1.0 / 12.0 / total**2


def lightness(rgb: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the logarithm (n, 1) of the mean of the channels, and its variance (n,) from
    rounding."""
    mean = rgb.astype(np.float64).mean(axis=1) + 0.5
    return np.log(mean)[:, None], 1.0 / 36.0 / mean**2


def stand_out(
    features: np.ndarray,
    rounding: np.ndarray,
    xy: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Return the distance (n,) of pixels from the target's own colour: in deviations of its
    scatter (the contrast), and in units of the threshold (the margin). ``features`` (n, p), p 1 or
    2. ``rounding`` (n,): their variance from whole counts; all noise is assumed to grow in
    proportion to it. ``xy`` (n, 2): any smooth co-ordinates."""
    stride = max(1, len(features) // SAMPLE)
    x, y = xy.T
    sample_x, sample_y = xy[::stride].T
    # marks may cover a quarter, all at one end
    smooth = SurfaceConfig(degree=DEGREE, method="lts")
    offsets = []
    for feature in features.T:
        fitted = fit_surface(sample_x, sample_y, feature[::stride], smooth)
        offsets.append(feature - fitted.evaluate(x, y))
    offset = np.stack(offsets, axis=1)
    darkness = np.sqrt(np.maximum(rounding / np.median(rounding), 1.0))
    sample = (offset / darkness[:, None])[::stride]
    p = features.shape[1]
    # covariance (p, p) of the bulk about the backdrop, scaled like the innermost part of a
    # Gaussian
    scatter = np.diag([max(sigma_of(component), 1e-6) ** 2 for component in sample.T])
    for _ in range(STEPS):
        square = np.einsum("ni,ij,nj->n", sample, np.linalg.inv(scatter), sample)
        core = sample[square <= np.quantile(square, CORE)]
        scatter = core.T @ core / len(core) / CORE_SHRINKS[p] + 1e-12 * np.eye(p)
    scatter += np.median(rounding) * np.eye(p)
    contrast = np.sqrt(np.einsum("ni,ij,nj->n", offset, np.linalg.inv(scatter), offset))
    distance = contrast / darkness
    # the tail is a Weibull through the quantiles `TAIL`, between a Gaussian (shape 2 in two
    # dimensions) and an exponential (shape 1), and never below the Gaussian
    middle, outer = np.quantile(distance[::stride], TAIL)
    logs = [-np.log(1.0 - share) for share in TAIL]
    shape = 2.0
    if 0 < middle < outer:
        through_both = np.log(logs[1] / logs[0]) / np.log(outer / middle)
        shape = float(np.clip(through_both, 1.0, 2.0))
    tail = outer * (-np.log(FALSE_RATE) / logs[1]) ** (1.0 / shape)
    return contrast, distance / max(tail, GAUSSIAN_LIMITS[p])


def above_half(chosen: np.ndarray, contrast: np.ndarray) -> np.ndarray:
    """Return (h, w) bool: those ``chosen`` pixels whose contrast exceeds half of the largest
    nearby (of medians of 3 x 3), so that a group ends half way along its edge."""
    beyond = np.where(chosen, contrast, 0.0).astype(np.float32)
    side = 2 * NEARBY_PX + 1
    greatest = cv2.dilate(cv2.medianBlur(beyond, 3), np.ones((side, side), np.uint8))
    return np.asarray(chosen & (beyond > 0.5 * greatest))


LEAST_PIXELS = 9
MOST_BLOBS = 200
"""Fewest pixels of a mark, three by three (fewer have no inside), and the most groups that are
examined."""
# widths of the band around a group that is searched for a mixed rim, and of its surroundings
RIM_PX = 2
RING_PX = 8
MIXED_SHARE = 0.15
"""Share of the rim, two pixels wide, with colours between 0.2 and 0.8 of the way from one colour
to the other: 0.6 / 2 if a colour is the mean over the pixel's area, and 0 if it is the colour at
the pixel's centre."""
SHARE_SIGMA = 0.1
"""Standard deviation of a rim pixel's share of area: the camera's transfer curve and the lens's
blur are unknown."""
ALIKE = 0.35
"""A pixel has a blob's colour if its distance to it is below this share of its distance to the
surroundings' colour."""
CUT_SHARE = 0.05
"""A blob continues beyond the target if more than this share of the pixels around it have its
colour but lie off it."""
# shifts of the lattice along each axis, over which the error of a centroid is averaged
SHIFTS = 12
RECTANGULAR = 0.85
"""Least share of the smallest enclosing rectangle that a rectangle's pixels fill; those of an
ellipse fill 0.79."""
SIZES = 5
TURNS = np.array([-1.0, 0.0, 1.0]) / 3
"""Number of outlines between one pixel and the next, in width and height; rotations, in pixels
over the length."""


@dataclass(frozen=True)
class Blob:
    """A connected group of pixels of another colour than the target's."""

    pixels: np.ndarray
    """(n,): flat indices."""
    weights: np.ndarray
    """(n,): the pixels' share of the blob's colour, 0..1."""
    grid: np.ndarray
    """(n, 2): the pixels' places on a grid of unit step."""
    grid_covariance: np.ndarray
    """(2, 2): of the centroid on that grid."""
    surroundings: np.ndarray
    """(m,): flat indices of the target's points on and around it."""
    contrast: np.ndarray
    """(3,): logarithm of its colour over that of its surroundings by channel, in which the light
    cancels."""
    doubt: str = ""
    """That it is cut, else empty."""


def find_blobs(
    cloud: Cloud,
    inside: np.ndarray,
    coloured: np.ndarray,
) -> list[Blob]:
    """Return the connected groups of ``coloured`` (h, w) pixels, largest first; single missing
    pixels do not separate them. Whether rims have mixed colours is a property of the camera, so it
    is decided for all groups together."""
    closed = cv2.morphologyEx(coloured.astype(np.uint8), cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8))
    _, labels, boxes, _ = cv2.connectedComponentsWithStats(closed, connectivity=8)
    order = 1 + np.argsort(-boxes[1:, cv2.CC_STAT_AREA], kind="stable")[:MOST_BLOBS]
    large = [label for label in order if boxes[label, cv2.CC_STAT_AREA] >= LEAST_PIXELS]
    windows = []
    for label in large:
        window = _window(cloud, inside, coloured, labels, label, boxes[label])
        if window is not None:
            windows.append(window)
    rims = np.concatenate([np.zeros(0), *(window.share[window.rim] for window in windows)])
    is_mixed = (rims > 0.2) & (rims < 0.8)
    mixed = len(rims) > 0 and bool(np.mean(is_mixed) >= MIXED_SHARE)
    blobs = []
    for window in windows:
        blob = window.blob(cloud, mixed)
        if blob is not None:
            blobs.append(blob)
    # a blob that shares pixels with a larger one is part of it
    taken = np.zeros(inside.size, dtype=bool)
    kept = []
    for blob in sorted(blobs, key=lambda b: -float(b.weights.sum())):
        core_pixels = blob.pixels[blob.weights > 0.5]
        if not taken[core_pixels].any():
            kept.append(blob)
        taken[core_pixels] = True
    return kept


@dataclass(frozen=True)
class _Window:
    """The part of a picture around a group of pixels, (h, w)."""

    cut: tuple[slice, slice]
    """Rows and columns of the picture."""
    target: np.ndarray
    """(h, w) bool: the target's pixels."""
    group: np.ndarray
    """(h, w) bool: the group, as far as its colour goes."""
    other_groups: np.ndarray
    """(h, w) bool: pixels of another colour than the target's that are not the group's."""
    rgb: np.ndarray
    """(h, w, 3): the colours under even light."""
    backdrop: np.ndarray
    """(3,): the colour of the surroundings."""
    span: np.ndarray
    """(3,): the group's colour less that of the surroundings."""
    share: np.ndarray
    """(h, w): share of the way from the surroundings' colour (0) to the group's (1)."""
    strays: float
    """Standard deviation of that share in the surroundings."""

    @property
    def rim(self) -> np.ndarray:
        """The pixels (h, w) bool on both sides of the group's border."""
        return np.asarray(grown(self.group, 1) & ~_eroded(self.group) & self.target)

    def blob(self, cloud: Cloud, mixed: bool) -> Blob | None:
        """Return the blob of the group, pixels weighted by their share of its colour if rims are
        ``mixed``; None if too few."""
        weights = self.group.astype(float)
        if mixed:
            reach = grown(self.group, RIM_PX) & self.target & ~self.other_groups
            weights = np.where(reach, np.clip(self.share, 0.0, 1.0), 0.0)
        v, u = np.nonzero((weights > 0.5) & self.target)
        if len(u) < LEAST_PIXELS or min(np.ptp(u), np.ptp(v)) < 1:
            return None
        rows, columns = self.cut
        height_px, width_px = cloud.valid.shape
        at_side = u.min() == -columns.start or u.max() == width_px - 1 - columns.start
        at_end = v.min() == -rows.start or v.max() == height_px - 1 - rows.start
        doubt = self._doubt_beyond_target(cloud)
        if not doubt and (at_side or at_end):
            doubt = "cut by the picture's edge"
        used_v, used_u = np.nonzero((weights > 0) & self.target)
        grid = np.stack([used_u, used_v], axis=1).astype(float)
        covariance = self._mixed_covariance_px2(weights) if mixed else region_covariance_px2(grid)
        target_v, target_u = np.nonzero(self.target)
        # a count is added to each colour, so that black has a logarithm
        contrast = np.log((self.backdrop + self.span + 1.0) / (self.backdrop + 1.0))
        return Blob(
            pixels=(used_v + rows.start) * width_px + used_u + columns.start,
            weights=weights[used_v, used_u],
            grid=grid,
            grid_covariance=covariance,
            surroundings=(target_v + rows.start) * width_px + target_u + columns.start,
            contrast=contrast,
            doubt=doubt,
        )

    def _doubt_beyond_target(self, cloud: Cloud) -> str:
        """Return that the group may continue where the target has no points; empty if not."""
        around = grown(self.group, 1) & ~self.group
        off_colour = np.linalg.norm(self.rgb - self.backdrop - self.span, axis=-1)
        has_colour = off_colour < ALIKE * np.linalg.norm(self.span)
        beyond_target = around & has_colour & ~self.target
        if beyond_target.sum() <= max(2.0, CUT_SHARE * around.sum()):
            return ""
        by_crop = (beyond_target & cloud.valid[self.cut]).sum() > beyond_target.sum() / 2
        return "cut by the crop's edge" if by_crop else "without range in parts of it"

    def _mixed_covariance_px2(self, weights: np.ndarray) -> np.ndarray:
        """Return the covariance (2, 2) of the centroid of ``weights`` (h, w), of which those of
        the rim err by `SHARE_SIGMA` and by the scatter of the surroundings' colours."""
        middle = np.argwhere(self.group)[:, ::-1].mean(axis=0)
        arm = np.argwhere(self.rim)[:, ::-1] - middle
        area_px = max(float(weights.sum()), 1.0)
        variance = SHARE_SIGMA**2 + self.strays**2
        return np.asarray(variance * arm.T @ arm / area_px**2)


def _window(
    cloud: Cloud,
    inside: np.ndarray,
    coloured: np.ndarray,
    labels: np.ndarray,
    label: int,
    box: np.ndarray,
) -> _Window | None:
    """Return the window of a group by its number in ``labels`` (h, w) and its box; None if the
    target's own colour is not visible around it."""
    left_px, top, width, height, area = box.tolist()
    margin = max(RING_PX + 2, round(0.5 * np.sqrt(area)))
    row = max(top - margin, 0)
    column = max(left_px - margin, 0)
    cut = (slice(row, top + height + margin), slice(column, left_px + width + margin))
    assert cloud.rgb is not None
    target = inside[cut]
    candidates = coloured[cut]
    first = (labels[cut] == label) & candidates
    core = _eroded(first)
    core = core if core.sum() >= LEAST_PIXELS else first
    ring = grown(first, RING_PX) & ~grown(first, RIM_PX + 2) & target & ~candidates
    if ring.sum() < LEAST_PIXELS:
        return None
    rgb = _evenly_lit(cloud.rgb[cut].astype(float), ring, first)
    backdrop = np.median(rgb[ring], axis=0)
    span = np.median(rgb[core], axis=0) - backdrop
    share = (rgb - backdrop) @ span / max(float(span @ span), 1e-12)
    # mosaic and JPEG make neighbours share colour: the scatter of equivalent independent pixels
    scatter = np.mean(share[ring] ** 2)
    blurred_scatter = 25.0 * np.mean(cv2.blur(share, (5, 5))[ring] ** 2)
    # the threshold that found the group only knows the target's colour and leaves gaps at low
    # contrast: take the connected pixels nearer to the group's colour, as far as the surroundings
    # reach
    group = parts_with((share > 0.5) & target & grown(first, RING_PX), first)
    return _Window(
        cut=cut,
        target=target,
        group=group,
        other_groups=candidates & ~group,
        rgb=rgb,
        backdrop=backdrop,
        span=span,
        share=share,
        strays=float(np.sqrt(max(scatter, blurred_scatter))),
    )


def _evenly_lit(
    rgb: np.ndarray,
    ring: np.ndarray,
    group: np.ndarray,
) -> np.ndarray:
    """Return colours (h, w, 3) as if the light at the group's middle fell everywhere: each channel
    is divided by a plane fitted to the ring. Otherwise uneven light along a group would weight its
    two ends differently."""
    v, u = np.mgrid[0 : rgb.shape[0], 0 : rgb.shape[1]]
    middle_v = float(v[group].mean())
    middle_u = float(u[group].mean())
    by_u = (u - middle_u) / rgb.shape[1]
    by_v = (v - middle_v) / rgb.shape[0]
    basis = np.stack([np.ones(rgb.shape[:2]), by_u, by_v], axis=-1)
    plane = np.linalg.lstsq(basis[ring], rgb[ring], rcond=1e-9)[0]
    light = basis @ plane / np.maximum(plane[0], 1.0)
    return np.asarray(rgb / np.clip(light, 0.5, 2.0))


def _eroded(mask: np.ndarray) -> np.ndarray:
    """Remove one pixel along the mask's border; the area beyond the window counts as outside."""
    padded = np.pad(mask, 1)
    return shrunk(padded, 3)[1:-1, 1:-1]


def centroid_covariance_px2(polygon_px: np.ndarray) -> np.ndarray:
    """Return the covariance (2, 2) of the centroid of the lattice points within convex polygons
    (..., n, 2), vertices in order, over all shifts of the lattice and all polygons."""
    _, centre = _area_and_centre(polygon_px)
    centred = polygon_px - centre[..., None, :]
    steps = np.stack(np.meshgrid(np.arange(SHIFTS), np.arange(SHIFTS)), axis=-1)
    shift = (steps.reshape(-1, 2) + 0.5) / SHIFTS
    # polygons by shifts, then the lattice's rows, then edges
    vertices = centred.shape[-2]
    shifted = centred.reshape(-1, 1, 1, vertices, 2) + shift[:, None, None]
    x, y = np.moveaxis(shifted, -1, 0)
    edge_x = np.roll(x, -1, axis=-1) - x
    edge_y = np.roll(y, -1, axis=-1) - y
    row = np.arange(np.floor(y.min()), np.ceil(y.max()) + 1)[:, None]
    with np.errstate(divide="ignore", invalid="ignore"):
        along_edge = (row - y) / edge_y
        crossing_x = x + along_edge * edge_x
    is_crossed = (along_edge >= 0) & (along_edge <= 1)
    crossing_x = np.where(is_crossed, crossing_x, np.nan)

    # a row's lattice points lie between its two crossings
    first = np.ceil(np.fmin.reduce(crossing_x, axis=-1))
    last = np.floor(np.fmax.reduce(crossing_x, axis=-1))
    number = np.nan_to_num(np.maximum(last - first + 1, 0))
    sums_x = np.nan_to_num(number * (first + last) / 2)
    sums_y = number * row[:, 0]
    sums = np.stack([sums_x, sums_y], axis=-1).sum(axis=-2)
    centroid = sums / number.sum(axis=-1, keepdims=True)
    error = (centroid - shift).reshape(-1, 2)
    return np.asarray(error.T @ error / len(error))


def region_covariance_px2(pixels: np.ndarray) -> np.ndarray:
    """Return the covariance (2, 2) of the centroid of a region known only by its pixel positions
    (m, 2), not all on a line. It is represented by its convex outline, or by its smallest
    rectangle if it fills that. Its size and slope are known to a part of a pixel and decide
    whether errors of opposite edges add or cancel, so the covariance is the mean over outlines up
    to a pixel larger and rotated by up to a pixel."""
    hull = cv2.convexHull(pixels.astype(np.float32))
    box_middle, size, angle = cv2.minAreaRect(hull)
    # the outermost pixel centres lie half a pixel inside the region
    width = size[0] + 1
    height = size[1] + 1
    if len(pixels) > RECTANGULAR * width * height:
        outline = cv2.boxPoints((box_middle, (width, height), angle)).astype(np.float64)
    else:
        outline = hull[:, 0].astype(np.float64)
    area, centre = _area_and_centre(outline)
    # with the same area as the pixels
    outline = centre + (outline - centre) * np.sqrt(len(pixels) / abs(float(area)))
    extent = np.ptp(outline, axis=0)
    middle = (outline.max(axis=0) + outline.min(axis=0)) / 2
    steps = np.arange(SIZES)
    sizes = 1.0 + np.stack([steps, 2 * steps % SIZES], axis=1) / SIZES / extent
    cosine = np.cos(TURNS / extent.max())
    sine = np.sin(TURNS / extent.max())
    axes = np.moveaxis(np.array([[cosine, -sine], [sine, cosine]]), -1, 0)
    return centroid_covariance_px2(((outline - middle) * sizes[:, None, None, :]) @ axes)


def _area_and_centre(vertices: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the signed areas (...,) and centroids (..., 2) of polygons (..., n, 2), by the
    shoelace formula."""
    following = np.roll(vertices, -1, axis=-2)
    x, y = np.moveaxis(vertices, -1, 0)
    next_x, next_y = np.moveaxis(following, -1, 0)
    cross = x * next_y - y * next_x
    area = cross.sum(axis=-1) / 2
    moment = ((vertices + following) * cross[..., None]).sum(axis=-2)
    return area, moment / (6 * area[..., None])
