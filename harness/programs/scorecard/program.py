"""Runs the scorecard: it measures, judges and draws, writes the table and the page, and names
failures."""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from harness.programs.scorecard import figures as scoring
from harness.programs.scorecard import power
from harness.programs.scorecard.bench import FULL
from harness.programs.scorecard.families import FAMILIES, OFF, FamilyScore, family_scores
from harness.programs.scorecard.quantities import QUANTITIES
from harness.programs.scorecard.standings import STANDINGS, standings
from harness.records.schema import write_table
from harness.report.blocks import (
    BLUE,
    GREY,
    RED,
    bullets,
    command_of,
    figure,
    fold,
    heading,
    note,
    page,
    paragraph,
    plain,
    svg,
    tag,
)
from harness.vocabulary.files import write_json, write_text
from harness.vocabulary.path_names import camera_title
from harness.vocabulary.provenance import RESULTS_VERSION, record
from harness.vocabulary.seeds import digest
from harness.vocabulary.text import show
from scenes.sensor.camera import load_camera

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Canvas

HOW = (
    "Each quantity is measured on simulated frames as it was on the real camera, under the "
    "conditions of the source. A figure of a real camera passes if the simulated value lies "
    "within 25 % of the published value; if the source states a wider tolerance, that applies, "
    "the verdict says so, and the column `strict` says no. A bound must hold. "
    "Blind: nothing was fitted to the figure. "
    "Calibration: the camera file was, or may have been, fitted to it, so it is not a test. Tags "
    "of sources: R read for this project in the named public source, D derived from such a "
    "source, S a single secondary source, W measured on public captures, M from memory or a guess."
)
CHECKS = (
    "These checks compare the program with the arithmetic of a stated filter, gate or limit of "
    "the camera file. They say nothing about real cameras and pass only within their tolerance."
)
FAMILY_NOTE = (
    f"Each family's figures differ in one condition. A family agrees if the geometric mean of its "
    f"ratios lies within {100 * OFF:.0f} % of 1, and if it has no trend: the slope of the "
    "logarithm of the ratio on that of the condition (of 1 / cos for an angle) has a 95 % "
    f"interval that contains 0, or changes the ratio by less than {100 * OFF:.0f} % along the "
    "family."
)
POWER_NOTE = " ".join((power.__doc__ or "").partition("\n\n")[2].split())
CAPTION = (
    "Simulated divided by published value with its 95 % interval; the band extends 25 % to either "
    "side. Blue passes, red fails; hollow marks are figures to which the camera file was fitted. "
    "Bounds and values of 0 have no ratio."
)
GROUPS = {
    "azure": "Azure Kinect",
    "femto": "Femto",
    "kinect": "Kinect v2",
    "realsense": "RealSense L515",
}
"""Groups of cameras by the first word of their names; the other cameras are counted together."""


def run_scorecard(options: argparse.Namespace, command: str) -> int:
    """Measure, print and write the scorecard. Returns 1 if a figure or family fails and its entry
    gives no reason, or if the constants that nothing notices are not those on file; else 0. Raises
    UserError for an unknown camera, a faulty file of figures, or a folder that cannot be
    written."""
    began = time.perf_counter()
    options.out.mkdir(parents=True, exist_ok=True)
    file = scoring.read_figures(options.figures or scoring.FIGURES_FILE)
    names = dict.fromkeys(options.camera) or dict.fromkeys(figure.camera for figure in file.figures)
    titles = {name: load_camera(name).title for name in names}
    figures = [figure for figure in file.figures if figure.camera in titles]
    readings = scoring.measured(
        dict.fromkeys(figure.request for figure in figures), FULL, options.jobs
    )
    scores = [scoring.Score(figure, readings[figure.request]) for figure in figures]
    families = family_scores(file.families, scores)
    moved = power.power_of(file, list(titles), options.jobs) if options.power else []
    provenance = {
        "results_version": RESULTS_VERSION,
        **record(command),
        "cameras": {name: digest(load_camera(name).to_data()) for name in titles},
        "figures": str(options.figures or scoring.FIGURES_FILE),
        "seconds": round(time.perf_counter() - began, 1),
    }
    answer = " ".join([_answer(scores), *_family_answer(families), *_power_answer(moved)])
    card = Scorecard(scores, families, moved, titles)
    write_table(options.out, scoring.SCORES, scoring.SCORES.frame(scores))
    write_table(options.out, FAMILIES, FAMILIES.frame(families))
    write_table(options.out, power.POWER, power.POWER.frame(moved))
    write_json(options.out / "provenance.json", provenance)
    write_text(options.out / "scorecard.html", _page(answer, card, provenance, command))
    grids = [
        scoring.SCORES.grid(scores, terminal=True),
        STANDINGS.grid(standings(scores)),
        FAMILIES.grid(families, terminal=True),
        power.POWER.grid(moved, terminal=True),
    ]
    show([grid for grid in grids if grid.rows])
    print(answer)
    print(f"wrote {options.out / 'scorecard.html'}")
    is_as_filed = True
    if options.power and options.figures is None and not options.camera:
        is_as_filed = _compare_untested(moved, list(titles), options.out)
    _name_failures(scores, families)
    score_fell_behind = any(score.fell_behind for score in scores)
    family_fell_behind = any(family.fell_behind for family in families)
    return int(score_fell_behind or family_fell_behind or not is_as_filed)


