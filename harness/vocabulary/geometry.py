"""Units, rigid transforms, regions of pixels, lenses, and what cameras capture: frames and their
clouds.

The program computes in SI units; millimetres, inches and degrees occur only in YAML, tables and
reports.

Frames. ``camera``: x right, y down, z along the optical axis, origin at the depth lens (OpenCV's
convention), metres. ``board``: x along the row of holes, y up the face, z out of the face to the
camera, origin at the centre, metres. ``T_a_b`` maps co-ordinates in b to co-ordinates in a."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from enum import IntEnum
from functools import cached_property
from typing import Any, Literal, Protocol

import numpy as np

MM = 1e-3  # Metres in a millimetre
INCH = 25.4e-3  # Metres in an inch (exact by definition)
UW_CM2 = 1e-2  # Watts per square metre in a microwatt per square centimetre
SPEED_OF_LIGHT_VACUUM = 299_792_458.0  # m/s, exact by definition
# At 850 nm, 20 C, 101 kPa (Ciddor 1996): +-1e-5 over indoor weather, 10 um at 1 m
REFRACTIVE_INDEX_AIR = 1.00027
SPEED_OF_LIGHT_AIR = SPEED_OF_LIGHT_VACUUM / REFRACTIVE_INDEX_AIR  # m/s in indoor air


def transform_points(T_a_b: np.ndarray, points_b: np.ndarray) -> np.ndarray:
    """Map points (..., 3) from frame b to frame a with the 4x4 matrix ``T_a_b``."""
    return points_b @ T_a_b[:3, :3].T + T_a_b[:3, 3]


def rotate_vectors(T_a_b: np.ndarray, vectors_b: np.ndarray) -> np.ndarray:
    """Map directions (..., 3) from frame b to frame a (rotation only)."""
    return vectors_b @ T_a_b[:3, :3].T


def invert(T_a_b: np.ndarray) -> np.ndarray:
    """Return the inverse of a rigid 4x4 transform, ``T_b_a``."""
    T_b_a = np.eye(4)
    T_b_a[:3, :3] = T_a_b[:3, :3].T
    T_b_a[:3, 3] = -T_a_b[:3, :3].T @ T_a_b[:3, 3]
    return T_b_a


def rays_of(slopes: np.ndarray) -> np.ndarray:
    """Return the rays (..., 3) with z = 1 that have these slopes x/z and y/z (..., 2)."""
    return np.concatenate([slopes, np.ones((*slopes.shape[:-1], 1))], axis=-1)


def rotation_xyz_deg(about_x: float, about_y: float, about_z: float) -> np.ndarray:
    """Return the 3x3 rotation Rz @ Ry @ Rx for angles in degrees (about x first)."""
    ax, ay, az = np.deg2rad([about_x, about_y, about_z])
    rx = np.array([[1, 0, 0], [0, np.cos(ax), -np.sin(ax)], [0, np.sin(ax), np.cos(ax)]])
    ry = np.array([[np.cos(ay), 0, np.sin(ay)], [0, 1, 0], [-np.sin(ay), 0, np.cos(ay)]])
    return (
        np.array([[np.cos(az), -np.sin(az), 0], [np.sin(az), np.cos(az), 0], [0, 0, 1]]) @ ry @ rx
    )


@dataclass(frozen=True)
class Region:
    """A rectangle of sensor pixels: rows ``row0 <= v < row1``, columns ``col0 <= u < col1``."""

    row0: int
    row1: int
    col0: int
    col1: int

    @property
    def shape(self) -> tuple[int, int]:
        """(height, width) in pixels."""
        return self.row1 - self.row0, self.col1 - self.col0

    def grown(self, margin: int, height: int, width: int) -> Region:
        """Return the region with ``margin`` more pixels on each side, clipped to a sensor of
        ``height`` x ``width``."""
        return Region(
            row0=max(self.row0 - margin, 0),
            row1=min(self.row1 + margin, height),
            col0=max(self.col0 - margin, 0),
            col1=min(self.col1 + margin, width),
        )

    @property
    def area(self) -> int:
        """Number of pixels."""
        return (self.row1 - self.row0) * (self.col1 - self.col0)

    def joined(self, second: Region) -> Region:
        """Return the smallest region that holds both."""
        return Region(
            row0=min(self.row0, second.row0),
            row1=max(self.row1, second.row1),
            col0=min(self.col0, second.col0),
            col1=max(self.col1, second.col1),
        )

    def within(self, outer: Region) -> tuple[slice, slice]:
        """Return the slices that cut this region out of an array that covers ``outer``."""
        rows = slice(self.row0 - outer.row0, self.row1 - outer.row0)
        return rows, slice(self.col0 - outer.col0, self.col1 - outer.col0)


# Fixed-point steps of the inversion: the Azure Kinect's corners converge to 1e-9 px within 60
UNDISTORT_STEPS = 200
# Rays closer in slope are the same; where a lens's distortion folds back they differ by more
SAME_SLOPE = 1e-3


@dataclass(frozen=True)
class Lens:
    """A pinhole camera with OpenCV's rational and Brown-Conrady distortion. ``distortion`` is (k1,
    k2, p1, p2, k3, k4, k5, k6); zeros mean none. (0, 0) is the centre of the first pixel. Not
    modelled: tilted sensors, thin prisms."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, ...] = (0.0,) * 8

    @property
    def matrix(self) -> np.ndarray:
        """The 3x3 camera matrix K."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    @property
    def whole(self) -> Region:
        """The region of all pixels."""
        return Region(0, self.height, 0, self.width)

    def slopes(self, u_px: np.ndarray, v_px: np.ndarray) -> np.ndarray:
        """Return the undistorted (x/z, y/z), shape (..., 2), of rays through pixel positions
        (sub-pixel allowed)."""
        import cv2

        u, v = np.broadcast_arrays(np.asarray(u_px, float), np.asarray(v_px, float))
        if not any(self.distortion):
            return np.stack([(u - self.cx) / self.fx, (v - self.cy) / self.fy], axis=-1)
        pixels = np.stack([u.ravel(), v.ravel()], axis=-1)[:, None, :]
        stop = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, UNDISTORT_STEPS, 1e-10)
        return cv2.undistortPoints(
            pixels, self.matrix, np.array(self.distortion), criteria=stop
        ).reshape(*u.shape, 2)

    def region_slopes(self, region: Region, shift_px: float = 0.0) -> np.ndarray:
        """Return (x/z, y/z) through the pixel centres of a region, shape (h, w, 2), or
        ``shift_px`` beside and below them; do not write to it. Slopes are kept, as the boards of a
        study lie in nearly one place."""
        kept_region, slopes = _slopes.pop((self, shift_px), (region, None))
        joint = kept_region.joined(region)
        if slopes is None or joint != kept_region:
            joint = joint.grown(SPARE_PX, self.height + 1, self.width + 1)
            kept_region = (
                joint
                if slopes is not None and joint.area <= 2 * (kept_region.area + region.area)
                else region
            )
            v, u = (
                np.mgrid[kept_region.row0 : kept_region.row1, kept_region.col0 : kept_region.col1]
                + shift_px
            )
            slopes = self.slopes(u, v)
        _slopes[self, shift_px] = kept_region, slopes
        if len(_slopes) > MOST_LENSES:
            _slopes.pop(next(iter(_slopes)))
        return np.ascontiguousarray(slopes[region.within(kept_region)])

    def project(self, points_camera_m: np.ndarray) -> np.ndarray:
        """Return the pixel positions (u, v), shape (..., 2), of points (..., 3) in front of the
        camera (z > 0)."""
        import cv2

        flat = np.ascontiguousarray(points_camera_m.reshape(-1, 3), dtype=float)
        pixels, _ = cv2.projectPoints(
            flat, np.zeros(3), np.zeros(3), self.matrix, np.array(self.distortion)
        )
        return pixels.reshape(*points_camera_m.shape[:-1], 2)

    def images(self, points_camera_m: np.ndarray) -> np.ndarray:
        """Return which points (..., 3) have an image, (...) bool: in front, and on the ray of
        their own pixel."""
        ahead = points_camera_m[..., 2] > 0
        points = np.where(ahead[..., None], points_camera_m, [0.0, 0.0, 1.0])
        u, v = np.moveaxis(self.project(points), -1, 0)
        is_seen = ahead & (u >= 0) & (u <= self.width - 1) & (v >= 0) & (v <= self.height - 1)
        back = (
            self.slopes(np.where(is_seen, u, 0.0), np.where(is_seen, v, 0.0))
            - points[..., :2] / points[..., 2:]
        )
        return np.asarray(is_seen & (np.abs(back).max(axis=-1) < SAME_SLOPE))


@dataclass(frozen=True)
class OtherLens(Lens):
    """A lens that was not calibrated for the images at hand. ``note`` and ``warning`` are remarks
    on it, "" for none. A camera's nominal lens has three more: ``mode`` is the name of its depth
    mode, ``unit_m`` the metres per stored number in that mode, and ``others`` the lenses of the
    same camera's other modes."""

    note: str = ""
    warning: str = ""
    mode: str = ""
    unit_m: float | None = None
    others: tuple[OtherLens, ...] = ()

    @property
    def plain(self) -> Lens:
        """The lens without these remarks."""
        return Lens(self.width, self.height, self.fx, self.fy, self.cx, self.cy, self.distortion)


