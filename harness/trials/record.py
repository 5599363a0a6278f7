"""Makes the rows of a trial's record from its judgements and clouds."""

from dataclasses import replace

import numpy as np

from detectors.interface import Measurement
from detectors.pixels.noise import median_of
from harness.records.rows import (
    DamageRow,
    FindingRow,
    OperatingRow,
    Origin,
    PixelsRow,
    Role,
    RunRow,
    SiteRow,
    TrialRecord,
)
from harness.trials.clouds import MapFacts
from harness.trials.judge import Judgement
from harness.vocabulary.geometry import MM
from scenes.target.truth import Damage

NO_MAP = MapFacts()


def add_judgement(
    record: TrialRecord,
    judgement: Judgement,
    *,
    point: str,
    origin: Origin,
    role: Role,
    seconds_frames: float,
    exposure_share: float | None = None,
    map_facts: MapFacts = NO_MAP,
) -> None:
    """Add the rows of one judgement. An origin with a board belongs to a study, which records
    findings, signals and counts over grids of thresholds as well."""
    in_study = origin.board is not None
    run = run_row(
        judgement, point, origin, role, seconds_frames=seconds_frames, map_facts=map_facts
    )
    record.runs.append(replace(run, exposure_share=exposure_share))
    if judgement.criteria.threshold is None:
        return
    if judgement.labelled.damaged:
        record.holes += damage_rows(judgement, judgement.criteria.threshold, point, origin)
    if not in_study:
        return
    record.findings += finding_rows(judgement, origin, role)
    record.operating.append(operating_row(judgement, origin, role))
    if judgement.labelled.damaged:
        record.pixels += pixel_rows(judgement, origin, role)
    else:
        record.sites += site_rows(judgement, origin, role)


def run_row(
    judgement: Judgement,
    point: str,
    origin: Origin,
    role: Role,
    *,
    seconds_frames: float,
    map_facts: MapFacts,
) -> RunRow:
    """Return the row of a judgement as a whole."""
    threshold = judgement.criteria.threshold
    cloud = judgement.labelled.cloud
    row = RunRow(
        point=point,
        origin=origin,
        role=role,
        threshold=np.nan if threshold is None else threshold,
        quiet_threshold=judgement.quiet_threshold,
        scale_mm=judgement.evidence.scale_m / MM,
        surface_noise_mm=judgement.surface_noise_m / MM,
        frames_used=cloud.n_frames,
        left_out=len(cloud.left_out),
        detections=len(judgement.detections),
        false_calls=judgement.false_calls,
        views_used=map_facts.views_used,
        views_left_out=map_facts.views_left_out,
        seconds_map=map_facts.seconds_map,
        seconds_frames=seconds_frames,
        seconds_detect=judgement.seconds,
    )
    if origin.board is None:
        return row
    row = replace(row, inspected_m2=judgement.inspected_m2)
    if threshold is None:
        row = replace(row, peaks=list(judgement.peaks))
        return _with_loudest_place(row, judgement)
    _, no_return_calls = judgement.without_return
    return replace(row, no_return_calls=no_return_calls)


def _with_loudest_place(row: RunRow, judgement: Judgement) -> RunRow:
    """Add the place of the highest score, on the board and on the sensor; NaN where it has
    none."""
    score = judgement.evidence.score
    labelled = judgement.labelled
    cloud = labelled.cloud
    x_m = y_m = np.nan
    u_px = v_px = np.nan
    if np.isfinite(score).any():
        loudest = int(np.nanargmax(score))
        x_m, y_m = labelled.places_m.reshape(-1, 2)[loudest]
        if cloud.organised and cloud.projection == "central":
            row_index, column_index = np.unravel_index(loudest, score.shape)
            v_px = float(row_index + cloud.region.row0)
            u_px = float(column_index + cloud.region.col0)
    return replace(
        row,
        loudest_x_mm=float(x_m) / MM,
        loudest_y_mm=float(y_m) / MM,
        loudest_u_px=u_px,
        loudest_v_px=v_px,
    )


def damage_rows(
    judgement: Judgement, threshold: float, point: str, origin: Origin
) -> list[DamageRow]:
    """Return a row for each damage; in a study with whether it returned nothing."""
    rows = []
    for index, damage in enumerate(judgement.labelled.truth):
        row = damage_row(judgement, threshold, index, damage, point, origin)
        if origin.board is not None:
            hits_without_return, _ = judgement.without_return
            row = replace(row, no_return=index in hits_without_return)
        rows.append(row)
    return rows


