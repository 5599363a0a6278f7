"""Tables of coverage: patches of a part, camera poses, and sets of poses that reach a goal. Their
rows are mappings."""

from harness.records.schema import Column, Table
from harness.vocabulary.text import percent


def _share(value: float) -> str:
    return f"{percent(value)}\u00a0%"


COVERAGE = Table(
    "coverage",
    "one row per patch of the face: the size of damage that is found there 90 % of the time",
    (
        Column("x_mm", note="x of the patch's centre in the board's frame"),
        Column("y_mm", note="y of the patch's centre"),
        Column("z_mm", note="z of the patch's centre"),
        Column("area_m2", note="area of the patch"),
        Column(
            "a90_mm",
            note=(
                "size found 90 % of the time in the best pose; inf: no size is; empty: not judged"
            ),
        ),
        Column("pose", note="number of the best pose, in which the smallest damage is found"),
        Column("noise_mm", note="the detector's unit of score in the best pose; inf: not judged"),
        Column("angle_deg", note="angle of incidence in the best pose"),
        Column("range_m", note="distance from the camera in the best pose"),
    ),
)
POSES = Table(
    "coverage_poses",
    "one row per pose: the share of the face on which damage of the wanted size is found",
    (
        Column("number", "pose", note="number of the pose"),
        Column("distance_m", "distance (m)", note="distance of the face's centre"),
        Column(
            "tilt_x_deg",
            "tilt about x (°)",
            note="tilt of the part about x, as in an experiment's pose",
        ),
        Column("tilt_y_deg", "tilt about y (°)", note="tilt of the part about y"),
        Column("alone_share", "alone", note="share of the face that this pose covers", text=_share),
        Column(
            "gain_share",
            "adds",
            note="share that this pose adds to the previous poses",
            text=_share,
        ),
        Column(
            "total_share",
            "together",
            note="share that this and the previous poses cover",
            text=_share,
        ),
    ),
)
GOALS = Table(
    "coverage_goal",
    "one row per set-up and distance: the poses that reach the goal, quickest capture first",
    (
        Column("set_up", "set-up", note="name of the set-up"),
        Column("camera", "camera", note="name of the camera"),
        Column("frames", "frames", note="number of averaged frames in each pose"),
        Column("distance_m", "distance (m)", note="distance of the face's centre"),
        Column("poses", "poses", note="number of poses"),
        Column("tilts", "tilts about x, y (°)", note="tilts of the poses"),
        Column(
            "total_share", "covered", note="share of the face that the poses cover", text=_share
        ),
        Column(
            "capture_s",
            "capture (s)",
            note="time to capture the frames and to move between the poses",
        ),
        Column("reached", "reaches the goal", note="whether the poses cover the wanted share"),
    ),
    left=2,
)
COVERAGE_TABLES = (COVERAGE, POSES, GOALS)
