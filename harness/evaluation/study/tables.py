"""The tables that a study's trials leave beside its record, for curves over all thresholds and for places of calls."""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    import pandas as pd


class StudyTables(Protocol):
    """Every table has ``variant``, ``frames``, ``board``, ``repeat``; places are on the board, in millimetres.

    ``holes``: one row per damage of each damaged board (columns of `harness.evaluation.summary.ResultTables`, and
    ``signal`` as of `harness.evaluation.study.record.Inspected`).
    ``sites``: the same places on boards whose damage was left out: hole, true_diameter_mm, true_depth_mm, true_x_mm,
    true_y_mm, detected (a finding lies there by chance), signal. Boards of their own, numbered apart.
    ``runs``: role ("calibration", "hole_free", "damaged"), threshold, quiet_threshold (of calibration and hole_free),
    inspected_m2, detections, false_calls, scale_mm, surface_noise_mm, seconds_frames, seconds_detect.
    ``findings``: role ("hole_free", "damaged"), x_mm, y_mm, score, hole (the damage it counts for; "" for none).
    ``operating``: role, threshold, findings, hits: what would be found at other thresholds than the one in use, a grid
    that is the same for all runs of one variant and number of frames; hits are matched as at the one in use.
    ``pixels``: threshold, hole ("" for undamaged face), pixels (judged), above (of them with a score above it):
    damaged boards only, on a finer grid.
    """

    @property
    def holes(self) -> pd.DataFrame: ...
    @property
    def sites(self) -> pd.DataFrame: ...
    @property
    def runs(self) -> pd.DataFrame: ...
    @property
    def findings(self) -> pd.DataFrame: ...
    @property
    def operating(self) -> pd.DataFrame: ...
    @property
    def pixels(self) -> pd.DataFrame: ...
