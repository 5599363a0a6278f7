"""Match detections to damage: nearest centre within a stated radius, one to one; the rest are false calls."""

from __future__ import annotations

import numpy as np


def match(truth_m: np.ndarray, found_m: np.ndarray, radius_m: float) -> dict[int, int]:
    """Pairs {index of truth: index of finding}, closest pairs first, none farther apart than ``radius_m``. ``truth_m``
    (n, d) and ``found_m`` (m, d) are centres in one frame; findings with NaN match nothing. Ties: lower index first."""
    if len(truth_m) == 0 or len(found_m) == 0:
        return {}
    distance = np.linalg.norm(truth_m[:, None] - found_m[None], axis=-1)
    pairs: dict[int, int] = {}
    taken: set[int] = set()
    near = np.flatnonzero(distance <= radius_m)
    for flat in near[np.argsort(distance.reshape(-1)[near], kind="stable")]:
        t, f = divmod(int(flat), len(found_m))
        if t not in pairs and f not in taken:
            pairs[t] = f
            taken.add(f)
    return pairs
