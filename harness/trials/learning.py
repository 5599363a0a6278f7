"""Lets a detector (`detectors.interface.Calibratable`) learn from hole-free boards before its
threshold is set.

The journal stores the learned state, for resuming and shards; a file named after its key holds it
for trials."""

import base64
import io
from dataclasses import replace
from typing import cast

import numpy as np

from detectors.interface import Calibratable
from harness.trials.judge import Rows, detector_of
from harness.trials.trial import TrialTask, cloud_of

LEARNING_BOARDS = (
    8  # boards to learn from: at 0.7 m, 200,000 pixels each give a spectrum to a few per cent
)


def learn(task: TrialTask) -> Rows:
    """Return the record of what a task's detector learns from its `LEARNING_BOARDS` boards: an
    ``.npz`` in base 64."""
    (point,), views = task.points, len(task.set_ups) // LEARNING_BOARDS
    boards = (
        replace(task, set_ups=task.set_ups[number * views : (number + 1) * views], repeat=number)
        for number in range(LEARNING_BOARDS)
    )
    clouds = [cloud_of(board, point) for board in boards]
    learned = cast("Calibratable", detector_of(point.detector, point.settings_json)).calibrate(
        clouds
    )
    file = io.BytesIO()
    np.savez_compressed(file, **dict(learned))  # type: ignore[arg-type]
    return {"runs": [], "learned": [{"arrays": base64.b64encode(file.getvalue()).decode()}]}


def learned_file(record: Rows) -> bytes:
    """Return the ``.npz`` that a record of `learn` holds."""
    return base64.b64decode(record["learned"][0]["arrays"])
