"""Tables of coverage: every patch of a part, the poses, and the ways to a goal. Rows are mappings."""

from __future__ import annotations

from harness.tables.schema import Column, Table
from harness.tables.text import percent


def _share(value: float) -> str:
    return f"{percent(value)}\u00a0%"


COVERAGE = Table(
    "coverage",
    "one row per patch of the face: the size of damage that is found there nine times in ten",
    (
        Column("x_mm", note="x of its centre, board frame"),
        Column("y_mm", note="y"),
        Column("z_mm", note="z"),
        Column("area_m2", note="its area"),
        Column("a90_mm", note="size found 90 % of the time in the best pose; inf: none inspected; empty: not judged"),
        Column("pose", note="number of that pose"),
        Column("noise_mm", note="the detector's unit of score in that pose; inf: not judged"),
        Column("angle_deg", note="angle of incidence in that pose"),
        Column("range_m", note="distance from the camera in that pose"),
    ),
)
POSES = Table(
    "coverage_poses",
    "one row per pose: the share of the face on which damage of the wanted size is found",
    (
        Column("number", "pose", note="its number"),
        Column("distance_m", "distance (m)", note="of the face's centre"),
        Column("tilt_x_deg", "tilt about x (°)", note="of the part, as in an experiment's pose"),
        Column("tilt_y_deg", "tilt about y (°)", note="likewise, about y"),
        Column("alone_share", "alone", note="share of the face that this pose covers", text=_share),
        Column("gain_share", "adds", note="share that it adds to the poses above", text=_share),
        Column("total_share", "together", note="share that it and the poses above cover", text=_share),
    ),
)
GOALS = Table(
    "coverage_goal",
    "one row per set-up and distance: the poses that reach the goal, the cheapest first",
    (
        Column("set_up", "set-up", note="its name"),
        Column("camera", "camera", note="its name"),
        Column("frames", "frames", note="averaged in each pose"),
        Column("distance_m", "distance (m)", note="of the face's centre"),
        Column("poses", "poses", note="how many"),
        Column("tilts", "tilts about x, y (°)", note="of the poses"),
        Column("total_share", "covered", note="share of the face that they cover", text=_share),
        Column("capture_s", "capture (s)", note="frames at the camera's rate, and the moves between the poses"),
        Column("reached", "reaches the goal", note="whether that is the wanted share"),
    ),
    left=2,
)
COVERAGE_TABLES = (COVERAGE, POSES, GOALS)
