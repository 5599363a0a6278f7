"""Renders a straight edge in front of a wall, above a floor: the light that reaches its shadow has
met several surfaces, which planes in closed form leave out."""

import numpy as np

from harness.vocabulary.geometry import Region
from scenes.optics import NoiseFreeView, RenderConfig
from scenes.sensor.camera import AnyCamera
from scenes.target.custom import (
    BackingConfig,
    BoardConfig,
    FlatConfig,
    MaterialConfig,
    PoseConfig,
    RoomConfig,
    TargetConfig,
)

PLATE_MM = 1.0  # thickness of the front
WALL_MM = 6000.0  # width and height of the wall behind it
FLOOR_ALBEDO = 0.3
EFFORT = RenderConfig(bounces=4, rest_samples=1024)
"""Every pixel counts as one off the board's face: the shadow lies on the wall."""


def rendered_step(
    camera: AnyCamera,
    region: Region,
    *,
    axis: int,
    sign: float,
    slant: float,
    distance_m: float,
    step_mm: float,
    front_mm: float,
    front_albedo: float,
    wall_albedo: float,
    floor_below_m: float,
) -> NoiseFreeView:
    """Return the view of a square plate of side ``front_mm``, frontal, of which one edge passes the
    optical axis, in front of a wall. With ``axis`` 0 the plate is where sign (u - slant v) < 0 in
    pixels from the axis, with 1 where sign (v - slant u) < 0. Light is followed over five
    surfaces."""
    from scenes.render.view import render_view  # with trimesh and Mitsuba, which few figures need
    from scenes.target.mesh import build_target

    turn = float(np.arctan(slant))
    away = np.array([np.cos(turn), -np.sin(turn)])
    if axis == 1:
        away = away[::-1]
        turn = -turn
    # the edge passes the axis, half a side from the centre
    centre_mm = -sign * front_mm / 2 * away
    target = TargetConfig(
        board=BoardConfig(
            width_mm=front_mm,
            height_mm=front_mm,
            thickness_mm=PLATE_MM,
            shape=FlatConfig(),
        ),
        material=MaterialConfig(albedo_850=front_albedo, grain_contrast=0.0),
        backing=BackingConfig(
            distance_mm=step_mm - PLATE_MM,
            albedo_850=wall_albedo,
            size_mm=(WALL_MM, WALL_MM),
        ),
        room=RoomConfig(floor_below_lens_m=floor_below_m, floor_albedo_850=FLOOR_ALBEDO),
        pose=PoseConfig(
            distance_m=distance_m,
            offset_x_mm=float(centre_mm[0]),
            offset_y_mm=float(centre_mm[1]),
            roll_deg=float(np.degrees(turn)),
        ),
    )
    return render_view(build_target(target), camera.optics, EFFORT, region)
