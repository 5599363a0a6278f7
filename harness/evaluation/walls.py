"""The share of a hole's wall that no view can see: pure geometry of mouths, lenses and emitters.

A straight bore with a circular mouth of radius r in the plane z = 0. A wall point at depth t and azimuth e (a unit
vector) looks at a lens at height H above the mouth and L beside its centre through the point of the mouth at
(1 - s) r e + s L with s = t / (t + H). That lies inside the mouth where

    s <= 2 r (r - e . L) / |L - r e|^2,

so each azimuth is seen from the rim down to one depth, and the shares need an average over azimuths only.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from harness.vocabulary.units import MM

AZIMUTHS = 1440
"""Directions around the wall; the mean over them is off by less than 1e-5 of the wall's area."""


def shadowed_shares(
    lens_board_m: np.ndarray,
    emitter_board_m: np.ndarray,
    centre_board_m: np.ndarray,
    diameter_m: float,
    depth_m: float,
    counts: Iterable[int],
) -> list[dict[str, float]]:
    """One row for each of ``counts``, which takes the first so many views.

    ``lens_board_m`` and ``emitter_board_m`` (n, 3): where each view's lens and light stand, board frame (z out of the
    face); ``centre_board_m`` (3,): the mouth's centre. Rows: ``views``; ``true_diameter_mm``;
    ``depth_mm``; ``unseen_share``, the share of the wall's area that no lens sees through the mouth;
    ``shadowed_share``, the share that is unseen or unlit in every view.

    Not modelled: the size of lens and emitter, the pixel's footprint, light that reaches the wall by another wall, a
    mouth on a curved face (its tangent plane stands in for it). Raises ValueError for a lens or an emitter that does
    not stand before the face, or for a count without so many views.
    """
    lenses, emitters = (np.atleast_2d(np.asarray(places, float)) for places in (lens_board_m, emitter_board_m))
    counts = list(counts)
    if not all(1 <= count <= len(lenses) for count in counts):
        raise ValueError(f"counts {counts} of {len(lenses)} views")
    seen = _seen_depths(lenses - centre_board_m, diameter_m / 2)
    lit = _seen_depths(emitters - centre_board_m, diameter_m / 2)
    both = np.minimum(seen, lit)
    return [
        {
            "views": count,
            "true_diameter_mm": diameter_m / MM,
            "depth_mm": depth_m / MM,
            "unseen_share": _missing(seen[:count], depth_m),
            "shadowed_share": _missing(both[:count], depth_m),
        }
        for count in counts
    ]


def _seen_depths(places_m: np.ndarray, radius_m: float) -> np.ndarray:
    """(n, AZIMUTHS): down to which depth each place, relative to the mouth's centre, sees the wall; 0 where not."""
    beside, height = places_m[:, None, :2], places_m[:, None, 2]
    if not (height > 0).all():
        raise ValueError("a lens or an emitter does not stand before the face")
    turn = (np.arange(AZIMUTHS) + 0.5) * 2 * np.pi / AZIMUTHS
    out = np.stack([np.cos(turn), np.sin(turn)], axis=-1)
    towards = (beside * out).sum(axis=-1)
    apart2 = ((beside - radius_m * out) ** 2).sum(axis=-1)
    share = np.maximum(2 * radius_m * (radius_m - towards), 0.0) / np.maximum(apart2, np.finfo(float).tiny)
    with np.errstate(over="ignore"):
        return np.where(share < 1, height * share / np.maximum(1 - share, np.finfo(float).tiny), np.inf)


def _missing(depths_m: np.ndarray, depth_m: float) -> float:
    return float(1 - np.minimum(depths_m.max(axis=0) / depth_m, 1.0).mean())
