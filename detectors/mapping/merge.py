"""Merging by whichever way its settings name."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from detectors.mapping.settings import AnyMerge
from detectors.registration.registered import Registration
from detectors.views import PreparedView
from harness.vocabulary.capture import Cloud


@dataclass(frozen=True)
class Merged:
    """One cloud of several views. ``T_reference_cloud`` (4, 4): its frame to the first view's camera frame, the
    identity where it is that frame. ``views_used``: names of those that went in. ``seconds``: of merging."""

    cloud: Cloud
    T_reference_cloud: np.ndarray
    views_used: tuple[str, ...]
    seconds: float
    notes: tuple[str, ...] = ()


def merge(views: Sequence[PreparedView], registrations: Sequence[Registration], config: AnyMerge) -> Merged:
    """The views whose registration did not fail as one cloud; works for a single view too.

    Raises UserError where nothing is left to merge.
    """
    raise NotImplementedError
