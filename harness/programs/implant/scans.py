"""A study on recorded frames: virtual damage at random places of scans of an undamaged part,
judged like boards.

A placement corresponds to a simulated board: some damages at once, in one group of recorded
frames. The placements in one recording share its surface and fixed pattern and, if it has few
frames, its noise."""

import math
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
import pandas as pd
from scipy import ndimage

from detectors.averages.average import RECORDED, average
from detectors.crop import AutoCrop, choice_of
from detectors.pixels.noise import REACH_FRAMES, noise_reach_px, sides_if_upsampled
from detectors.recordings import Recording
from harness.evaluation.study.record import SetUpRecord
from harness.records.rows import Origin, TrialRecord
from harness.records.trials import ResultTables
from harness.runs.study_record import set_up_of
from harness.runs.tables import columns_of
from harness.trials import judge
from harness.trials.board import INTACT_MARGIN_PX, LabelledCloud, far_from, outlined, pixel_areas
from harness.trials.record import add_judgement
from harness.vocabulary.errors import UserError
from harness.vocabulary.geometry import MM, Cloud, Frame, invert, rays_of, transform_points
from harness.vocabulary.seeds import digest, random_stream
from scenes.implants import (
    BEYOND_PX,
    KINDS,
    Implant,
    PartFace,
    implant_of,
    tangent_board,
    unit_config,
)
from scenes.sensor.camera import camera_of
from scenes.target.custom import TargetConfig
from scenes.target.drawn import DrawnTargetConfig, Purpose
from scenes.target.truth import truth_of

# most undamaged averages that count false calls, and that set a threshold
MOST_HOLE_FREE = 20
MOST_SETTING = 5
MOST_EMPTY = 200  # give up after this many placements in a row without a place for any damage
NORMAL_PX = 4  # half the side of the square of surface that determines the tangent plane
# a warning follows if the judged rim is steeper than the places of damage by this angle
TELLING_DEG = 5.0
OUTLIERS = 0.002  # share of a surface's points on either side that say nothing about its extent
VARIANT = "main"


@dataclass(frozen=True)
class Judging:
    """The rule by which clouds are judged. ``threshold`` None: ``threshold_of`` returns it, with
    warnings."""

    detector: str
    settings_json: str
    radius_m: float
    threshold: float | None
    threshold_of: Callable[[Cloud], tuple[float, tuple[str, ...]]]


