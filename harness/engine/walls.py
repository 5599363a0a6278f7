"""The shares of each hole's wall that no view sees in light, from the poses of an experiment's views alone."""

from __future__ import annotations

import numpy as np
import pandas as pd

from harness.evaluation.walls import shadowed_shares
from harness.experiment.points import Experiment
from harness.experiment.schema import SimulatedSource
from harness.vocabulary.geometry import invert, transform_points
from scenes.perspectives import poses_of
from scenes.sensor.camera import camera_of
from scenes.target.truth import truth_of


def wall_rows(experiment: Experiment) -> pd.DataFrame:
    """A row for each hole and number of views of the experiment's own set-ups (columns: `harness.evaluation.walls`);
    empty where it has no views."""
    set_ups = [point for point in experiment.points if not point.is_variation and point.config.mapping is not None]
    if not set_ups:
        return pd.DataFrame()
    source = set_ups[0].config.source
    assert isinstance(source, SimulatedSource)
    assert source.views is not None
    target = source.target.declare()
    boards = [invert(pose.T_camera_board) for pose in poses_of(source.views, target.pose)]
    emitter_m = camera_of(source.camera).optics.emitter_m
    mappings = (point.config.mapping for point in set_ups)
    counts = sorted({mapping.views or len(boards) for mapping in mappings if mapping is not None})
    lenses = [T_board_camera[:3, 3] for T_board_camera in boards]
    emitters = [transform_points(T_board_camera, emitter_m) for T_board_camera in boards]
    rows = []
    for damage in truth_of(target, invert(boards[0])):
        if damage.kind != "dent":
            mouth = (damage.centre_board_m, damage.diameter_m, damage.depth_m)
            shares = shadowed_shares(np.array(lenses), np.array(emitters), *mouth, counts)
            rows += [{"hole": str(damage.id), **row} for row in shares]
    return pd.DataFrame(rows)