def damage_row(
    judgement: Judgement,
    threshold: float,
    index: int,
    damage: Damage,
    point: str,
    origin: Origin,
) -> DamageRow:
    """Return the row of the damage at an index of the truth. As in the thesis, measured positions
    are relative to the largest cluster."""
    labelled = judgement.labelled
    pixels = labelled.outlines[damage.id]
    invalid_fraction = np.nan
    if labelled.cloud.organised:  # only a pixel of a grid can lack a range
        z_m = labelled.cloud.points_m.reshape(-1, 3)[pixels, 2]
        invalid_fraction = float((~np.isfinite(z_m)).mean())
    residual_m = judgement.evidence.residual_m.reshape(-1)[pixels]
    residual_m = residual_m[np.isfinite(residual_m)]
    median_m = median_of(residual_m) if residual_m.size else np.nan
    x_m, y_m = damage.centre_board_m[:2]
    largest_hole = max(labelled.truth, key=lambda other: other.diameter_m)
    offset_m = np.linalg.norm(damage.centre_board_m - largest_hole.centre_board_m)
    row = DamageRow(
        point=point,
        origin=origin,
        hole=str(damage.id),
        kind=damage.kind,
        true_diameter_mm=damage.diameter_m / MM,
        true_depth_mm=damage.depth_m / MM,
        seen_depth_mm=labelled.seen_depth_m[damage.id] / MM,
        true_x_mm=float(x_m) / MM,
        true_y_mm=float(y_m) / MM,
        true_offset_mm=float(offset_m) / MM,
        size_of=damage.size_of,
        true_length_mm=damage.length_m / MM,
        true_width_mm=damage.width_m / MM,
        true_angle_deg=float(np.degrees(damage.angle_rad)),
        detected=index in judgement.hits,
        threshold=threshold,
        invalid_fraction=invalid_fraction,
        median_residual_mm=median_m / MM,
        state=_state(judgement, index, invalid_fraction, median_m),
        signal=judgement.signals[index],
    )
    largest = judgement.largest
    if index not in judgement.hits or largest is None:
        return row
    measured = judgement.measurements[judgement.hits[index]]
    return _with_measurement(row, judgement, damage, measured, largest)


def _state(judgement: Judgement, index: int, invalid_fraction: float, median_m: float) -> str:
    """Return what became of a damage's pixels."""
    if index in judgement.hits:
        return "found"
    if invalid_fraction > 0.5:
        return "invalid"
    if abs(median_m) > judgement.evidence.scale_m:
        return "wrong depth"
    return "invisible"


def _with_measurement(
    row: DamageRow,
    judgement: Judgement,
    damage: Damage,
    measured: Measurement,
    largest: Measurement,
) -> DamageRow:
    """Add what was measured of a damage."""
    labelled = judgement.labelled
    centre_m = labelled.centre_in_cloud_m(damage)
    along_x, along_y, _ = labelled.T_board_cloud[:3, :3] @ measured.along
    return replace(
        row,
        score=float(measured.score),
        points=int(measured.points),
        extent_diameter_mm=float(measured.extent_diameter_m) / MM,
        extent_offset_mm=_distance_mm(measured.extent_centre_m, largest.extent_centre_m),
        extent_error_mm=_distance_mm(measured.extent_centre_m, centre_m),
        model_diameter_mm=float(measured.model_diameter_m) / MM,
        model_diameter_se_mm=float(measured.model_diameter_se_m) / MM,
        model_depth_mm=float(measured.model_depth_m) / MM,
        model_depth_se_mm=float(measured.model_depth_se_m) / MM,
        model_offset_mm=_distance_mm(measured.model_centre_m, largest.model_centre_m),
        model_error_mm=_distance_mm(measured.model_centre_m, centre_m),
        length_mm=measured.length_m / MM,
        width_mm=measured.width_m / MM,
        angle_deg=float(np.degrees(np.arctan2(along_y, along_x) + np.pi / 2) % 180 - 90),
        model_note=measured.model_note,
    )


def _distance_mm(first_m: np.ndarray, second_m: np.ndarray) -> float:
    return float(np.linalg.norm(first_m - second_m)) / MM


def finding_rows(judgement: Judgement, origin: Origin, role: Role) -> list[FindingRow]:
    """Return a row for each detection. On a board without damage, none counts for a damage."""
    damage_of: dict[int, str] = {}
    if judgement.labelled.damaged:
        for index, detection_index in judgement.hits.items():
            damage_of[detection_index] = str(judgement.labelled.truth[index].id)
    rows = []
    for number, detection in enumerate(judgement.detections):
        x_m, y_m = judgement.places_m[number]
        row = FindingRow(
            origin=origin,
            role=role,
            x_mm=float(x_m) / MM,
            y_mm=float(y_m) / MM,
            score=float(detection.score),
            hole=damage_of.get(number, ""),
        )
        rows.append(row)
    return rows


def operating_row(judgement: Judgement, origin: Origin, role: Role) -> OperatingRow:
    """Return the numbers of findings and hits over the grid of thresholds."""
    thresholds, findings, hits = judgement.operating
    return OperatingRow(
        origin=origin, role=role, threshold=thresholds, findings=findings, hits=hits
    )


def pixel_rows(judgement: Judgement, origin: Origin, role: Role) -> list[PixelsRow]:
    """Return a row for each damage, and one for the undamaged face."""
    thresholds = judgement.pixel_thresholds.tolist()
    rows = []
    for hole, (pixels, above) in judgement.pixels_above.items():
        row = PixelsRow(
            origin=origin, role=role, hole=hole, pixels=pixels, threshold=thresholds, above=above
        )
        rows.append(row)
    return rows


def site_rows(judgement: Judgement, origin: Origin, role: Role) -> list[SiteRow]:
    """Return a row for each place from which damage was left out."""
    rows = []
    for index, damage in enumerate(judgement.labelled.truth):
        x_m, y_m = damage.centre_board_m[:2]
        row = SiteRow(
            origin=origin,
            role=role,
            hole=str(damage.id),
            true_diameter_mm=damage.diameter_m / MM,
            true_depth_mm=damage.depth_m / MM,
            true_x_mm=float(x_m) / MM,
            true_y_mm=float(y_m) / MM,
            detected=index in judgement.hits,
            signal=judgement.signals[index],
        )
        rows.append(row)
    return rows
