"""Match detections to damage: nearest within a stated distance, one to one; the rest are false
calls."""

import numpy as np


def match(truth_m: np.ndarray, found_m: np.ndarray, radius_m: float) -> dict[int, int]:
    """Return pairs {index of truth: index of finding} of centres (n, d), (m, d) in one frame; see
    `closest_pairs`."""
    return closest_pairs(np.linalg.norm(truth_m[:, None] - found_m[None], axis=-1), radius_m)


def closest_pairs(apart: np.ndarray, most: float) -> dict[int, int]:
    """Return pairs {index of truth: index of finding} from the distances (n, m) between damages
    and findings: closest pairs first, each used once, none farther apart than ``most``; NaN
    matches nothing. Ties: lower index first."""
    pairs: dict[int, int] = {}
    taken: set[int] = set()
    near = np.flatnonzero(apart <= most)
    for flat in near[np.argsort(apart.reshape(-1)[near], kind="stable")]:
        t, f = divmod(int(flat), apart.shape[1])
        if t not in pairs and f not in taken:
            pairs[t] = f
            taken.add(f)
    return pairs