class Scan:
    """A recording of an undamaged part, with its surface and judged area. Raises UserError if
    either is missing."""

    def __init__(self, recording: Recording, judging: Judging) -> None:
        if recording.lens is None or recording.slopes is None or recording.projection != "central":
            fix = "name the lens's file or the camera with --intrinsics"
            raise UserError(
                f"{recording.name}: the lens is not known, and damage cannot be placed", fix=fix
            )
        self.recording = recording
        self.lens = recording.lens
        self.slopes = recording.slopes
        self.frames = list(recording.frames())
        first_frames = self.frames[:REACH_FRAMES]
        self.reach_px = noise_reach_px(first_frames, recording.z_step_m)
        self.sides_px = sides_if_upsampled(first_frames, self.reach_px, recording.z_step_m)
        self.whole = self.averaged(self.frames)
        evidence = judge.detector_of(judging.detector, judging.settings_json).analyse(self.whole)
        self.judged = np.isfinite(evidence.score) & np.isfinite(evidence.surface_z_m)
        self.surface_z_m = np.where(self.judged, evidence.surface_z_m, np.nan)
        points_m = self.rays[self.judged] * self.surface_z_m[self.judged][:, None]
        # the board's frame: the plane through the surface, z towards the camera, x along the
        # picture's rows
        centre = points_m.mean(axis=0)
        _, axes = np.linalg.eigh(np.cov((points_m - centre).T))
        normal = axes[:, 0] * -np.sign(axes[2, 0])
        along = np.array([1.0, 0.0, 0.0]) - normal[0] * normal
        along /= np.linalg.norm(along)
        self.T_camera_board = np.eye(4)
        self.T_camera_board[:3] = np.column_stack([along, np.cross(normal, along), normal, centre])
        face_places = transform_points(invert(self.T_camera_board), points_m)[:, :2]
        middle = face_places.min(axis=0) / 2 + face_places.max(axis=0) / 2
        self.T_camera_board[:3, 3] = transform_points(self.T_camera_board, np.array([*middle, 0.0]))
        self.size_m: np.ndarray = np.ptp(face_places, axis=0)
        # no damage is placed where the undamaged recording has findings, which would count as hits
        detector = judge.detector_of(judging.detector, judging.settings_json)
        threshold = judging.threshold
        detections = detector.find(
            self.whole, evidence, threshold or judging.threshold_of(self.whole)[0]
        )
        rays = np.array([detection.centre_m for detection in detections]).reshape(-1, 3)
        met = rays * ((self.T_camera_board[:3, 3] @ normal) / (rays @ normal))[:, None]
        self.taken_m = transform_points(invert(self.T_camera_board), met)[:, :2]
        self.free_m = judging.radius_m

    @cached_property
    def rays(self) -> np.ndarray:
        """Rays (h, w, 3) with z = 1."""
        return rays_of(self.slopes)

    @cached_property
    def places_m(self) -> np.ndarray:
        """Points (h, w, 2) where each pixel's ray meets the plane; NaN where nothing is judged."""
        normal = self.T_camera_board[:3, 2]
        centre = self.T_camera_board[:3, 3]
        met = self.rays * ((centre @ normal) / (self.rays @ normal))[..., None]
        return np.where(
            self.judged[..., None],
            transform_points(invert(self.T_camera_board), met)[..., :2],
            np.nan,
        )

    @cached_property
    def part(self) -> PartFace:
        """The part as far as the recording shows it: the judged area, and the smooth surface of
        which it is a piece. What a crop leaves out shades the damage, too."""
        shown = self.judged
        candidates = choice_of(self.whole, AutoCrop()).candidates
        if candidates:
            widest = max(candidates, key=lambda candidate: int((candidate.mask & shown).sum()))
            if (widest.mask & shown).any():
                shown = shown | widest.mask
        points_m = self.whole.points_m[shown & self.whole.valid]
        places_m = transform_points(invert(self.T_camera_board), points_m)[:, :2]
        low_m, high_m = np.quantile(places_m, (OUTLIERS, 1 - OUTLIERS), axis=0)
        judged_m = self.size_m / 2
        return PartFace(
            T_camera_part=self.T_camera_board,
            low_m=np.minimum(low_m, -judged_m),
            high_m=np.maximum(high_m, judged_m),
        )

    @cached_property
    def depth_px(self) -> np.ndarray:
        """Distance (h, w) of each pixel to the nearest one that is not judged or is outside the
        picture."""
        return np.asarray(ndimage.distance_transform_edt(np.pad(self.judged, 1))[1:-1, 1:-1])

    @cached_property
    def area_m2(self) -> float:
        """Judged area of the surface in plan."""
        return float(np.nansum(pixel_areas(self.places_m)[self.judged]))

    @property
    def pitch_m(self) -> float:
        """Side of a square in plan with the mean area of a judged pixel."""
        return math.sqrt(self.area_m2 / max(self.judged.sum(), 1))

    @cached_property
    def angle_deg(self) -> np.ndarray:
        """Angle (h, w) between each judged pixel's ray and the fitted surface's normal; NaN
        elsewhere."""
        down, across = np.gradient(self.rays * self.surface_z_m[..., None], axis=(0, 1))
        normal = np.cross(down, across)
        along = (normal * self.rays).sum(-1) / (
            np.linalg.norm(normal, axis=-1) * np.linalg.norm(self.rays, axis=-1)
        )
        return np.asarray(np.degrees(np.arccos(np.clip(np.abs(along), 0, 1))))

    def rim_px(self, family: DrawnTargetConfig) -> float:
        """Return the least distance of a damage's centre from the edge of the judged area, for any
        size of damage."""
        return family.damage.widest_mm * MM / 2 / self.pitch_m + BEYOND_PX + self.reach_px

    def left_out(self, family: DrawnTargetConfig) -> str:
        """Return a sentence on the rim where no damage is placed; empty if it is not steeper than
        the rest."""
        inner = self.depth_px >= self.rim_px(family)
        has_angle = np.isfinite(self.angle_deg)
        if not (inner & has_angle).any():
            return ""
        steep = [
            float(np.quantile(self.angle_deg[part & has_angle], 0.99))
            for part in (inner, self.judged)
        ]
        if steep[1] - steep[0] < TELLING_DEG:
            return ""
        inside = (
            f"the inner {100 * (inner & has_angle).sum() / has_angle.sum():.0f} % of the judged "
            "area"
        )
        rim = (
            f"the limit says nothing about the rim, seen at up to {steep[1]:.0f} degrees, where "
            "more is missed"
        )
        return (
            f"{self.recording.name}: damage is placed on {inside}, seen at up to {steep[0]:.0f} "
            f"degrees; {rim}"
        )

    def averaged(self, frames: Sequence[Frame]) -> Cloud:
        """Return the average of some frames, computed as in `tofpod detect`."""
        cloud = average(
            replace(self.recording, read=lambda: iter(frames), selection=None), RECORDED
        )
        return replace(
            cloud,
            projection="central",
            noise_reach_px=getattr(self, "reach_px", 0.0),
            noise_sides_px=getattr(self, "sides_px", None),
        )

    def place(self, x_m: float, y_m: float, rim_px: float) -> tuple[np.ndarray, np.ndarray] | None:
        """Return the surface's point (3,) above a place of the plane and the normal (3,) towards
        the camera, in its frame; None with less than ``rim_px`` of judged surface around it, or
        with a finding within the hit radius."""
        if (np.linalg.norm(self.taken_m - [x_m, y_m], axis=1) < self.free_m).any():
            return None
        point = transform_points(self.T_camera_board, np.array([x_m, y_m, 0.0]))
        u, v = self.lens.project(point)
        row = round(float(v))
        column = round(float(u))
        h, w = self.judged.shape
        if not (0 <= row < h and 0 <= column < w) or self.depth_px[row, column] < rim_px:
            return None
        rows = slice(max(row - NORMAL_PX, 0), row + NORMAL_PX + 1)
        columns = slice(max(column - NORMAL_PX, 0), column + NORMAL_PX + 1)
        around = rows, columns
        points = (self.rays[around] * self.surface_z_m[around][..., None]).reshape(-1, 3)
        points = points[np.isfinite(points[:, 2])]
        middle = points.mean(axis=0)
        normal = np.linalg.eigh(np.cov((points - middle).T))[1][:, 0]
        normal = normal * -np.sign(normal[2])
        ray = np.array([*(point[:2] / point[2]), 1.0])
        return ray * (middle @ normal) / (ray @ normal), normal

    def known(self, cloud: Cloud, target: TargetConfig, *, damaged: bool) -> LabelledCloud:
        """Return a cloud of this scan with the truth of the implanted damage."""
        truth = truth_of(target, self.T_camera_board)
        intact = self.judged & far_from(truth, self.places_m, INTACT_MARGIN_PX * self.pitch_m)
        return LabelledCloud(
            cloud=cloud,
            damaged=damaged,
            T_board_cloud=invert(self.T_camera_board),
            target=target,
            truth=truth,
            outlines=outlined(truth, self.places_m),
            places_m=self.places_m,
            undamaged=intact,
            seen_depth_m={damage.id: damage.depth_m for damage in truth},
        )