def _name_failures(scores: Sequence[scoring.Score], families: Sequence[FamilyScore]) -> None:
    """Name on standard error what fails without a reason, and what passes in spite of one."""
    for score in scores:
        if score.passes and score.figure.fails:
            print(f"{score.figure.name} passes now: remove `fails` from its entry", file=sys.stderr)
        if score.fell_behind:
            low, high = score.figure.limits
            text = f"simulated {score.simulated.value:.4g}, passes from {low:g} to {high:g}"
            print(f"{score.figure.name} ({score.figure.what()}) fails: {text}", file=sys.stderr)
    for family in families:
        name = family.family.name
        if family.passes and family.family.fails:
            print(f"{name} agrees now: remove `fails` from its entry", file=sys.stderr)
        if family.fell_behind:
            text = f"mean ratio {family.mean:.3g}, last over first {family.change:.3g}"
            print(f"{name} fails ({family.verdict}): {text}", file=sys.stderr)


def _compare_untested(moved: Sequence[power.Moved], cameras: Sequence[str], out: Path) -> bool:
    """Return whether the constants that nothing notices are those on file; otherwise write the
    file that would agree and name the differences."""
    constants = power.untested(moved)
    stored = power.stored_untested(cameras)
    if constants == stored:
        return True
    file_name = power.UNTESTED_FILE.name
    write_text(out / file_name, power.untested_text(constants))
    for camera in cameras:
        words_now = constants.get(camera, {})
        words_stored = stored.get(camera, {})
        for key in sorted({*words_now, *words_stored}):
            now = words_now.get(key)
            if now == words_stored.get(key):
                continue
            state = "noticed" if now is None else f"untested (it changes: {now})"
            print(f"{camera}: {key} is {state} now", file=sys.stderr)
    print(
        f"the untested constants are not those of {file_name}: see {out / file_name}",
        file=sys.stderr,
    )
    return False


@dataclass(frozen=True)
class Scorecard:
    """All that the page shows."""

    scores: Sequence[scoring.Score]
    """All figures, judged."""
    families: Sequence[FamilyScore]
    """All families, judged."""
    moved: Sequence[power.Moved]
    """All moved constants; empty without ``--power``."""
    titles: dict[str, str]
    """Titles of the chosen cameras, by name."""


def _page(answer: str, card: Scorecard, provenance: dict[str, object], command: str) -> str:
    """Return the page: the figure of ratios, standings, families, power, figures of cameras, checks
    of the code, and the quantities' meanings."""
    scores = card.scores
    body = [heading("Simulated and published values")]
    real = [score for score in scores if score.figure.kind == "reality"]
    ratios = [
        score for score in real if score.figure.published.value is not None and score.ratio > 0
    ]
    if ratios:
        size = (9.5, 1.2 + 0.17 * len(ratios))
        title = "Simulated over published value"
        drawn = svg("ratios", size, title, lambda canvas: _draw(canvas, ratios))
        body.append(figure({"ratios": drawn}, "ratios", CAPTION))
    body += [heading("Blind figures by camera"), STANDINGS.grid(standings(scores)).html()]
    if card.families:
        body += [heading("Families of figures"), note(FAMILY_NOTE)]
        body.append(FAMILIES.grid(card.families).html())
    if card.moved:
        body += [heading("Which figures notice a wrong constant"), note(POWER_NOTE)]
        body += [
            paragraph("Untested constants, and what they change on which limits of damage hang:"),
            bullets(_untested_lines(power.untested(card.moved))),
        ]
        body.append(fold("All constants", power.POWER.grid(card.moved).html()))
    if failing := [score for score in real if not score.passes]:
        body += [heading("Failures and their reasons"), scoring.SCORES.grid(failing).html()]
    scored = {score.figure.camera for score in real}
    without = [title for camera, title in card.titles.items() if camera not in scored]
    if real:
        body += [heading("Figures of real cameras"), scoring.SCORES.grid(real).html()]
    if without:
        body.append(note(f"The file has no published figure for {'; '.join(without)}."))
    code = [score for score in scores if score.figure.kind == "code"]
    if code:
        body += [heading("Checks of the code"), note(CHECKS), scoring.SCORES.grid(code).html()]
    meanings = []
    for quantity in QUANTITIES.values():
        unit = f" ({quantity.unit})" if quantity.unit else ""
        meanings.append((f"{quantity.title}{unit}", quantity.says))
    for title, rows in (("Quantities", meanings), ("Provenance", provenance.items())):
        lines = [
            tag("tr", tag("th", key, scope="row"), tag("td", plain(value))) for key, value in rows
        ]
        body += [heading(title), tag("table", tag("tbody", *lines), kind="prov")]
    body += command_of(command)
    return page("Scorecard of the simulated cameras", answer, body, [note(HOW)])


