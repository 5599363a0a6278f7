"""Finds and judges the marks of one view: coloured spots, or codes (OpenCV's); unreliable marks
are in doubt.

The slope of a mark's plane is fitted to the mark and its surroundings, but the offset only to the
mark, because a mark may be thick or have a range error of its own. Its centroid is the mean of the
points where the pixels' rays meet this plane, weighted by the surface that they cover and by their
colour. Spots behind the surface are holes. Not modelled: a surface or tag that bends within the
mark; a lens whose distortion is more than quadratic over one tag."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from detectors.averages.average import CORRELATED_PIXELS
from detectors.pixels.noise import median_of, sigma_of
from detectors.surfaces.surface import SurfaceConfig, fit_surface
from detectors.views.marks.blobs import (
    Blob,
    above_half,
    chromaticity,
    find_blobs,
    lightness,
    stand_out,
)
from detectors.views.marks.mark import (
    LEAST_MARKS,
    CodedMarks,
    ColourMarks,
    Mark,
    MarkSet,
    RedMarks,
    problem_of,
)
from harness.vocabulary.errors import UserError
from harness.vocabulary.geometry import MM, Cloud

PATCH_POINTS = 512
LEAST_SCALE_M = 1e-6


@dataclass(frozen=True)
class Patch:
    """The plane z = ``slope_x`` x + ``slope_y`` y + ``offset_m`` through points of a cloud."""

    slope_x: float
    """Change of z along x."""
    slope_y: float
    """Change of z along y."""
    offset_m: float
    """z at x = y = 0."""
    sigma_m: float
    """Standard deviation of one point's z about the plane."""

    @property
    def normal(self) -> np.ndarray:
        """Return the unit normal (3,) towards the camera (z points away from the camera)."""
        steep = np.array([self.slope_x, self.slope_y, -1.0])
        return np.asarray(steep / np.linalg.norm(steep))

    def above_m(self, points_m: np.ndarray) -> np.ndarray:
        """Return z of points (n, 3) minus the plane's z: positive behind it."""
        x, y, z = points_m.T
        return np.asarray(z - self.slope_x * x - self.slope_y * y - self.offset_m)

    def cut(self, points_m: np.ndarray, projection: str) -> np.ndarray:
        """Return the places (n, 3) at which the rays of points (n, 3) meet the plane."""
        x, y, z = points_m.T
        if projection == "parallel":
            return np.stack([x, y, z - self.above_m(points_m)], axis=1)
        scale = self.offset_m / (z - self.slope_x * x - self.slope_y * y)
        return np.asarray(points_m * scale[:, None])

    def range_covariance_m2(
        self,
        centre_m: np.ndarray,
        cloud: Cloud,
        pixels: np.ndarray,
    ) -> np.ndarray:
        """Return the covariance (3, 3) of a centre (3,) on the plane from its pixels' mean z (n,):
        from the largest of scatter about the plane, the frames' noise and a map's variance;
        `CORRELATED_PIXELS` share it."""
        frames = cloud.variance_m2.ravel()[pixels] / np.maximum(cloud.count.ravel()[pixels], 1)
        finite = frames[np.isfinite(frames)]
        variance = max(self.sigma_m**2, float(finite.mean()) if len(finite) else 0.0)
        if cloud.mean_variance_m2 is not None:
            stated = cloud.mean_variance_m2.ravel()[pixels]
            if np.isfinite(stated).any():
                variance = max(variance, float(np.nanmean(stated)))
        ray = np.array([0.0, 0.0, 1.0])
        if cloud.projection == "central":
            ray = centre_m / centre_m[2]
        # if the plane is shifted along z by d, a ray meets it d n_z / n.ray farther along
        along = ray * self.normal[2] / (self.normal @ ray)
        share = min(1.0, CORRELATED_PIXELS / len(pixels))
        return np.asarray(variance * share * np.outer(along, along))


@dataclass(frozen=True)
class Spot:
    """A blob's place in space, camera frame."""

    blob: Blob
    """Its pixels."""
    centre_m: np.ndarray
    """(3,): its centroid on the surface."""
    covariance_m2: np.ndarray
    """(3, 3): of the centroid."""
    normal: np.ndarray
    """(3,): of the surface, towards the camera."""
    area_m2: float
    """Area on the surface."""
    sizes_m: np.ndarray
    """(3,): sides of the rectangle with its second moments, longer first, and the mean breadth
    over the length, which gaps reduce."""
    pitch_m: float
    """Distance between pixels."""
    behind_m: float
    """Its distance behind its surroundings."""
    behind_sigma_m: float
    """Standard deviation of that distance."""

    @property
    def is_hole(self) -> bool:
        """True where the spot lies behind the surface."""
        return self.behind_m > max(BEHIND_M, BEHIND_SIGMAS * self.behind_sigma_m)