_slopes: dict[
    tuple[Lens, float], tuple[Region, np.ndarray]
] = {}  # of regions, the last used at the end
# a region of 640 x 576 pixels takes 6 MB and 0.3 s; margin of a region for several views
MOST_LENSES = 6
SPARE_PX = 16


class Reason(IntEnum):
    """The reason why a pixel has no range. A recording gives only NO_RETURN or NOT_FINITE, a
    simulated camera all."""

    VALID = 0
    NO_RETURN = 1  # the file holds the code for "no depth" (0), or the ray met nothing
    SATURATED = 2
    LOW_AMPLITUDE = 3
    AMPLITUDE_RATIO = 4  # the amplitudes of the modulation frequencies disagree (a mixed pixel)
    UNWRAP = 5  # the phases of the modulation frequencies fit no single distance
    EDGE = 6  # the neighbourhood's phases differ too much
    OUT_OF_RANGE = 7
    OUTSIDE_MASK = 8  # outside the illuminated field
    LOW_REFLECTIVITY = 9  # amplitude times distance squared too small
    NOT_FINITE = 10


@dataclass(frozen=True)
class Frame:
    """One exposure. ``z_m`` (h, w) float32 is the distance along the optical axis, NaN where
    invalid. ``reason`` (h, w) uint8 holds `Reason`. ``xy_m`` (h, w, 2) is given only if the source
    has no lens (a stored point cloud); ``rgb`` (h, w, 3) uint8 and ``amplitude`` (h, w) float32 if
    known. ``time_s`` is the camera's clock, if known. ``notes`` say how stored numbers were
    interpreted."""

    name: str
    z_m: np.ndarray
    reason: np.ndarray
    xy_m: np.ndarray | None = None
    rgb: np.ndarray | None = None
    amplitude: np.ndarray | None = None
    notes: tuple[str, ...] = ()
    time_s: float | None = None


