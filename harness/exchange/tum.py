"""The layout of the TUM RGB-D benchmark (Sturm et al., IROS 2012), all views as one sequence.

``rgb/`` and ``depth/`` hold PNGs named by their time; ``rgb.txt``, ``depth.txt``, ``associations.txt`` and
``groundtruth.txt`` are the benchmark's. For RTAB-Map's ``rtabmap-rgbd_dataset`` there are ``rgb_sync`` and
``depth_sync`` (links to the two folders: colour and depth are of one instant) and ``rtabmap_calib.yaml``, the camera
that the program loads for a sequence whose name is none of the benchmark's own (it complains about the name first).

Readers of this layout take images for those of a pinhole, RTAB-Map's included (it does not rectify there), so images
are undistorted to a pinhole with the lens' own focal lengths and centre, each pixel taken from the nearest one: no two
ranges are mixed and the camera's noise stays as it is, but a pixel's direction is wrong by up to half a pixel (0.29
pixels rms in each direction), the same in all frames. Depth is rounded to 0.2 mm, which cameras with steps of 1 mm do
not notice.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from harness.exchange.views import ExportedView, quaternion_of
from harness.vocabulary.errors import UserError
from harness.vocabulary.lens import Lens

UNITS_PER_M = 5000
"""The benchmark's depth scale."""
FARTHEST_M = (2**16 - 1) / UNITS_PER_M
CALIBRATION = "rtabmap_calib.yaml"
OPTICAL_ROTATION = np.array([[0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0]])
"""(3, 4): RTAB-Map's base (x forward, z up) from the camera's optical frame (z forward, y down)."""


def write_tum(folder: Path, views: Sequence[ExportedView]) -> None:
    """Write a sequence of all views into an empty folder. Raises UserError where two views have different lenses."""
    lens = views[0].lens
    if any(view.lens != lens for view in views):
        raise UserError("the TUM RGB-D layout has one lens for all frames, and these views have several")
    for name in ("rgb", "depth"):
        (folder / name).mkdir()
        (folder / f"{name}_sync").symlink_to(name, target_is_directory=True)
    rows, columns, inside = nearest_pixels(lens)
    lines: dict[str, list[str]] = {
        "rgb.txt": ["# color images", "# timestamp filename"],
        "depth.txt": ["# depth maps, 5000 to the metre, 0: none", "# timestamp filename"],
        "groundtruth.txt": ["# camera in the board's frame", "# timestamp tx ty tz qx qy qz qw"],
        "associations.txt": [],
    }
    for view in views:
        pose = (*view.T_board_camera[:3, 3], *quaternion_of(view.T_board_camera))
        place = " ".join(f"{value:.9g}" for value in pose)
        for exposure in view.exposures():
            depth = np.where(inside, depth_units(exposure.z_m)[rows, columns], 0).astype(np.uint16)
            colour = np.where(inside[..., None], exposure.rgb[rows, columns], 0).astype(np.uint8)
            time = seconds_text(exposure.stamp_ns)
            for name, picture in (("rgb", colour[..., ::-1]), ("depth", depth)):
                coded, content = cv2.imencode(".png", np.ascontiguousarray(picture))
                assert coded
                (folder / name / f"{time}.png").write_bytes(content.tobytes())
                lines[f"{name}.txt"].append(f"{time} {name}/{time}.png")
            lines["associations.txt"].append(f"{time} rgb/{time}.png {time} depth/{time}.png")
            lines["groundtruth.txt"].append(f"{time} {place}")
    for name, text in lines.items():
        (folder / name).write_text("\n".join((*text, "")), encoding="utf-8")
    (folder / CALIBRATION).write_text(calibration_text(lens), encoding="utf-8")


def depth_units(z_m: np.ndarray) -> np.ndarray:
    """Return (h, w) uint16 in 0.2 mm; 0 where there is no range or it lies beyond the 13.1 m that 16 bits hold."""
    with np.errstate(invalid="ignore"):
        held = (z_m > 0) & (z_m <= FARTHEST_M)
    return np.rint(np.where(held, z_m, 0.0).astype(np.float64) * UNITS_PER_M).astype(np.uint16)


def nearest_pixels(lens: Lens) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the nearest row and column of the lens' own image for each pixel of the pinhole image (both (h, w) int),
    and whether that pixel exists (bool)."""
    matrix, size = lens.matrix, (lens.width, lens.height)
    u, v = cv2.initUndistortRectifyMap(matrix, np.array(lens.distortion), np.eye(3), matrix, size, cv2.CV_32FC1)
    columns, rows = np.rint(u).astype(int), np.rint(v).astype(int)
    inside = (columns >= 0) & (columns < lens.width) & (rows >= 0) & (rows < lens.height)
    return np.where(inside, rows, 0), np.where(inside, columns, 0), inside


def seconds_text(stamp_ns: int) -> str:
    """Return a time as the benchmark writes it: seconds with six digits, exact to the microsecond."""
    microseconds = (stamp_ns + 500) // 1000
    return f"{microseconds // 10**6}.{microseconds % 10**6:06d}"


def calibration_text(lens: Lens) -> str:
    """Return the pinhole as RTAB-Map's calibration file (OpenCV's YAML with ROS' names)."""

    def matrix(name: str, values: np.ndarray) -> tuple[str, ...]:
        data = ", ".join(map(repr, values.astype(float).ravel().tolist()))
        return f"{name}:", f"   rows: {values.shape[0]}", f"   cols: {values.shape[1]}", f"   data: [ {data} ]"

    lines = (
        *("%YAML:1.0", "---", "camera_name: rtabmap_calib"),
        *(f"image_width: {lens.width}", f"image_height: {lens.height}"),
        *matrix("camera_matrix", lens.matrix),
        "distortion_model: plumb_bob",
        *matrix("distortion_coefficients", np.zeros((1, 5))),
        *matrix("rectification_matrix", np.eye(3)),
        *matrix("projection_matrix", np.concatenate([lens.matrix, np.zeros((3, 1))], axis=1)),
        *matrix("local_transform", OPTICAL_ROTATION),
    )
    return "\n".join((*lines, ""))
