"""Match detections to damage: nearest within a stated distance, one to one; the rest are false
calls."""

import numpy as np


def match(
    truth_m: np.ndarray,
    finding_m: np.ndarray,
    radius_m: float,
) -> dict[int, int]:
    """Return pairs {index of truth: index of finding} of centres (n, d), (m, d) in one frame; see
    `closest_pairs`."""
    offset_m = truth_m[:, None] - finding_m[None]
    return closest_pairs(np.linalg.norm(offset_m, axis=-1), radius_m)


def closest_pairs(distance: np.ndarray, limit: float) -> dict[int, int]:
    """Return pairs {index of truth: index of finding} from the distances (n, m) between damages
    and findings: closest pairs first, each used once, none farther apart than ``limit``; NaN
    matches nothing. Ties: lower index first."""
    pairs: dict[int, int] = {}
    matched_findings: set[int] = set()
    candidates = np.flatnonzero(distance <= limit)
    order = np.argsort(distance.reshape(-1)[candidates], kind="stable")
    for flat_index in candidates[order]:
        truth, finding = divmod(int(flat_index), distance.shape[1])
        if truth not in pairs and finding not in matched_findings:
            pairs[truth] = finding
            matched_findings.add(finding)
    return pairs
