"""How deep a hole looks off its axis, by what its walls are like: ``python
tests/validation/hole_walls.py``.

Parallel rays enter the mouth of a round hole. Light and camera have one direction, so a ray that
mirrors goes back as it came. Each meeting with a wall returns a diffuse share of its light, by
Lambert's law, and mirrors another; the bottom is diffuse. ``depth``: mean of the extra distance,
weighted by the light that returns it. ``peak``: the same in a pixel of which the mouth fills
``SHARE`` seen straight on, the rest being face. Not modelled: diffuse light from wall to wall, the
camera's filter, a baseline, rough mirrors.
"""

from __future__ import annotations

import numpy as np

DIAMETER_MM = 4.9
DEPTH_MM = 12.7
SHARE = 0.5
FACE = 0.5
RAYS = 40_000
MOST_MIRRORED = 60
ANGLES_DEG = 10.0, 28.0, 47.0
WALLS = {
    "as the face": (0.5, 0.0),
    "dark": (0.1, 0.0),
    "glossy paint": (0.4, 0.3),
    "bare metal": (0.15, 0.7),
}
"""Diffuse and mirrored share of the light that meets a wall."""


def seen(angle_deg: float, diffuse: float, mirrored: float) -> tuple[float, float]:
    """Return depth and peak in mm of a blind hole whose axis makes this angle with the line of
    sight."""
    random = np.random.default_rng(1)
    radius = DIAMETER_MM / 2
    turn = random.uniform(0, 2 * np.pi, RAYS)
    out = radius * np.sqrt(random.uniform(0, 1, RAYS))
    position = np.stack([out * np.cos(turn), out * np.sin(turn), np.zeros(RAYS)], axis=1)
    slant = np.radians(angle_deg)
    along = np.tile([np.sin(slant), 0.0, np.cos(slant)], (RAYS, 1))
    far = np.zeros(RAYS)
    light = np.ones(RAYS)
    total = weighted = 0.0
    for _ in range(MOST_MIRRORED):
        across = position[:, :2]
        onward = along[:, :2]
        square = (onward**2).sum(axis=1)
        cross = (across * onward).sum(axis=1)
        step = (
            -cross
            + np.sqrt(np.maximum(cross**2 + square * (radius**2 - (across**2).sum(axis=1)), 0.0))
        ) / square
        to_bottom = (DEPTH_MM - position[:, 2]) / along[:, 2]
        ends = step > to_bottom
        back = light[ends] * FACE * along[ends, 2]
        total = total + back.sum()
        weighted = weighted + (back * (far + to_bottom)[ends]).sum()
        position = position[~ends]
        along = along[~ends]
        far = far[~ends]
        light = light[~ends]
        if not len(far):
            break
        position = position + step[~ends, None] * along
        far = far + step[~ends]
        inward = -np.column_stack([position[:, :2] / radius, np.zeros(len(far))])
        cosine = np.maximum(-(along * inward).sum(axis=1), 0.0)
        back = light * diffuse * cosine
        total = total + back.sum()
        weighted = weighted + (back * far).sum()
        along = along + 2 * cosine[:, None] * inward
        light = light * mirrored**2
        position[:, :2] *= 1 - 1e-9
    depth_mm = weighted / total
    bright = total / RAYS / (FACE * np.cos(slant))
    share = SHARE * np.cos(slant)
    return depth_mm, share * bright * depth_mm / (share * bright + 1 - share)


if __name__ == "__main__":
    print(
        "walls          depth and peak / mm at "
        + ", ".join(f"{angle:g}" for angle in ANGLES_DEG)
        + " degrees"
    )
    for name, shares in WALLS.items():
        print(
            f"{name:14}", *("{:6.2f} {:5.2f}".format(*seen(angle, *shares)) for angle in ANGLES_DEG)
        )
