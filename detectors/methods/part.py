"""A part of a picture: the pixels of a cloud and of its evidence in some rows and columns."""

from dataclasses import replace

import numpy as np

from detectors.interface import Evidence
from detectors.methods.local import LocalEvidence
from harness.vocabulary.geometry import Cloud


def part_of_cloud(cloud: Cloud, rows: slice, columns: slice) -> Cloud:
    """Return the pixels of an organised cloud in these rows and columns, without its picture."""

    def cut(image: np.ndarray | None) -> np.ndarray | None:
        return None if image is None else image[rows, columns]

    return replace(
        cloud,
        points_m=cloud.points_m[rows, columns],
        reason=cloud.reason[rows, columns],
        count=cloud.count[rows, columns],
        variance_m2=cloud.variance_m2[rows, columns],
        mean_variance_m2=cut(cloud.mean_variance_m2),
        rgb=None,
        amplitude=None,
        map_views=None,
        noise_sides_px=None,
    )


def part_of_evidence(evidence: Evidence, rows: slice, columns: slice) -> Evidence:
    """Return the evidence on the pixels in these rows and columns."""
    behind = None if evidence.behind is None else evidence.behind[rows, columns]
    part = replace(
        evidence,
        score=evidence.score[rows, columns],
        residual_m=evidence.residual_m[rows, columns],
        surface_z_m=evidence.surface_z_m[rows, columns],
        behind=behind,
    )
    if not isinstance(part, LocalEvidence):
        return part
    part = replace(part, spread_m=part.spread_m[rows, columns])
    cell = part.cell[rows, columns]
    judged = cell >= 0
    if not judged.any():
        return replace(part, cell=cell, signed=np.zeros((0, 0)))
    across = part.signed.shape[1]
    cell_rows = cell[judged] // across
    cell_columns = cell[judged] % across
    top = int(cell_rows.min())
    left = int(cell_columns.min())
    signed = part.signed[top : int(cell_rows.max()) + 1, left : int(cell_columns.max()) + 1]
    cell = np.full(cell.shape, -1, dtype=np.int64)
    cell[judged] = (cell_rows - top) * signed.shape[1] + cell_columns - left
    return replace(part, cell=cell, signed=signed)
