"""Set-ups whose boards have drawn unknowns of known effect.

POD is logistic(ln(a / a50) / width) with a50 and width by the value of ``backing``; ``blur``
multiplies a50 by a factor from one end of its range to the other; ``idle`` does nothing."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from harness.evaluation.study.record import DrawnUnknown, SetUpRecord
from harness.experiment.unknowns import UnknownConfig
from tests.support.synthetic_study import SetUp, Study, study_record

BACKING = "source.target.backing"
BLUR = "source.camera.numbers.scatter.blur_px"
IDLE = "source.camera.numbers.unit.jitter_mm"
BACKINGS = ({"distance_mm": 20.0}, {"distance_mm": 1000.0}, None)
A50_MM = np.array([3.5, 4.8, 4.2])
WIDTH = np.array([0.05, 0.10, 0.08])
BLUR_PX = (0.3, 0.6)
BLUR_FACTOR = 1.3
DECLARED = (
    UnknownConfig(key=BACKING, values=BACKINGS, reason="not seen"),
    UnknownConfig(key=BLUR, range=BLUR_PX, reason="not published"),
    UnknownConfig(key=IDLE, range=(0.1, 0.4), reason="no matter"),
)
SIZES_MM = (2.0, 9.0)


def true_a90_mm(backing: int, blur_px: float = 0.45) -> float:
    """The a90 of a backing, by its number, and a blur."""
    share = (blur_px - BLUR_PX[0]) / (BLUR_PX[1] - BLUR_PX[0]) - 0.5
    return float(A50_MM[backing] * BLUR_FACTOR**share * 9.0 ** WIDTH[backing])


def drawn_set_up(boards: int = 36, seed: int = 1, *, idle_only: bool = False) -> SetUpRecord:
    """Return a set-up of boards with eight damages, whose unknowns are balanced over boards;
    ``idle_only``: none of them does anything."""
    set_up = SetUp(variant="unknowns=drawn", axes={"unknowns": "drawn"})
    study = Study(boards=boards, sizes_mm=SIZES_MM, seed=seed, set_ups=(set_up,))
    record = study_record(study).set_ups[0]
    numbers = np.arange(boards)
    drawn = []
    for unknown in DECLARED:
        values = [unknown.drawn(seed, "damaged", board) for board in range(boards)]
        if unknown.values is not None:
            values = [BACKINGS.index(value) for value in values]
        column = DrawnUnknown(
            key=unknown.key,
            reason=unknown.reason,
            board=numbers,
            level=np.array(values, float),
            values=unknown.values,
            range=unknown.range,
            stated={"distance_mm": 20.0, "albedo_850": 0.6} if unknown.values else 0.3,
        )
        drawn.append(column)
    inspected = record.inspected
    backing = drawn[0].level[inspected.board].astype(int)
    blur_px = drawn[1].level[inspected.board]
    share = (blur_px - BLUR_PX[0]) / (BLUR_PX[1] - BLUR_PX[0]) - 0.5
    if idle_only:
        backing = np.zeros_like(backing)
        share = np.zeros_like(share)
    a50_mm = A50_MM[backing] * BLUR_FACTOR**share
    luck = np.random.default_rng([seed, 9]).random(len(a50_mm))
    above = np.log(inspected.diameter_mm / a50_mm) / WIDTH[backing]
    hit = luck < 1 / (1 + np.exp(-above))
    return replace(record, inspected=replace(inspected, hit=hit), drawn=tuple(drawn))
