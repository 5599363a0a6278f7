"""The page of a study: its detection limits, what they rest on, and how far they hold."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from harness.evaluation.study.limit import SetUpLimit
from harness.evaluation.study.result import StudyResult
from harness.evaluation.study.surface import depth_varies
from harness.report.blocks import closing, joined, template
from harness.report.examples import StudyExample
from harness.report.set_ups_figures import COLOURS
from harness.report.study_axes_figure import axis_figure
from harness.report.study_examples_figure import examples_figure
from harness.report.study_figures import (
    MOST_PANELS,
    calls_figure,
    curves_figure,
    operating_figure,
    signals_figure,
    surface_figure,
    with_room,
)
from harness.tables.grid import Grid
from harness.tables.limits import LIMITS, is_within_sizes, limit_notes, name_of, study_answer
from harness.tables.schema import Table
from harness.tables.study import (
    CHANCE,
    OPERATING,
    SET_BY,
    SIGNALS,
    SURFACES,
    THRESHOLDS,
    AxisGroup,
    axis_grid,
    axis_groups,
    axis_note,
    operating_notes,
    signal_notes,
    signal_tests,
    size_grids,
    study_tables,
    threshold_note,
    threshold_warnings,
)
from harness.tables.text import unbroken
from harness.vocabulary.files import write_text

MOST_NAMED = 3
"""Set-ups that a note calls by name; of more it gives the number."""


def write_study_report(
    folder: Path,
    result: StudyResult,
    examples: Sequence[StudyExample],
    provenance: Mapping[str, Any],
    resolved_yaml: str,
    title: str,
) -> Path:
    """Write ``folder/report.html`` and return its path. ``provenance`` as of `harness.report.page.write_report`. The
    same input gives the same bytes. Raises UserError where the folder cannot be written."""
    path = Path(folder) / "report.html"
    write_text(path, study_html(result, examples, provenance, resolved_yaml, title))
    return path


def study_parts(result: StudyResult) -> list[str | Grid]:
    """Return what a terminal shows of a study: warnings, limits, what to know beside them, the answer."""
    warnings = [f"warning: {text}" for text in threshold_warnings(result.limits)]
    notes = limit_notes(result.limits)
    grid = LIMITS.grid(result.limits, terminal=True)
    return [*warnings, grid, *([""] if notes else []), *notes, "", study_answer(result.limits)]


def study_html(
    result: StudyResult,
    examples: Sequence[StudyExample],
    provenance: Mapping[str, Any],
    resolved_yaml: str,
    title: str,
) -> str:
    """Return the page as text; see `write_study_report`."""
    limits, rows = result.limits, study_tables(result)
    groups = {f"axis-{number}": group for number, group in enumerate(axis_groups(result.axes), 1)}
    shown = _examples_by_set_up(result, examples)

    def table(of: Table) -> Any:
        return of.grid(rows[of]).html() if rows[of] else None

    tests = signal_tests(limits)
    return template("study.html").render(
        title=title,
        answer=unbroken(study_answer(limits)),
        rule="Fixed beforehand: a damage is found where the centre of a finding lies within "
        f"{result.record.hit_radius_mm:g} mm of its own, and no finding counts for two. Repeats of the noise on one "
        "board are no further targets.",
        limits=table(LIMITS),
        limit_notes=[unbroken(note) for note in limit_notes(limits)],
        set_ups=len(limits),
        most_panels=MOST_PANELS,
        axes=[
            {
                "title": group.name,
                "figure": name,
                "caption": _axis_caption(group),
                "table": axis_grid(group).html(),
                "note": axis_note(group),
            }
            for name, group in groups.items()
        ],
        has_depths=any(depth_varies(limit.record.inspected.depth_mm) for limit in limits),
        surfaces=table(SURFACES),
        surface_notes=_surface_notes(result),
        chance=table(CHANCE),
        thresholds=table(THRESHOLDS),
        threshold_note=threshold_note(result.record),
        warnings=[unbroken(text) for text in threshold_warnings(limits)],
        set_by=table(SET_BY),
        signals=table(SIGNALS),
        signal_tests=tests.html() if tests else None,
        signal_notes=signal_notes(limits),
        operating=table(OPERATING),
        operating_notes=operating_notes(result.set_ups),
        examples=[(name_of(limit), name) for name, (limit, _) in shown.items()],
        sizes=[grid.html() for grid in size_grids(result.set_ups)],
        validity=result.validity,
        figures=_figures(result, groups, shown),
        closing=joined(closing(provenance, resolved_yaml)),
    )


def _figures(
    result: StudyResult,
    groups: Mapping[str, AxisGroup],
    examples: Mapping[str, tuple[SetUpLimit, Sequence[StudyExample]]],
) -> dict[str, str]:
    """The figures that the data allow, as SVG text by name."""
    shown = with_room(result.set_ups)
    inspected = [one.limit for one in shown if one.limit.inspections]
    surfaces = [(one.limit, one.surface) for one in shown if one.surface is not None]
    signals = [one.limit for one in shown if one.limit.signals is not None]
    curved = [one for one in shown if one.roc or one.free_response or one.pixels]
    figures = {name: axis_figure(group, name) for name, group in groups.items()}
    if inspected:
        figures["curves"] = curves_figure(inspected)
    if surfaces:
        figures["surface"] = surface_figure(surfaces)
    if any(limit.false_calls is not None for limit in result.limits):
        figures["calls"] = calls_figure(result.limits, result.record.false_calls_per_m2)
    if signals:
        figures["signals"] = signals_figure(signals)
    if curved:
        figures["operating"] = operating_figure(curved)
    return figures | {
        name: examples_figure(name, some, name_of(limit), by_limit=is_within_sizes(limit))
        for name, (limit, some) in examples.items()
    }


def _axis_caption(group: AxisGroup) -> str:
    caption = (
        "The size found 90 % of the time with its 95 % interval over boards; dash: a90/95. What lies far beyond the "
        "largest size inspected (dotted) is an arrow. No limit: a90/95 is not demonstrated within the sizes inspected."
    )
    if len(group.lines) > len(COLOURS):
        caption += f" The first {len(COLOURS)} of {len(group.lines)} lines; the table goes on."
    return caption if group.numeric else f"{caption} The values have no order."


def _examples_by_set_up(
    result: StudyResult, examples: Sequence[StudyExample]
) -> dict[str, tuple[SetUpLimit, list[StudyExample]]]:
    """Name of the figure -> the set-up and its examples, of those set-ups with room on the page."""
    found = []
    for one in with_room(result.set_ups):
        record = one.limit.record
        some = [e for e in examples if (e.variant, e.frames) == (record.variant, record.frames)]
        if some:
            found.append((one.limit, some))
    return {f"examples-{number + 1}": pair for number, pair in enumerate(found)}


def _surface_notes(result: StudyResult) -> list[str]:
    """Reasons why there is no surface over diameter and depth, or what to know beside one, with their set-ups."""
    reasons: dict[tuple[str, str], list[str]] = {}
    for one in result.set_ups:
        reason = ("No surface", one.surface_why) if one.surface is None else ("Surface", one.surface.note)
        reasons.setdefault(reason, []).append(name_of(one.limit))
    notes = []
    for (what, why), labels in reasons.items():
        if why:
            some = ", ".join(labels) if len(labels) <= MOST_NAMED else f"{len(labels)} of {len(result.set_ups)} set-ups"
            every = len(labels) == len(result.set_ups)
            notes.append(f"{what}{'' if every else f' for {some}'}: {why}.")
    return notes
