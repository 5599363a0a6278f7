"""RGB-D odometry from view to view (Open3D): what a SLAM system does between two frames, without marks or guesses.

Each view is set against the one before it, starting from no motion, by colour and depth together (Park, Zhou & Koltun,
"Colored point cloud registration revisited", ICCV 2017; Open3D's hybrid term); steps are composed to the first view,
so that errors add up along the way. Only the target is shown to it: in a capture on a turntable the room does not move
with the target. No loop is closed, no map is kept, and nothing corrects what has drifted.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np

from detectors.open3d_library import open3d_on_one_thread
from detectors.registration.judged import MIN_OVERLAP
from detectors.registration.registered import Registration, failed
from detectors.views import PreparedView
from harness.vocabulary.geometry import Region
from harness.vocabulary.lens import Lens

METHOD = "odometry"
DEPTH_DIFFERENCE_M = 0.03
"""Largest difference in depth of a pair of pixels (Open3D's own default)."""
DRIFTS = "no covariance: what Open3D's odometry gives counts its pairs, and does not know how far it slid"


def register_by_odometry(views: Sequence[PreparedView]) -> list[Registration]:
    """Views but the first to the first, in the order given: that of the walk.

    A view that odometry loses (Open3D says so, or less than a tenth of the target's pixels pair) is a failure, and so
    is every view after it. ``residual_m`` and ``covariance`` are NaN. Every view needs colour, a pixel grid and a lens.
    """
    T_reference_view, lost, found = np.eye(4), "", []
    with open3d_on_one_thread() as o3d:
        canvas = _canvas_of(views)
        images = [_image(o3d, view, canvas) for view in views]
        for before, now, view in zip(images, images[1:], views[1:], strict=False):
            step, pairs = (np.eye(4), 0) if lost else _step(o3d, now, before, canvas)
            pixels = max(int(np.count_nonzero(np.asarray(image.depth))) for image in (now, before))
            if not lost and pairs < MIN_OVERLAP * pixels:
                lost = f"odometry lost its way at {view.view.name}: {pairs} pixels match the view before it"
            if lost:
                found.append(failed(view, METHOD, None, lost))
                continue
            T_reference_view = T_reference_view @ step
            found.append(Registration(view.view.name, METHOD, T_reference_view, pairs=pairs, notes=(DRIFTS,)))
    return found


def _canvas_of(views: Sequence[PreparedView]) -> Lens:
    """One pinhole for all: the first lens's focal lengths, and room for every target's points."""
    lens = views[0].view.cloud.lens
    assert lens is not None
    slopes = np.concatenate([view.points_m[:, :2] / view.points_m[:, 2:] for view in views])
    focal = np.array([lens.fx, lens.fy])
    low = np.floor((slopes * focal).min(axis=0)) - 1
    width, height = (np.ceil((slopes * focal).max(axis=0)) + 2 - low).astype(int)
    return Lens(int(width), int(height), lens.fx, lens.fy, -float(low[0]), -float(low[1]))


def _image(o3d: Any, view: PreparedView, canvas: Lens) -> Any:
    """The view's target as Open3D's intensity and depth on the canvas, both without distortion."""
    cloud = view.view.cloud
    lens = cloud.lens
    assert lens is not None and cloud.rgb is not None
    slopes = canvas.region_slopes(Region(0, canvas.height, 0, canvas.width))
    pixels = lens.project(np.concatenate([slopes, np.ones((*slopes.shape[:2], 1))], axis=-1))
    u, v = (pixels - [cloud.region.col0, cloud.region.row0]).astype(np.float32).transpose(2, 0, 1)
    z = np.where(view.inside, cloud.points_m[..., 2], 0.0).astype(np.float32)
    # depth is not interpolated, because the mean of target and nothing is neither
    depth = cv2.remap(z, u, v, cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT, borderValue=0)
    colour = cv2.remap(cloud.rgb, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return o3d.geometry.RGBDImage.create_from_color_and_depth(
        o3d.geometry.Image(np.ascontiguousarray(colour)),
        o3d.geometry.Image(np.ascontiguousarray(depth)),
        depth_scale=1.0,
        depth_trunc=float(depth.max()) + 1.0,
        convert_rgb_to_intensity=True,
    )


def _step(o3d: Any, now: Any, before: Any, canvas: Lens) -> tuple[np.ndarray, int]:
    """``T_before_now`` (4, 4) and the number of pixels that paired, 0 where odometry says that it failed."""
    methods = o3d.pipelines.odometry
    camera = o3d.camera.PinholeCameraIntrinsic(canvas.width, canvas.height, canvas.fx, canvas.fy, canvas.cx, canvas.cy)
    option = methods.OdometryOption(depth_diff_max=DEPTH_DIFFERENCE_M, depth_min=0.0, depth_max=1e3)
    success, T_before_now, information = methods.compute_rgbd_odometry(
        now, before, camera, np.eye(4), methods.RGBDOdometryJacobianFromHybridTerm(), option
    )
    T = np.array(T_before_now)
    # its last diagonal element is the sum of 1 over pairs
    return (T, round(float(information[5, 5]))) if success and np.isfinite(T).all() else (np.eye(4), 0)