@dataclass(frozen=True, eq=False)
class Implanted:
    """Damages of ``target`` at suitable places in one scan, with the change that each makes."""

    number: int
    scan: Scan
    target: TargetConfig
    implants: tuple[Implant, ...]

    def cloud(self, group: slice) -> Cloud:
        """Return the average of a group of the scan's frames with the damage implanted."""
        changed = []
        for number, frame in list(enumerate(self.scan.frames))[group]:
            z_m = frame.z_m.copy()
            reason = frame.reason.copy()
            for implant in self.implants:
                implant.put_into(frame, number, z_m, reason)
            changed.append(replace(frame, z_m=z_m, reason=reason))
        return self.scan.averaged(changed)


def placements(
    scans: Sequence[Scan],
    family: DrawnTargetConfig,
    camera: str,
    targets: int,
    seed: int,
    cache: Path,
) -> Iterator[Implanted]:
    """Yield placements with ``targets`` damages or a few more, scan by scan. Raises UserError if
    none fits."""
    units = [unit_config(camera, scan.lens) for scan in scans]
    placed_count = number = empty = 0
    while placed_count < targets:
        scan = scans[number % len(scans)]
        config, same = units[number % len(scans)]
        placed = damages_placed(scan, family, camera, "damaged", number)
        empty = 0 if placed.damages else empty + 1
        if empty > MOST_EMPTY:
            fix = "smaller --diameters, a larger --crop, or a camera nearer to the part"
            raise UserError(
                f"{scan.recording.name}: the judged area has no room for the damage", fix=fix
            )
        implants = []
        for damage in placed.damages:
            spot = scan.place(*damage.centre_m, 0.0)
            assert spot is not None  # `damages_placed` has checked it
            board = tangent_board(placed, damage, scan.part, *spot)
            draw = int(random_stream(seed, "implant", number, damage.id).integers(2**31))
            implants.append(
                implant_of(config, same, scan.lens, board, len(scan.frames), draw, cache)
            )
        if implants:
            placed_count += len(implants)
            yield Implanted(number, scan, placed, tuple(implants))
        number += 1