def fit_patch(points_m: np.ndarray) -> Patch | None:
    """Fit the plane of at least two thirds of points (n, 3); None if they are too few or lie on a
    line."""
    x, y, z = points_m[:: max(1, len(points_m) // PATCH_POINTS)].T
    try:
        plane = fit_surface(x, y, z, SurfaceConfig(degree=1))
    except UserError:
        return None
    level, at_x, at_y = plane.evaluate(
        np.array([0.0, 1.0, 0.0]), np.array([0.0, 0.0, 1.0])
    ).tolist()
    # points off the plane on only one side have shifted it, but not rotated it
    off = z - plane.evaluate(x, y)
    centred = off - median_of(off)
    off = off[np.abs(centred) <= 3.0 * max(sigma_of(centred), LEAST_SCALE_M)]
    return Patch(
        slope_x=at_x - level,
        slope_y=at_y - level,
        offset_m=level + float(off.mean()),
        sigma_m=max(float(off.std()), LEAST_SCALE_M),
    )


def place_spot(
    cloud: Cloud,
    blob: Blob,
    patch: Patch,
) -> Spot:
    """Return the place of a blob whose surroundings lie on a plane."""
    pixels = blob.pixels
    weights = blob.weights
    points = cloud.points_m.reshape(-1, 3)[pixels]
    core = weights > 0.5
    # the mean height of those points within four scales of the median
    height = patch.above_m(points[core])
    middle = median_of(height)
    scale = max(sigma_of(height - middle), LEAST_SCALE_M)
    kept = height[np.abs(height - middle) <= 4.0 * scale]
    behind = float(kept.mean())
    sigma = float(max(kept.std(), scale))
    settled = replace(patch, offset_m=patch.offset_m + behind, sigma_m=sigma)
    on_plane = settled.cut(points, cloud.projection)
    covers = weights
    if cloud.projection == "central":
        covers = weights * on_plane[:, 2] ** 3
    centre = np.average(on_plane, axis=0, weights=covers)
    grid = blob.grid - blob.grid.mean(axis=0)
    jacobian = np.linalg.lstsq(grid, on_plane - centre, rcond=None)[0].T
    by_range = settled.range_covariance_m2(centre, cloud, pixels[core])
    covariance = by_range + jacobian @ blob.grid_covariance @ jacobian.T
    scatter = np.cov((on_plane - centre).T, aweights=covers, ddof=0)
    _, minor, major = np.sqrt(12.0 * np.maximum(np.linalg.eigvalsh(scatter), 0.0))
    pixel_area = float(np.linalg.norm(np.cross(jacobian[:, 0], jacobian[:, 1])))
    # the scatter of a flat mark: the different depths in a hole must not hide that it is a hole
    behind_sigma = patch.sigma_m * float(np.sqrt(2.0 * min(1.0, CORRELATED_PIXELS / len(pixels))))
    area = pixel_area * float(weights.sum())
    return Spot(
        blob=blob,
        centre_m=centre,
        covariance_m2=(covariance + covariance.T) / 2,
        normal=settled.normal,
        area_m2=area,
        sizes_m=np.array([major, minor, area / major]),
        pitch_m=float(np.sqrt(pixel_area)),
        behind_m=behind,
        behind_sigma_m=behind_sigma,
    )


CORNER_PX = 0.25
"""Standard deviation of a refined corner per axis: 0.18 on drawn sharp tags of 40 pixels, 0.34
with a blur of 1.5."""
LEAST_SEEN = 0.5
WHOLE = 0.95
"""Least share of a tag's pixels on the target for a tag of the target, and for a tag without
doubt."""
HALF_STEPS = np.array([[0.5, 0.0], [-0.5, 0.0], [0.0, 0.5], [0.0, -0.5]])


def coded_marks(
    cloud: Cloud,
    inside: np.ndarray,
    dictionary: str,
) -> MarkSet:
    """Find the tags of a cv2.aruco ``dictionary`` on the target, each with its code; two of one
    code are in doubt."""
    assert cloud.rgb is not None
    grey = cv2.cvtColor(np.ascontiguousarray(cloud.rgb), cv2.COLOR_RGB2GRAY)
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    dictionary_words = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, dictionary))
    corners_px, ids, _ = cv2.aruco.ArucoDetector(dictionary_words, parameters).detectMarkers(grey)
    codes = [] if ids is None else [int(code) for code in ids.ravel()]
    # corners (4, 2) in pixels of the grid, the centre of the first being (0, 0)
    tags = [
        (code, tag.reshape(4, 2).astype(float)) for code, tag in zip(codes, corners_px, strict=True)
    ]
    tags.sort(key=lambda tag: (tag[0], tag[1].tolist()))
    candidates = [
        _coded_mark(cloud, inside, code, corners, codes.count(code) > 1) for code, corners in tags
    ]
    marks = tuple(mark for mark in candidates if mark is not None)
    off = len(candidates) - len(marks)
    pixels = _pixels_of(marks)
    notes = (f"{off} tags lie off the target, or have no range",) if off else ()
    return MarkSet(marks, pixels, problem_of(marks, f"searched for tags of {dictionary}"), notes)


