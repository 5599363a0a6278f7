"""A cloud that can be turned in the browser: an offline file with the findings and, if known, the
true damage."""

import base64
from pathlib import Path
from typing import Any

import numpy as np

from harness.records.examples import CircleKind, Scene3d
from harness.report.blocks import BLUE, DAMAGE, GREEN, GREY, ORANGE, PURPLE, RED, SKY, template
from harness.vocabulary.files import write_text

MOST_POINTS = 150_000
VIEW_COLOURS = (BLUE, ORANGE, GREEN, RED, SKY, PURPLE, "#F0E442", "#332288", "#882255", "#44AA99")
"""Okabe and Ito's colours, then four of Tol's muted colours; further views repeat them from the
start."""
SEVERAL_CODE = 255
RESIDUAL_STEP_MM = 0.01
NO_RESIDUAL = -32768

KINDS: dict[CircleKind, tuple[str, str]] = {
    "found": ("damage, found", "#00a651"),
    "missed": ("damage, missed", ORANGE),
    "finding": ("finding", DAMAGE),
    "false call": ("finding that matches no damage", "#e0201b"),
}


def write_view3d(path: Path, scene: Scene3d, title: str) -> Path:
    """Write a self-contained page that shows at most `MOST_POINTS` of the cloud (WebGL 1) and
    return its path. Raises UserError if the file cannot be written, ValueError if no point is
    finite."""
    write_text(Path(path), view3d_html(scene, title))
    return Path(path)


def view3d_html(scene: Scene3d, title: str) -> str:
    """Return the page as text; see `write_view3d`."""
    present = {circle.kind for circle in scene.circles}
    kinds = [(kind, *words) for kind, words in KINDS.items() if kind in present]
    return template("view3d.html").render(
        title=title, facts=scene.facts, data=packed(scene), kinds=kinds
    )


def packed(scene: Scene3d) -> dict[str, Any]:
    """Return the cloud as the page reads it: plain numbers, and arrays as base64 of little-endian
    numbers. Places are 16-bit integers within the bounding box, which gives steps of 0.01 mm over
    0.6 m."""
    kept = _kept(scene)
    # The page's frame has x right, y up, z to the viewer: half a turn about x from a camera's
    # frame.
    turn = np.array([1.0, 1.0, 1.0] if scene.frame == "board" else [1.0, -1.0, -1.0])
    points = scene.points_mm[kept].astype(float) * turn
    low = points.min(axis=0)
    high = points.max(axis=0)
    step = np.maximum((high - low) / 65535, 1e-9)
    # mean distance between points across the line of sight, if they were spread evenly over their
    # extent
    span = high[:2] - low[:2]
    pitch = float(np.sqrt(max(span[0] * span[1], 1e-6) / len(points)))
    residual = view = None
    if scene.residual_mm is not None:
        steps = np.clip(np.rint(scene.residual_mm[kept] / RESIDUAL_STEP_MM), -32767, 32767)
        residual = _base64(np.where(np.isfinite(steps), steps, NO_RESIDUAL), "<i2")
    if scene.view_of is not None:
        view = _base64(
            np.where((number := scene.view_of[kept]) < 0, SEVERAL_CODE, number % SEVERAL_CODE),
            "<u1",
        )
    views = [(name, VIEW_COLOURS[n % len(VIEW_COLOURS)]) for n, name in enumerate(scene.view_names)]
    circles = [
        {
            "centre": [round(float(x), 3) for x in circle.centre_mm * turn],
            "normal": [round(float(x), 5) for x in circle.normal * turn],
            "diameter": round(float(circle.diameter_mm), 3),
            "label": circle.label,
            "kind": circle.kind,
            "colour": KINDS[circle.kind][1],
        }
        for circle in scene.circles
    ]
    return {
        "count": len(points),
        "total": int(np.isfinite(scene.points_mm).all(axis=1).sum()),
        "low": [round(float(x), 6) for x in low],
        "step": [float(x) for x in step],
        "pitch": round(pitch, 4),
        "places": _base64(np.rint((points - low) / step), "<u2"),
        "circles": circles,
        "views": [] if view is None else views,
        "residual_step": RESIDUAL_STEP_MM,
        "several": GREY,
        "mark": DAMAGE,
        "frame": scene.frame,
        "shown": scene.shown,
        "key": scene.key,
        "rgb": None if scene.rgb is None else _base64(scene.rgb[kept], "<u1"),
        "residual": residual,
        "view": view,
        "detected": None if scene.detected is None else _base64(scene.detected[kept], "<u1"),
    }


def _kept(scene: Scene3d) -> np.ndarray:
    """Return the indices of the points to show, ascending."""
    finite = np.flatnonzero(np.isfinite(scene.points_mm).all(axis=1))
    if not len(finite):
        raise ValueError("no finite point to show")
    if len(finite) <= MOST_POINTS:
        return finite
    first = np.zeros(len(scene.points_mm), bool) if scene.detected is None else scene.detected
    marked = finite[first[finite]][:MOST_POINTS]
    unmarked = finite[~first[finite]]
    sample = np.random.default_rng(0).permutation(len(unmarked))[: MOST_POINTS - len(marked)]
    return np.sort(np.concatenate([marked, unmarked[sample]]))


def _base64(values: np.ndarray, dtype: str) -> str:
    return base64.b64encode(np.ascontiguousarray(values).astype(dtype).tobytes()).decode("ascii")
