"""A cloud that can be turned in the browser: an offline file with the findings and, if known, the
true damage."""

import base64
from pathlib import Path
from typing import Any

import numpy as np

from harness.records.examples import Circle3d, CircleKind, Scene3d
from harness.report.blocks import BLUE, DAMAGE, GREEN, GREY, ORANGE, PURPLE, RED, SKY, template
from harness.vocabulary.files import write_text

MOST_POINTS = 150_000
"""Most points that a page shows."""
VIEW_COLOURS = (BLUE, ORANGE, GREEN, RED, SKY, PURPLE, "#F0E442", "#332288", "#882255", "#44AA99")
"""Okabe and Ito's colours, then four of Tol's muted colours; further views repeat them from the
start."""
SEVERAL_CODE = 255
"""Stands for several views in the page's data."""
RESIDUAL_STEP_MM = 0.01
"""Residuals are integers of this unit in the page's data."""
MOST_STEPS = 32767
NO_RESIDUAL = -32768
"""Stands for a residual that was not judged."""
PLACE_STEPS = 65535
"""Steps of a coordinate over the bounding box: 0.01 mm over 0.6 m."""
LEAST_STEP_MM = 1e-9

KINDS: dict[CircleKind, tuple[str, str]] = {
    "found": ("damage, found", "#00a651"),
    "missed": ("damage, missed", ORANGE),
    "finding": ("finding", DAMAGE),
    "false call": ("finding that matches no damage", "#e0201b"),
}
"""Words and colour of each kind of ring."""


def write_view3d(path: Path, scene: Scene3d, title: str) -> Path:
    """Write a self-contained page that shows at most `MOST_POINTS` of the cloud (WebGL 1) and
    return its path. Raises UserError if the file cannot be written, ValueError if no point is
    finite."""
    write_text(Path(path), view3d_html(scene, title))
    return Path(path)


def view3d_html(scene: Scene3d, title: str) -> str:
    """Return the page as text; see `write_view3d`."""
    present = {circle.kind for circle in scene.circles}
    kinds = [(kind, words, colour) for kind, (words, colour) in KINDS.items() if kind in present]
    return template("view3d.html").render(
        title=title,
        facts=scene.facts,
        data=packed(scene),
        kinds=kinds,
    )


def packed(scene: Scene3d) -> dict[str, Any]:
    """Return the cloud as the page reads it: plain numbers, and arrays as base64 of little-endian
    numbers. Places are 16-bit integers within the bounding box."""
    shown = _shown(scene)
    # the page's frame has x right, y up, z to the viewer: half a turn about x from a camera's
    # frame
    turn = np.array([1.0, 1.0, 1.0] if scene.frame == "board" else [1.0, -1.0, -1.0])
    points_mm = scene.points_mm[shown].astype(float) * turn
    low_mm = points_mm.min(axis=0)
    high_mm = points_mm.max(axis=0)
    step_mm = np.maximum((high_mm - low_mm) / PLACE_STEPS, LEAST_STEP_MM)
    views = []
    if scene.view_of is not None:
        for number, name in enumerate(scene.view_names):
            views.append((name, VIEW_COLOURS[number % len(VIEW_COLOURS)]))
    return {
        "count": len(points_mm),
        "total": int(np.isfinite(scene.points_mm).all(axis=1).sum()),
        "low": [round(float(x), 6) for x in low_mm],
        "step": [float(x) for x in step_mm],
        "pitch": round(_pitch_mm(low_mm, high_mm, len(points_mm)), 4),
        "places": _base64(np.rint((points_mm - low_mm) / step_mm), "<u2"),
        "circles": [_ring(circle, turn) for circle in scene.circles],
        "views": views,
        "residual_step": RESIDUAL_STEP_MM,
        "several": GREY,
        "mark": DAMAGE,
        "frame": scene.frame,
        "shown": scene.shown,
        "key": scene.key,
        "rgb": None if scene.rgb is None else _base64(scene.rgb[shown], "<u1"),
        "residual": _residuals(scene.residual_mm, shown),
        "view": _views(scene.view_of, shown),
        "detected": None if scene.detected is None else _base64(scene.detected[shown], "<u1"),
    }


def _pitch_mm(low_mm: np.ndarray, high_mm: np.ndarray, count: int) -> float:
    """Return the mean distance between points across the line of sight, if they were spread evenly
    over their extent."""
    width_mm, height_mm, _ = high_mm - low_mm
    return float(np.sqrt(max(width_mm * height_mm, 1e-6) / count))


def _ring(circle: Circle3d, turn: np.ndarray) -> dict[str, Any]:
    return {
        "centre": [round(float(x), 3) for x in circle.centre_mm * turn],
        "normal": [round(float(x), 5) for x in circle.normal * turn],
        "diameter": round(float(circle.diameter_mm), 3),
        "label": circle.label,
        "kind": circle.kind,
        "colour": KINDS[circle.kind][1],
    }


def _residuals(residual_mm: np.ndarray | None, shown: np.ndarray) -> str | None:
    if residual_mm is None:
        return None
    steps = np.clip(np.rint(residual_mm[shown] / RESIDUAL_STEP_MM), -MOST_STEPS, MOST_STEPS)
    return _base64(np.where(np.isfinite(steps), steps, NO_RESIDUAL), "<i2")


def _views(view_of: np.ndarray | None, shown: np.ndarray) -> str | None:
    if view_of is None:
        return None
    numbers = view_of[shown]
    return _base64(np.where(numbers < 0, SEVERAL_CODE, numbers % SEVERAL_CODE), "<u1")


def _shown(scene: Scene3d) -> np.ndarray:
    """Return the indices of the points to show, ascending: of too many, those of findings and a
    sample of the others."""
    finite = np.flatnonzero(np.isfinite(scene.points_mm).all(axis=1))
    if not len(finite):
        raise ValueError("no finite point to show")
    if len(finite) <= MOST_POINTS:
        return finite
    is_finding = np.zeros(len(finite), bool)
    if scene.detected is not None:
        is_finding = scene.detected[finite]
    findings = finite[is_finding][:MOST_POINTS]
    unmarked = finite[~is_finding]
    shuffled = np.random.default_rng(0).permutation(len(unmarked))
    sample = unmarked[shuffled[: MOST_POINTS - len(findings)]]
    return np.sort(np.concatenate([findings, sample]))


def _base64(values: np.ndarray, dtype: str) -> str:
    return base64.b64encode(np.ascontiguousarray(values).astype(dtype).tobytes()).decode("ascii")
