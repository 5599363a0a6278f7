"""Pieces of a part behind something that lies in front of it."""

import numpy as np
import pytest

from detectors.surfaces.pieces import joined_pieces, part_text, piece_facts

SHAPE = (40, 90)
FOCAL_PX = 100.0
APART_M = 4e-3


def _plane(offset_m: float = 0.0) -> np.ndarray:
    """Points (h, w, 3) of a plane z = 1 + 0.2 x + offset."""
    v, u = np.mgrid[: SHAPE[0], : SHAPE[1]]
    x = (u - 45.0) / FOCAL_PX
    y = (v - 20.0) / FOCAL_PX
    z = (1.0 + offset_m) / (1.0 - 0.2 * x)
    return np.stack([x * z, y * z, z], axis=-1)


@pytest.mark.parametrize(
    ("between_m", "step_m", "groups"),
    [
        (-0.1, 0.0, [[0, 1]]),
        (0.1, 0.0, [[0], [1]]),
        (-0.1, 0.5 * APART_M, [[0, 1]]),
        (-0.1, 20 * APART_M, [[0], [1]]),
    ],
)
def test_pieces_of_one_surface_belong_together_unless_a_background_shows_between_them(
    between_m: float, step_m: float, groups: list[list[int]]
) -> None:
    """The strip between them is ``between_m`` behind, and the right piece ``step_m``."""
    points_m = _plane()
    points_m[:, 60:] = _plane(step_m)[:, 60:]
    points_m[:, 30:60] = _plane(between_m)[:, 30:60]
    masks = np.zeros((2, *SHAPE), bool)
    masks[0, :, :30] = True
    masks[1, :, 60:] = True
    assert joined_pieces(list(masks), points_m, APART_M, 2) == groups


def test_facts_of_pieces_by_hand() -> None:
    part = np.zeros((20, 60), bool)
    part[:10, :12] = True
    part[:, 20:50] = True
    part[0, 55] = True  # too small to count
    pixel_m2 = np.full(part.shape, 1e-6)
    pixel_m2[:, 20:50] = 2e-6
    residual_m = np.zeros(part.shape)
    residual_m[:5, :12] = np.nan
    residual_m[:, 20:26] = np.nan
    large, small = piece_facts(part, pixel_m2, residual_m, "plane")
    assert large == {"area_m2": pytest.approx(1.2e-3), "share": pytest.approx(0.8), "fit": "plane"}
    assert small == {"area_m2": pytest.approx(1.2e-4), "share": pytest.approx(0.5), "fit": "plane"}
    text = "part: 2 pieces, 0.0013 m2 seen, 77 % of it judged"
    assert part_text([large, small]) == text
