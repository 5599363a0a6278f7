"""The lens: from pixels to directions and back, with distortion."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from harness.vocabulary.geometry import Region

UNDISTORT_STEPS = 200
"""Fixed-point steps of the inversion: the Azure Kinect's corners converge to 1e-9 px within 60."""


@dataclass(frozen=True)
class Lens:
    """A central camera: pinhole with OpenCV's rational and Brown-Conrady distortion.

    ``distortion`` is (k1, k2, p1, p2, k3, k4, k5, k6); zeros mean none. Pixel (0, 0) is the centre of the first pixel.
    Not modelled: tilted sensors, thin-prism terms, anything that is not a single centre of projection.
    """

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
        """Undistorted (x/z, y/z), shape (..., 2), of the rays through pixel positions (sub-pixel allowed)."""
        u, v = np.broadcast_arrays(np.asarray(u_px, float), np.asarray(v_px, float))
        if not any(self.distortion):
            return np.stack([(u - self.cx) / self.fx, (v - self.cy) / self.fy], axis=-1)
        pixels = np.stack([u.ravel(), v.ravel()], axis=-1)[:, None, :]
        stop = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, UNDISTORT_STEPS, 1e-10)
        flat = cv2.undistortPoints(pixels, self.matrix, np.array(self.distortion), criteria=stop)
        return flat.reshape(*u.shape, 2)

    def region_slopes(self, region: Region) -> np.ndarray:
        """(x/z, y/z) through the pixel centres of a region, shape (h, w, 2)."""
        v, u = np.mgrid[region.row0 : region.row1, region.col0 : region.col1]
        return self.slopes(u, v)

    def project(self, points_camera_m: np.ndarray) -> np.ndarray:
        """Pixel positions (u, v), shape (..., 2), of points (..., 3) in front of the camera (z > 0)."""
        flat = np.ascontiguousarray(points_camera_m.reshape(-1, 3), dtype=float)
        pixels, _ = cv2.projectPoints(flat, np.zeros(3), np.zeros(3), self.matrix, np.array(self.distortion))
        return pixels.reshape(*points_camera_m.shape[:-1], 2)


@dataclass(frozen=True)
class OtherLens(Lens):
    """A lens that was not measured for the images themselves, with what to say of it.

    ``note`` and ``warning``: sentences, "" for none. ``mode``: of a camera's nominal lens, its depth mode by name;
    ``unit_m``: metres in a stored number there. ``others``: the lenses of the same camera's other modes.
    """

    note: str = ""
    warning: str = ""
    mode: str = ""
    unit_m: float | None = None
    others: tuple[OtherLens, ...] = ()

    @property
    def plain(self) -> Lens:
        """The lens alone."""
        return Lens(self.width, self.height, self.fx, self.fy, self.cx, self.cy, self.distortion)