def damages_placed(
    scan: Scan, family: DrawnTargetConfig, camera: str, purpose: Purpose, number: int
) -> TargetConfig:
    """Return a board of the family with only those damages that have enough judged surface around
    them."""
    drawn = family.drawn(purpose, number)
    rim_px = scan.rim_px(family)
    kept = {
        damage.id for damage in drawn.damages if scan.place(*damage.centre_m, rim_px) is not None
    }
    kept_damages = {
        name: tuple(damage for damage in getattr(drawn, name) if damage.id in kept)
        for name in KINDS
    }
    return drawn.model_copy(update=kept_damages)


def judge_scans(
    scans: Sequence[Scan],
    implanted: Sequence[Implanted],
    family: DrawnTargetConfig,
    camera: str,
    judging: Judging,
    frames: Sequence[int],
) -> tuple[ResultTables, tuple[SetUpRecord, ...], tuple[str, ...]]:
    """Set a threshold for each number of frames, count false calls on undamaged frames, and judge
    all placements. Return tables, a set-up for each number of frames, and warnings. If a recording
    has two groups of that many frames or more, every second group sets the threshold; otherwise
    the same frames do both, and a warning says so."""
    record = TrialRecord()
    warnings = [text for scan in scans if (text := scan.left_out(family))]
    calibration_runs: dict[int, int] = {}
    for count in frames:
        groups = _groups(scans, count)
        if len(groups.all) == 1:
            warnings.append(
                f"{count} frames: one average sets the threshold, shows the false calls and "
                "is damaged too"
            )
        setting = groups.setting[:MOST_SETTING] if judging.threshold is None else []
        own_thresholds = [
            judging.threshold_of(scan.averaged(scan.frames[group])) for scan, group in setting
        ]
        warnings += dict.fromkeys(
            f"{count} frames: {text}" for _, doubts in own_thresholds for text in doubts
        )
        calibration_runs[count] = len(own_thresholds)
        threshold = judging.threshold or float(np.median([value for value, _ in own_thresholds]))
        _add_undamaged(record, judging, groups, threshold, family=family, camera=camera)
        _add_placements(record, judging, groups, threshold, implanted)
    tables = ResultTables(
        **{
            name: pd.DataFrame(columns_of(rows, {}) if rows else {})
            for name, rows in record.to_data().items()
        },
        variants=pd.DataFrame(),
        axes=pd.DataFrame(),
    )
    detector = judge.detector_of(judging.detector, judging.settings_json)
    camera_data = camera_of(unit_config(camera, scans[0].lens)[0]).to_data()
    files = [path.as_posix() for scan in scans for path in scan.recording.files]
    set_ups = []
    for count in frames:
        set_up = set_up_of(
            tables.holes[tables.holes["frames"] == count],
            tables.runs[tables.runs["frames"] == count],
            variant=VARIANT,
            frames=count,
            detector=detector.name,
            detector_version=detector.version,
            calibration_runs=calibration_runs[count],
            targets_digest=digest([placement.target.to_data() for placement in implanted]),
            frames_digest=digest([camera_data, count, *files]),
        )
        set_ups.append(set_up)
    return tables, tuple(set_ups), tuple(warnings)