def _coded_mark(
    cloud: Cloud,
    inside: np.ndarray,
    code: int,
    corners: np.ndarray,
    twice: bool,
) -> Mark | None:
    """Return the tag as a mark; None if it lies off the target or has no range."""
    area = np.zeros(inside.shape, dtype=np.uint8)
    cv2.fillConvexPoly(area, np.rint(corners).astype(np.int32), 1)
    pixels = np.flatnonzero((area > 0) & inside)
    points = cloud.points_m.reshape(-1, 3)[pixels]
    patch = fit_patch(points) if len(pixels) >= LEAST_SEEN * area.sum() else None
    if patch is None:
        return None
    grid = np.stack([pixels % inside.shape[1], pixels // inside.shape[1]], axis=1).astype(float)
    middle = grid.mean(axis=0)
    half = max(float(np.ptp(grid, axis=0).max()) / 2, 1.0)
    rays = points[:, :2] / points[:, 2:] if cloud.projection == "central" else points[:, :2]
    coefficients = np.linalg.lstsq(_quadratic((grid - middle) / half), rays, rcond=1e-10)[0]
    wanted = np.concatenate([corners, corners.mean(axis=0) + HALF_STEPS])
    fitted = _quadratic((wanted - middle) / half) @ coefficients
    on_plane = patch.cut(np.column_stack([fitted, np.ones(len(fitted))]), cloud.projection)
    corner_places = on_plane[:4]
    steps = np.stack([on_plane[4] - on_plane[5], on_plane[6] - on_plane[7]], axis=1)
    centre = corner_places.mean(axis=0)
    by_corners = steps @ steps.T * CORNER_PX**2 / 4
    covariance = by_corners + patch.range_covariance_m2(centre, cloud, pixels)
    coverage = len(pixels) / int(area.sum())
    without = 1.0 - cloud.valid[area > 0].mean()
    doubt = ""
    if twice:
        doubt = f"code {code} is seen more than once"
    elif coverage < WHOLE and without > 1.0 - WHOLE:
        doubt = f"{100 * without:.0f} % of it has no range"
    elif coverage < WHOLE:
        doubt = f"{100 * (1 - coverage):.0f} % of it is beyond the crop's edge"
    first_diagonal = corner_places[2] - corner_places[0]
    second_diagonal = corner_places[3] - corner_places[1]
    return Mark(
        centre_m=centre,
        covariance_m2=(covariance + covariance.T) / 2,
        normal=patch.normal,
        pixels=pixels,
        area_m2=float(np.linalg.norm(np.cross(first_diagonal, second_diagonal))) / 2,
        code=code,
        doubt=doubt,
    )


def _quadratic(uv: np.ndarray) -> np.ndarray:
    u, v = uv.T
    return np.stack([np.ones_like(u), u, v, u * u, u * v, v * v], axis=1)


CLEAR_MARGIN = 2.0
"""If the marks' pixels exceed the threshold by this factor, their outlines are whole; else
lightness is tried."""
LEAST_TARGET = 100
BEHIND_M = 2.0 * MM
"""A mark may seem to lie this far behind its surroundings: cameras range dark and bright surfaces
differently."""
BEHIND_SIGMAS = 5.0
RAISED_SHARE = 0.25
"""Largest height of a mark above its surroundings, as a share of its breadth: allows a tag on
board, no object."""
SAME_COLOUR = 0.35
"""Two spots have the same colour if their contrasts to their surroundings differ by less than this
share of them."""
WEAK_SHARE = 1 / 3
"""Share of the strongest colour's contrast to its surroundings; beside such marks, weaker spots
are stains."""
UNLIKE_SHARE = 0.3
UNLIKE_PIXELS = 1.5
"""A mark is unlike the others if its sizes differ from their median by more than this share and
this many pixels."""
# share of the target; a larger spot is a part of the target with another colour
LARGEST_SHARE = 0.15


def find_marks(
    cloud: Cloud,
    inside: np.ndarray,
    config: RedMarks | ColourMarks | CodedMarks,
) -> MarkSet:
    """Find the marks among the pixels ``inside`` (h, w) bool of a cloud with colour. It raises for
    no picture; a set that cannot support a registration says so in its ``problem``."""
    none = MarkSet((), np.zeros(0, dtype=np.int64))
    if cloud.rgb is None:
        return replace(none, problem="the capture has no colour, which is needed to find marks")
    if int(inside.sum()) < LEAST_TARGET:
        return replace(
            none, problem=f"{int(inside.sum())} pixels of the target, too few to know its colour"
        )
    if not cloud.organised and not isinstance(config, RedMarks):
        return replace(
            none, problem="marks are found in a picture, and this cloud has no pixel grid"
        )
    if isinstance(config, CodedMarks):
        return coded_marks(cloud, inside, config.dictionary)
    if isinstance(config, RedMarks):
        # the rule of the thesis, with MATLAB's standard deviation (n - 1)
        red = cloud.rgb[inside][:, 0].astype(np.float64)
        mean = red.mean()
        spread = red.std(ddof=1)
        limit = mean + config.deviations * spread
        coloured = np.zeros(inside.shape, dtype=bool)
        coloured[inside] = red > limit
        if not cloud.organised:
            problem = "marks need a pixel grid, which this cloud does not have"
            return MarkSet((), np.flatnonzero(coloured), problem)
        missing = ""
        if not coloured.any():
            missing = (
                f"no pixel's red exceeds {limit:.0f}, the target's mean {mean:.0f} and "
                f"{config.deviations:g} standard deviations of {spread:.0f}"
            )
        return _marks(cloud, inside, coloured, missing)
    # lightness is tried if chromaticity gives too few marks or hardly any contrast: black and
    # white have the light's chromaticity, and black hardly any
    marks, margin = _standing_out(cloud, inside, chromaticity)
    enough = len(marks.trusted) >= LEAST_MARKS
    if enough and margin >= CLEAR_MARGIN:
        return marks
    lighter, lighter_margin = _standing_out(cloud, inside, lightness)
    if len(lighter.trusted) < LEAST_MARKS or (enough and margin >= lighter_margin):
        return marks
    return replace(lighter, notes=(*lighter.notes, "the marks were found by their lightness"))


def _standing_out(
    cloud: Cloud,
    inside: np.ndarray,
    feature: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]],
) -> tuple[MarkSet, float]:
    """Find the marks by one feature of the colours; return them and the median margin of the
    trusted marks' pixels."""
    assert cloud.rgb is not None
    contrast = np.zeros(inside.shape)
    margin = np.zeros(inside.shape)
    values, rounding = feature(cloud.rgb[inside])
    xy = cloud.points_m[inside][:, :2]
    contrast[inside], margin[inside] = stand_out(values, rounding, xy)
    coloured = above_half(margin > 1.0, contrast)
    marks = _marks(cloud, inside, coloured, "no other spots stand apart from the target's colour")
    pixels = [mark.pixels for mark in marks.trusted]
    median = 0.0
    if pixels:
        median = float(np.median(margin.ravel()[np.concatenate(pixels)]))
    # a hole through which another colour shows is not a fiducial
    return replace(marks, points=_pixels_of(marks.marks)), median