class FrameSource(Protocol):
    """A source of frames: a simulated camera or a recording. Frames are streamed, never all in
    memory. ``slopes`` (h, w, 2) are x/z and y/z per pixel, None if each frame carries ``xy_m``.
    ``organised`` is False for a cloud without a pixel grid (then h == 1). ``z_step_m`` is the
    rounding step of the stored distance (0 if none)."""

    @property
    def name(self) -> str: ...
    @property
    def region(self) -> Region: ...
    @property
    def lens(self) -> Lens | None: ...
    @property
    def slopes(self) -> np.ndarray | None: ...
    @property
    def organised(self) -> bool: ...
    @property
    def z_step_m(self) -> float: ...
    def frames(self) -> Iterator[Frame]:
        """Yield the frames in order; each call starts again from the first."""
        ...


@dataclass(frozen=True)
class LeftOut:
    """A frame that the average excludes, and the reason."""

    name: str
    why: str


@dataclass(frozen=True)
class MapViews:
    """The views that a map was made from. ``T_cloud_cameras`` (k, 4, 4) map their camera frames to
    the map's frame. ``shares`` (k,) are their weights, which sum to 1. ``pixel_m`` are a pixel's
    sides in x and y on the surface."""

    T_cloud_cameras: np.ndarray
    shares: np.ndarray
    pixel_m: tuple[float, float]


