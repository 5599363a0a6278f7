"""The scorecard's page: one self-contained HTML file."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from harness.report.blocks import template
from harness.scorecard.judge import Score
from harness.scorecard.quantities import QUANTITIES
from harness.scorecard.tables import HEADS, score_cells

CAPTIONS = {
    "noise": "Temporal deviation: standard deviation over frames of one pixel's z, rms over pixels about the axis, "
    "noise alone, with 95 % intervals of a jackknife over frames; a rare wild range counts in full. Hollow: published. "
    "Fourth panel: the points of the other three against the amplitude; where they fall on one line, the amplitude "
    "alone decides.",
    "correlation": "Correlation of the temporal noise of pixels so far apart, at 1.5 m and albedo 80 %. "
    "Hollow: published figures, some for other distances and angles (see the table).",
    "valid": "Pixels about the axis that have a range, in percent, with every gate of the camera.",
    "edges": "A straight edge, its front at 0.75 m, slightly off the pixel grid; albedo 60 %. Widths in pixels across "
    "the edge. Flying: with a range that is off both surfaces by more than four deviations of the noise and a tenth of "
    "the step; not told where noise hides the step. Eroded: the pixel's central ray meets the surface and the camera "
    "does not show it; shadow included.",
    "survival": "Round plateaus before a plane, each at another place within its pixel: the lowest step of which at "
    "least half is seen in the middle, in most of them. Crosses: none of those tried, up to 500 mm.",
    "bias": "Left: mean error of z of unit 1 an hour after power-on on a plane without multipath. Right: a board of "
    "400 x 300 mm on a table with a wall behind, without noise and without traits of a unit; bars are what the "
    "render's Monte Carlo leaves.",
}
TITLES = {
    "noise": "Temporal noise",
    "correlation": "Spatial correlation of the noise",
    "bias": "Bias, multipath off and on",
    "edges": "Edges",
    "survival": "The smallest step that survives the camera's filter",
    "valid": "Valid pixels",
}


def scorecard_html(
    cameras: Mapping[str, str],
    scores: Sequence[Score],
    figures: Mapping[str, str],
    provenance: Mapping[str, Any],
    quick: bool = False,
) -> str:
    """The page as text; ``figures`` are SVG texts by name, ``cameras`` titles by name."""
    return template("scorecard.html", Path(__file__).parent).render(
        answer=answer(scores, quick),
        heads=HEADS,
        groups=[(title, _rows(scores, camera)) for camera, title in cameras.items()],
        figures=[(TITLES[name], name, figures[name], CAPTIONS[name]) for name in TITLES if name in figures],
        quantities=QUANTITIES.values(),
        provenance=told(provenance),
    )


def answer(scores: Sequence[Score], quick: bool = False) -> str:
    """One sentence: how many figures pass, apart for those that test and those that calibrate."""
    tests = [score for score in scores if not score.figure.entry.calibration]
    calibration = [score for score in scores if score.figure.entry.calibration]
    regressed = [score.figure.name for score in scores if score.regressed]
    text = "A quick look, with too few frames for a judgement: " if quick else ""
    text += f"{_passing(tests)} published figures that the models were not fitted to hold"
    if calibration:
        text += f", and {_passing(calibration)} that they were or may be fitted to"
    text += "."
    return text + (f" Passed before and fail now: {', '.join(regressed)}." if regressed else "")


def _passing(scores: Sequence[Score]) -> str:
    return f"{Counter(score.passes for score in scores)[True]} of {len(scores)}"


def _rows(scores: Sequence[Score], camera: str) -> list[tuple[str, tuple[str, ...], Score]]:
    """A camera's figures: the row's class, its cells, and the score."""
    own = [score for score in scores if score.figure.entry.camera == camera]
    return [("yes" if score.passes else "no", score_cells(score), score) for score in own]


def told(provenance: Mapping[str, Any]) -> list[tuple[str, str]]:
    def text(value: Any) -> str:
        if isinstance(value, Mapping):
            return ", ".join(f"{key} {one}" for key, one in value.items())
        return "not recorded" if value is None else str(value)

    return [(key, text(value)) for key, value in provenance.items()]