def _pixels_of(marks: Sequence[Mark]) -> np.ndarray:
    """Return the flat indices of all pixels of the marks, rising."""
    pixels = [mark.pixels for mark in marks]
    return np.unique(np.concatenate([np.zeros(0, np.int64), *pixels]))


def _marks(
    cloud: Cloud,
    inside: np.ndarray,
    coloured: np.ndarray,
    missing: str,
) -> MarkSet:
    """Return the marks among coloured pixels, in the order of their pixels; ``missing`` says why
    there are not more."""
    points_m = cloud.points_m.reshape(-1, 3)
    n_target = int(inside.sum())
    blobs = find_blobs(cloud, inside, coloured)
    patches = [fit_patch(points_m[blob.surroundings]) for blob in blobs]
    spots = [
        place_spot(cloud, blob, patch)
        for blob, patch in zip(blobs, patches, strict=True)
        if patch is not None
    ]
    # groups of one colour: each spot is compared with the first spot of a group
    colours: list[list[Spot]] = []
    for spot in sorted(spots, key=lambda s: (-s.area_m2, int(s.blob.pixels[0]))):
        for group in colours:
            contrast = group[0].blob.contrast
            difference = np.linalg.norm(spot.blob.contrast - contrast)
            if difference < SAME_COLOUR * np.linalg.norm(contrast):
                group.append(spot)
                break
        else:
            colours.append([spot])
    groups = []
    for colour in colours:
        # if most of a colour's area lies behind, its flat-looking spots are holes too small to
        # look deep
        flat = [spot for spot in colour if not spot.is_hole]
        hole_area = sum(spot.area_m2 for spot in colour if spot.is_hole)
        if not flat or 2.0 * hole_area > sum(spot.area_m2 for spot in colour):
            continue
        complete = [spot for spot in flat if not spot.blob.doubt]
        usual_m = None
        if len(complete) >= 3:
            # half of the spots' area is in larger spots, so that chips count little
            sizes = np.array([spot.sizes_m for spot in complete])
            areas = [spot.area_m2 for spot in complete]
            usual_m = np.quantile(sizes, 0.5, axis=0, weights=areas, method="inverted_cdf")
        vivid = float(np.linalg.norm(flat[0].blob.contrast))
        groups.append((vivid, [_mark(spot, usual_m, n_target) for spot in flat]))
    enough = []
    for vivid, colour_marks in groups:
        if sum(not mark.doubt for mark in colour_marks) >= LEAST_MARKS:
            enough.append(vivid)
    marks = []
    for vivid, colour_marks in groups:
        doubt = ""
        if vivid < WEAK_SHARE * max(enough, default=0.0):
            doubt = "its colour contrast is weak compared with the others"
        elif enough and sum(not mark.doubt for mark in colour_marks) < LEAST_MARKS:
            doubt = f"fewer than {LEAST_MARKS} marks have its colour; enough have another"
        marks += [replace(mark, doubt=mark.doubt or doubt) for mark in colour_marks]
    marks.sort(key=lambda mark: int(mark.pixels[0]))
    holes = len(spots) - len(marks)
    notes = tuple[str, ...]()
    if holes:
        notes = (
            (
                f"{holes} spots of another colour lie behind the surface and count as holes, "
                "not marks"
            ),
        )
    return MarkSet(tuple(marks), np.flatnonzero(coloured), problem_of(marks, missing), notes)