def _untested_lines(constants: power.UntestedConstants) -> list[str]:
    """Return a line for each camera: the untested constants on which limits hang, with what they
    change; then the others, and those that could not be moved."""
    lines = []
    for camera, words_by_key in constants.items():
        hanging = []
        unmoved = []
        for key, words in words_by_key.items():
            if words in ("none", power.NOT_MOVED_WORDS):
                unmoved.append(key)
            else:
                hanging.append(f"{key} ({words})")
        parts = []
        if hanging:
            parts.append(f"limits hang on {', '.join(hanging)}")
        if unmoved:
            parts.append(f"none seen to hang on {', '.join(unmoved)}")
        lines.append(f"{camera_title(camera)}: {'; '.join(parts)}")
    return lines


def _draw(canvas: Canvas, scores: Sequence[scoring.Score]) -> None:
    """Draw each score's ratio with its interval, with the first at the top."""
    axis = canvas.subplots()
    axis.axvspan(1 - scoring.NEAR, 1 + scoring.NEAR, color=BLUE, alpha=0.12)
    axis.axvline(1, color=BLUE, linewidth=0.8)
    for row, score in enumerate(scores):
        interval = score.simulated.interval
        value = score.figure.published.value
        colour = BLUE if score.passes else RED
        if interval.known and value:
            ends = np.maximum([interval.low / value, interval.high / value], 1e-3)
            axis.plot(ends, [row, row], color=colour, linewidth=1)
        face = colour if score.figure.use == "blind" else "none"
        axis.plot(score.ratio, row, "o", color=colour, markerfacecolor=face, markersize=4)
    axis.set(
        xscale="log", xlim=(0.05, 5), ylim=(len(scores) - 0.5, -0.5), xlabel="simulated / published"
    )
    axis.set_xticks([0.1, 0.25, 0.5, 1, 2, 4], ["0.1", "0.25", "0.5", "1", "2", "4"])
    axis.minorticks_off()
    labels = [score.figure.what().partition(", stored")[0] for score in scores]
    axis.set_yticks(range(len(scores)), labels, fontsize=6)
    cameras = [camera_title(score.figure.camera) for score in scores]
    for row, title in enumerate(cameras):
        if row == 0 or title != cameras[row - 1]:
            axis.axhline(row - 0.5, color=GREY, linewidth=0.6)
            axis.text(4.8, row, title, ha="right", va="center", fontsize=7, weight="bold")


def _answer(scores: Sequence[scoring.Score]) -> str:
    """Return how many blind figures pass, in total and by family, and how many of the others."""

    def share(chosen: Sequence[scoring.Score]) -> str:
        return f"{sum(score.passes for score in chosen)} of {len(chosen)}"

    by_use = {
        use: [score for score in scores if score.figure.use == use]
        for use in ("blind", "calibration", "code")
    }
    blind = by_use["blind"]
    by_group: dict[str, list[scoring.Score]] = {}
    for score in blind:
        first_word = score.figure.camera.partition("_")[0]
        group = GROUPS.get(first_word, "other cameras")
        by_group.setdefault(group, []).append(score)
    shares_of_groups = ""
    if len(by_group) > 1:
        shares = [f"{name} {share(group_scores)}" for name, group_scores in by_group.items()]
        shares_of_groups = f"by camera, {', '.join(shares)}; "
    values = [score for score in blind if score.strict is not None]
    bounds = [score for score in blind if score.strict is None]
    strict = sum(score.strict is True for score in values)
    wide = sum(score.passes_by_tolerance for score in values)
    text = f"{share(blind)} blind figures pass; "
    text += f"{strict} of {len(values)} values within 25 %, {wide} by a wider tolerance of the "
    text += f"source, {share(bounds)} bounds; {shares_of_groups}"
    text += f"{share(by_use['calibration'])} figures that calibrated a camera pass; "
    text += f"{share(by_use['code'])} checks of the code pass."
    new = [score.figure.name for score in scores if score.fell_behind]
    if new:
        text += f" Failures without a stated reason: {', '.join(new)}."
    return text


def _family_answer(families: Sequence[FamilyScore]) -> list[str]:
    """Return how many families agree, as a sentence; nothing without families."""
    if not families:
        return []
    agreeing = sum(family.passes for family in families)
    trends = sum(family.has_trend for family in families)
    return [f"{agreeing} of {len(families)} families agree, {trends} have a trend."]


def _power_answer(moved: Sequence[power.Moved]) -> list[str]:
    """Return how many constants are noticed, as a sentence; nothing if none was moved."""
    movable = [row for row in moved if row.can_move]
    if not movable:
        return []
    noticed = sum(bool(row.names) for row in movable)
    immovable = len(moved) - len(movable)
    return [
        f"{noticed} of {len(movable)} constants are noticed when they are moved; "
        f"{immovable} could not be moved."
    ]
