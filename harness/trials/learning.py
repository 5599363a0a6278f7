"""Lets a detector (`detectors.interface.Calibratable`) learn from hole-free boards before its
threshold is set.

The journal stores the learned state, for resuming and shards; a file named after its key holds it
for trials."""

import base64
import io
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from detectors.interface import Calibratable
from harness.trials.judge import detector_of
from harness.trials.trial import Trial, cloud_of

# boards to learn from: at 0.7 m, 200,000 pixels each give a spectrum to a few per cent
LEARNING_BOARDS = 8


def learn(trial: Trial) -> dict[str, list[dict[str, Any]]]:
    """Return the record of what a trial's detector learns from its `LEARNING_BOARDS` boards, whose
    views follow one another: an ``.npz`` in base 64."""
    (point,) = trial.points
    views = len(trial.views) // LEARNING_BOARDS
    clouds = []
    for number in range(LEARNING_BOARDS):
        own_views = trial.views[number * views : (number + 1) * views]
        earlier = trial.references.earlier[number : number + 1]
        own_references = replace(trial.references, earlier=earlier)
        own = replace(trial, views=own_views, references=own_references, repeat=number)
        clouds.append(cloud_of(own, point))
    detector = detector_of(point.criteria.detector, point.criteria.settings_json)
    if not isinstance(detector, Calibratable):
        raise TypeError(f"the detector {point.criteria.detector!r} does not learn")
    file = io.BytesIO()
    np.savez_compressed(file, **dict(detector.calibrate(clouds)))  # type: ignore[arg-type]
    arrays = base64.b64encode(file.getvalue()).decode()
    return {"runs": [], "learned": [{"arrays": arrays}]}


def learned_file(record: Mapping[str, Sequence[Mapping[str, Any]]]) -> bytes:
    """Return the ``.npz`` that a record of `learn` holds."""
    return base64.b64decode(record["learned"][0]["arrays"])