def _mark(
    spot: Spot,
    usual_m: np.ndarray | None,
    n_target: int,
) -> Mark:
    """Return the spot as a mark, with its doubt. ``usual_m`` (3,): usual sizes. ``n_target``: the
    target's pixels."""
    doubt = spot.blob.doubt
    sizes_m = spot.sizes_m
    pixels = spot.blob.pixels[spot.blob.weights > 0.5]
    share = len(pixels) / n_target
    if doubt:
        pass
    elif share > LARGEST_SHARE:
        doubt = f"{100 * share:.0f} % of the target: a part of it rather than a mark"
    elif -spot.behind_m > max(RAISED_SHARE * sizes_m[1], BEHIND_SIGMAS * spot.behind_sigma_m):
        doubt = f"it stands {-spot.behind_m / MM:.0f} mm in front of the surface"
    elif usual_m is not None:
        tolerance = UNLIKE_SHARE * usual_m + UNLIKE_PIXELS * spot.pitch_m
        if (np.abs(sizes_m - usual_m) > tolerance).any():
            length, breadth, _ = sizes_m / MM
            usual_length, usual_breadth, _ = usual_m / MM
            doubt = (
                f"unlike the others: {length:.0f} x {breadth:.0f} mm, not {usual_length:.0f} x "
                f"{usual_breadth:.0f}"
            )
    return Mark(
        centre_m=spot.centre_m,
        covariance_m2=spot.covariance_m2,
        normal=spot.normal,
        pixels=pixels,
        area_m2=spot.area_m2,
        doubt=doubt,
    )
