"""Rigid motions: the transform of paired points, and small motions about a centre."""

import numpy as np
from scipy.spatial.transform import Rotation


def kabsch(
    from_m: np.ndarray,
    to_m: np.ndarray,
    weights: np.ndarray,
) -> np.ndarray:
    """Return the proper least-squares rigid transforms (..., 4, 4) of points (..., n, 3) onto
    (..., n, 3), with ``weights`` (..., n) of 0 or more. The rotation of points on a line about it
    is undetermined and arbitrary."""
    share = (weights / weights.sum(axis=-1, keepdims=True))[..., None]
    from_centre = (share * from_m).sum(axis=-2)
    to_centre = (share * to_m).sum(axis=-2)
    from_arm = share * (from_m - from_centre[..., None, :])
    to_arm = to_m - to_centre[..., None, :]
    spread = np.swapaxes(from_arm, -1, -2) @ to_arm
    u, _, vt = np.linalg.svd(spread)
    signs = np.ones(spread.shape[:-1])
    signs[..., 2] = np.sign(np.linalg.det(u) * np.linalg.det(vt))
    T = np.zeros((*spread.shape[:-2], 4, 4))
    R = np.swapaxes(vt, -1, -2) @ (signs[..., None] * np.swapaxes(u, -1, -2))
    T[..., :3, :3] = R
    T[..., :3, 3] = to_centre - np.einsum("...ij,...j->...i", R, from_centre)
    T[..., 3, 3] = 1.0
    return T


def displacement_jacobian(points_m: np.ndarray, centre_m: np.ndarray) -> np.ndarray:
    """Return the derivatives (n, 3, 6) of points (n, 3), reference frame, by the error (w, t) of
    `detectors.views.registration.registered.Registration`."""
    arm = np.asarray(points_m) - centre_m
    jacobian = np.zeros((len(arm), 3, 6))
    # w x r = -[r]x w
    jacobian[:, 0, 1] = arm[:, 2]
    jacobian[:, 0, 2] = -arm[:, 1]
    jacobian[:, 1, 0] = -arm[:, 2]
    jacobian[:, 1, 2] = arm[:, 0]
    jacobian[:, 2, 0] = arm[:, 1]
    jacobian[:, 2, 1] = -arm[:, 0]
    jacobian[:, [0, 1, 2], [3, 4, 5]] = 1.0
    return jacobian


def moved_by(motion: np.ndarray, centre_m: np.ndarray) -> np.ndarray:
    """Return the transform (4, 4) of a motion (w, t) about a centre (3,): a rotation by the vector
    w, then a shift."""
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec(motion[:3]).as_matrix()
    T[:3, 3] = centre_m - T[:3, :3] @ centre_m + motion[3:]
    return T
