"""Random places for damage on a board: apart from one another, off its edge and off its tape."""

from __future__ import annotations

import numpy as np

from harness.vocabulary.errors import UserError
from scenes.target.custom import BoardConfig, TapeConfig

ATTEMPTS, TRIES = 50, 400
"""Boards begun anew, and places tried for each damage of one: with discs of the diameter ``apart_mm`` over 40 % of the
free area (the most that random placement reaches is 54.7 %) one attempt in three or more fills a board."""


def random_places_mm(
    board: BoardConfig,
    tapes: tuple[TapeConfig, ...],
    count: int,
    *,
    apart_mm: float,
    margin_mm: float,
    rim_mm: float,
    rng: np.random.Generator,
) -> np.ndarray:
    """(count, 2) centres in plan by random sequential placement, uniform on what is free: at least ``apart_mm`` from
    one another, ``margin_mm`` from the board's edge and ``rim_mm`` from any tape.

    Raises UserError with the numbers where the board is too full for them.
    """
    half = free_half_mm(board, margin_mm)
    best = 0
    for _ in range(ATTEMPTS if half.min() >= 0 else 0):
        places = np.empty((0, 2))
        while len(places) < count:
            tried = half * rng.uniform(-1.0, 1.0, (TRIES, 2))
            free = off_tapes(tried, tapes, rim_mm)
            free &= (np.linalg.norm(tried[:, None] - places, axis=-1) >= apart_mm).all(axis=1)
            if not free.any():
                break
            places = np.vstack([places, tried[np.argmax(free)]])
        best = max(best, len(places))
        if best == count:
            return places
    size = f"{max(2 * half[0], 0.0):g} x {max(2 * half[1], 0.0):g} mm"
    raise UserError(
        f"a board of {board.width_mm:g} x {board.height_mm:g} mm is too full for {count} damages whose centres are "
        f"{apart_mm:g} mm apart and {margin_mm:.4g} mm off its edge: {best} found a place on the {size} that are left",
        legal=f"fewer than {best} damages on this board" if best > 1 else None,
        fix="lower damage.per_board, damage.diameter_mm, apart_mm or edge_mm, or declare a larger board",
    )


def free_half_mm(board: BoardConfig, margin_mm: float) -> np.ndarray:
    """(2,) half the width and height of the rectangle in which centres may lie; negative where there is none."""
    return np.array([board.width_mm, board.height_mm]) / 2 - margin_mm


def off_tapes(places_mm: np.ndarray, tapes: tuple[TapeConfig, ...], rim_mm: float) -> np.ndarray:
    """(n,) bool: which of places (n, 2) are farther than ``rim_mm`` from every strip of tape, in plan."""
    free = np.ones(len(places_mm), bool)
    for tape in tapes:
        angle = np.deg2rad(tape.angle_deg)
        turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        beyond = np.abs((places_mm - tape.centre_mm) @ turn) - np.array(tape.size_mm) / 2
        free &= np.linalg.norm(np.maximum(beyond, 0.0), axis=-1) > rim_mm
    return free
