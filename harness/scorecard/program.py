"""The scorecard from beginning to end: measure, judge, write, say."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from harness.scorecard.bench import FULL, QUICK
from harness.scorecard.curves import FULL_GRIDS, QUICK_GRIDS, CurvePoint, curve_points
from harness.scorecard.estimate import Estimate
from harness.scorecard.judge import Score, judged, read_baseline, write_baseline
from harness.scorecard.page import answer, scorecard_html
from harness.scorecard.plots import Curves, all_figures
from harness.scorecard.published import Figure, read_figures
from harness.scorecard.run import Request, measured, requests_of
from harness.scorecard.tables import curves_csv, print_scorecard, scores_csv
from harness.vocabulary.errors import UserError
from harness.vocabulary.files import write_text
from harness.vocabulary.provenance import record
from harness.vocabulary.versions import RESULTS_VERSION
from scenes.sensor.camera import camera_digest, camera_names, load_camera


@dataclass(frozen=True)
class ScorecardOptions:
    """What the user asked for; ``cameras`` empty for all, ``baseline`` None for no judgement by one."""

    cameras: tuple[str, ...]
    out: Path
    figures: Path
    baseline: Path | None
    quick: bool
    update_baseline: bool
    jobs: int
    command: str


def run_scorecard(options: ScorecardOptions) -> int:
    """Measure, print and write the scorecard. Returns 1 where a figure that passed in the baseline fails, else 0.

    Raises UserError for an unknown camera, a faulty figures file or baseline, and a folder that cannot be written.
    """
    began = time.perf_counter()
    options.out.mkdir(parents=True, exist_ok=True)
    if options.quick and options.update_baseline:
        raise UserError("--quick and --update-baseline: a baseline needs the whole effort", fix="leave one of them out")
    every, titles = read_figures(options.figures), _titles(options.cameras)
    figures = tuple(figure for figure in every if figure.entry.camera in titles)
    baseline = read_baseline(options.baseline) if options.baseline else {}
    points = tuple(curve_points(QUICK_GRIDS if options.quick else FULL_GRIDS))
    wanted = requests_of(tuple(titles), figures, points)
    found = measured(wanted, QUICK if options.quick else FULL, options.out / ".cache" / "renders", options.jobs)
    scores = _scores(figures, found, baseline)
    _write(options, titles, points, found, scores, time.perf_counter() - began)
    print_scorecard(scores)
    print(answer(scores, options.quick))
    print(f"wrote {options.out / 'scorecard.html'}")
    if options.update_baseline and options.baseline:
        write_baseline(options.baseline, scores, [figure.name for figure in every])
        print(f"wrote {options.baseline}")
        return 0
    return _said_what_fell_behind(scores, baseline, every) if options.baseline else 0


def _titles(names: Sequence[str]) -> dict[str, str]:
    """Titles of the chosen cameras, or of all, by name; load_camera refuses an unknown one."""
    return {name: load_camera(name).title for name in (dict.fromkeys(names) or camera_names())}


def _scores(
    figures: Sequence[Figure], found: Mapping[Request, Estimate], baseline: Mapping[str, bool]
) -> tuple[Score, ...]:
    simulated = {
        figure.name: found[Request(figure.entry.camera, figure.quantity.name, figure.conditions)] for figure in figures
    }
    return judged(figures, simulated, baseline)


def _write(
    options: ScorecardOptions,
    titles: Mapping[str, str],
    points: Sequence[CurvePoint],
    found: Mapping[Request, Estimate],
    scores: Sequence[Score],
    seconds: float,
) -> None:
    cameras = {name: camera_digest(load_camera(name)) for name in titles}
    provenance = {
        "results_version": RESULTS_VERSION,
        **record(options.command),
        "cameras": cameras,
        "figures": str(options.figures),
        "baseline": str(options.baseline),
        "effort": "quick" if options.quick else "full",
        "seconds": round(seconds, 1),
    }
    pictures = all_figures(Curves(titles, points, found), scores)
    write_text(options.out / "scorecard.csv", scores_csv(scores))
    write_text(options.out / "curves.csv", curves_csv(tuple(titles), points, found))
    write_text(options.out / "provenance.json", json.dumps(provenance, indent=2) + "\n")
    write_text(options.out / "scorecard.html", scorecard_html(titles, scores, pictures, provenance, options.quick))


def _said_what_fell_behind(scores: Sequence[Score], baseline: Mapping[str, bool], every: Sequence[Figure]) -> int:
    """The exit code; names the figures that passed before and fail now, and what the baseline does not know."""
    gone = sorted({name for name, passed in baseline.items() if passed} - {figure.name for figure in every})
    new = [score.figure.name for score in scores if score.passed_before is None]
    mended = [score.figure.name for score in scores if score.passed_before is False and score.passes]
    for names, what in ((new, "not in the baseline"), (mended, "pass now, not before")):
        if names:
            print(f"{what}: {', '.join(names)}; --update-baseline takes note", file=sys.stderr)
    for name in gone:
        print(f"passed in the baseline and is no longer among the figures: {name}", file=sys.stderr)
    fallen = [score for score in scores if score.regressed]
    for score in fallen:
        low, high = score.figure.entry.published.limits
        print(
            f"passed in the baseline and fails now: {score.figure.name} ({score.figure.what()}): simulated "
            f"{score.simulated.value:.4g}, passes from {low:g} to {high:g}",
            file=sys.stderr,
        )
    return 1 if fallen or gone else 0