@dataclass(frozen=True, eq=False)
class _Groups:
    """Groups of so many frames in a row, none of which share a frame."""

    count: int
    """Number of frames of a group."""
    all: list[tuple[Scan, slice]]
    """The scan of each group, and its frames."""
    setting: list[tuple[Scan, slice]]
    """Those that may set the threshold."""
    judged: list[tuple[Scan, slice]]
    """Those that are judged."""


def _groups(scans: Sequence[Scan], count: int) -> _Groups:
    """Return the groups of ``count`` frames. Raises UserError if no scan has as many frames."""
    groups = [
        (scan, slice(start, start + count))
        for scan in scans
        for start in range(0, len(scan.frames) - count + 1, count)
    ]
    if not groups:
        longest = max(len(scan.frames) for scan in scans)
        raise UserError(
            f"--frames {count}: no recording has that many frames", legal=f"1 to {longest}"
        )
    if len(groups) == 1:
        return _Groups(count, groups, setting=groups, judged=groups)
    return _Groups(count, groups, setting=groups[::2], judged=groups[1::2])


def _add_undamaged(
    record: TrialRecord,
    judging: Judging,
    groups: _Groups,
    threshold: float,
    *,
    family: DrawnTargetConfig,
    camera: str,
) -> None:
    """Judge undamaged averages and add their rows."""
    for number, (scan, group) in enumerate(groups.judged[:MOST_HOLE_FREE]):
        sites = damages_placed(scan, family, camera, "hole_free", number)
        cloud = scan.averaged(scan.frames[group])
        labelled = scan.known(cloud, sites, damaged=False)
        _add(record, judging, labelled, threshold, frames=groups.count, board=number)


def _add_placements(
    record: TrialRecord,
    judging: Judging,
    groups: _Groups,
    threshold: float,
    implanted: Sequence[Implanted],
) -> None:
    """Judge all placements, in turn on the groups of their scans, and add their rows."""
    for index, placement in enumerate(implanted):
        slices = [group for scan, group in groups.judged if scan is placement.scan]
        # a scan with one group has perhaps only set the threshold
        slices = slices or [group for scan, group in groups.all if scan is placement.scan]
        cloud = placement.cloud(slices[index % len(slices)])
        labelled = placement.scan.known(cloud, placement.target, damaged=True)
        _add(record, judging, labelled, threshold, frames=groups.count, board=placement.number)
        print(
            f"frames averaged {groups.count}: placement {index + 1} of {len(implanted)}",
            file=sys.stderr,
        )


def _add(
    record: TrialRecord,
    judging: Judging,
    labelled: LabelledCloud,
    threshold: float,
    *,
    frames: int,
    board: int,
) -> None:
    """Judge one cloud and add its rows."""
    judgement = judge.judge(
        labelled,
        judge.Criteria(
            detector=judging.detector,
            settings_json=judging.settings_json,
            threshold=threshold,
            radius_m=judging.radius_m,
        ),
    )
    add_judgement(
        record,
        judgement,
        point="",
        origin=Origin(variant=VARIANT, frames=frames, repeat=0, board=board),
        role="damaged" if labelled.damaged else "hole_free",
        seconds_frames=0.0,
    )