@dataclass(frozen=True, eq=False)
class ExpectedSurface:
    """The surface that a reference (an earlier capture, good parts, a drawing) says a cloud shows,
    along its own rays. The functions take points (n, 3) of the cloud's frame, metres, and return
    (n,), NaN where the reference shows nothing."""

    text: str
    """The reference and how well it fits, in words."""
    z_at: Callable[[np.ndarray], np.ndarray]
    """z at which the points' rays meet the reference, metres."""
    spread_at: Callable[[np.ndarray], np.ndarray]
    """Standard deviation of that z: noise of the reference, and how parts differ there, metres."""
    registration_at: Callable[[np.ndarray], np.ndarray]
    """Standard deviation of that z by the placement, which neighbours share, metres."""
    facts: dict[str, Any] = field(default_factory=dict)
    """Plain data on the placement."""


@dataclass(frozen=True)
class Cloud:
    """The average of frames as points in the camera's frame: the input of a detector. ``points_m``
    (h, w, 3) float64 is NaN where invalid. ``reason`` (h, w) uint8 holds `Reason` (the most
    frequent one, if no sample was valid). ``count`` (h, w) is the number of valid samples,
    ``variance_m2`` (h, w) the sample variance of one frame's z, NaN below two samples. An
    unorganised cloud has h == 1 and ``organised`` False. ``region`` places the grid on the sensor;
    ``z_step_m`` is the rounding step of one frame's z. ``projection`` is "central" for rays
    through the origin (a camera) and "parallel" for equal cells in x and y. A map of several views
    is such a cloud, in a frame with z away from the viewer. ``mean_variance_m2`` (h, w), if
    stated, is the variance of each averaged z with its systematic parts. ``noise_reach_px`` is the
    side of the square over which noise is blurred; 0 means unknown. ``noise_sides_px`` (2, r, c)
    are the sides, along rows and along columns, of the rectangle in r x c equal parts of the grid;
    None means that they are not known to differ. ``edge_reach_px`` is how far the camera's beam and
    filters mix what lies beyond an edge into the pixels inside, as its model states; 0 means
    unknown. ``expected`` is what a reference says that it should show, if there is one."""

    points_m: np.ndarray
    reason: np.ndarray
    count: np.ndarray
    variance_m2: np.ndarray
    region: Region
    z_step_m: float
    n_frames: int
    organised: bool = True
    lens: Lens | None = None
    rgb: np.ndarray | None = None
    amplitude: np.ndarray | None = None
    left_out: tuple[LeftOut, ...] = field(default=())
    projection: Literal["central", "parallel"] = "central"
    mean_variance_m2: np.ndarray | None = None
    map_views: MapViews | None = None
    noise_reach_px: float = 0.0
    noise_sides_px: np.ndarray | None = None
    edge_reach_px: float = 0.0
    expected: ExpectedSurface | None = None

    @cached_property
    def crops(self) -> dict[Any, Any]:
        """Its automatic crops by their settings: several detectors share them."""
        return {}

    @cached_property
    def surfaces(self) -> dict[Any, Any]:
        """Its fitted surfaces by mask and settings: several detectors share them."""
        return {}

    @cached_property
    def marks(self) -> dict[Any, Any]:
        """Objects and print on it by what is judged: several detectors share them."""
        return {}

    @cached_property
    def gaps(self) -> dict[Any, Any]:
        """Its pixels without a return by what is judged: several detectors share them."""
        return {}

    @property
    def valid(self) -> np.ndarray:
        """The pixels that have a point, (h, w) bool."""
        return np.isfinite(self.points_m[..., 2])
