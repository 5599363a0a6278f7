"""The page of a study: its detection limits, what they rest on, and how far they hold."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from harness.evaluation.study.limit import SetUpLimit
from harness.evaluation.study.result import StudyResult
from harness.evaluation.study.surface import depth_varies
from harness.report.examples import StudyExample
from harness.report.page_parts import closing_sections, template
from harness.report.set_ups_figures import COLOURS
from harness.report.study_axes_figure import AxisGroup, axis_figure, axis_groups
from harness.report.study_axes_rows import (
    SURFACE_HEADS,
    axis_heads,
    axis_note,
    axis_rows,
    size_tables,
    surface_rows,
)
from harness.report.study_calls_figure import calls_figure
from harness.report.study_examples_figure import examples_figure
from harness.report.study_operating_figure import operating_figure
from harness.report.study_pod_figures import MOST_PANELS, curves_figure, signals_figure, with_room
from harness.report.study_rows import is_within_sizes, limit_notes, limit_rows, name_of, study_answer, unbroken
from harness.report.study_surface_figure import surface_figure
from harness.report.study_tables import (
    CHANCE_HEADS,
    OPERATING_HEADS,
    SET_BY_HEADS,
    SIGNAL_HEADS,
    THRESHOLD_HEADS,
    chance_rows,
    operating_notes,
    operating_rows,
    set_by_rows,
    signal_notes,
    signal_rows,
    signal_tests,
    threshold_note,
    threshold_rows,
    threshold_warnings,
)
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


def study_html(
    result: StudyResult,
    examples: Sequence[StudyExample],
    provenance: Mapping[str, Any],
    resolved_yaml: str,
    title: str,
) -> str:
    """The page as text; see `write_study_report`."""
    limits = result.limits
    rows = limit_rows(limits)
    surfaces = [(one.limit, one.surface) for one in result.set_ups if one.surface is not None]
    groups = axis_groups(result.axes)
    shown = _examples_by_set_up(result, examples)
    return template("study.html").render(
        title=title,
        answer=unbroken(study_answer(limits)),
        rule=_rule(result),
        limits=[replace(row, name=unbroken(row.name)) for row in rows],
        limit_notes=[unbroken(note) for note in limit_notes(rows)],
        most_panels=MOST_PANELS,
        axes=[_axis(group, _axis_name(number)) for number, group in enumerate(groups)],
        has_depths=any(depth_varies(limit.record.inspected.depth_mm) for limit in limits),
        surface_heads=SURFACE_HEADS,
        surface_rows=surface_rows(surfaces),
        surface_notes=_surface_notes(result),
        chance_heads=CHANCE_HEADS,
        chance_rows=chance_rows(result.set_ups),
        threshold_heads=THRESHOLD_HEADS,
        threshold_rows=threshold_rows(limits),
        threshold_note=threshold_note(result.record),
        warnings=[unbroken(text) for text in threshold_warnings(limits)],
        set_by_heads=SET_BY_HEADS,
        set_by_rows=set_by_rows(limits),
        signal_heads=SIGNAL_HEADS,
        signal_rows=signal_rows(limits),
        signal_tests=signal_tests(limits),
        signal_notes=signal_notes(limits),
        operating_heads=OPERATING_HEADS,
        operating_rows=operating_rows(result.set_ups),
        operating_notes=operating_notes(result.set_ups),
        examples=[(name_of(limit), name) for name, (limit, _) in shown.items()],
        size_tables=size_tables(limits, [one.sizes for one in result.set_ups]),
        validity=result.validity,
        figures=_figures(result, groups, shown),
        **closing_sections(provenance, resolved_yaml),
    )


def _figures(
    result: StudyResult, groups: Sequence[AxisGroup], examples: Mapping[str, tuple[SetUpLimit, Sequence[StudyExample]]]
) -> dict[str, str]:
    """The figures that the data allow, as SVG text by name."""
    shown = with_room(result.set_ups)
    inspected = [one.limit for one in shown if one.limit.inspections]
    surfaces = [(one.limit, one.surface) for one in shown if one.surface is not None]
    signals = [one.limit for one in shown if one.limit.signals is not None]
    curved = [one for one in shown if one.roc or one.free_response or one.pixels]
    figures = {_axis_name(number): axis_figure(group, _axis_name(number)) for number, group in enumerate(groups)}
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


def _rule(result: StudyResult) -> str:
    return (
        "Fixed beforehand: a damage is found where the centre of a finding lies within "
        f"{result.record.hit_radius_mm:g} mm of its own, and no finding counts for two. Repeats of the noise on one "
        "board are no further targets."
    )


def _axis_name(number: int) -> str:
    return f"axis-{number + 1}"


def _axis(group: AxisGroup, name: str) -> dict[str, Any]:
    caption = (
        "The size found 90 % of the time with its 95 % interval over boards; dash: a90/95. What lies far beyond the "
        "largest size inspected (dotted) is an arrow. No limit: a90/95 is not demonstrated within the sizes inspected."
    )
    if len(group.lines) > len(COLOURS):
        caption += f" The first {len(COLOURS)} of {len(group.lines)} lines; the table goes on."
    if not group.numeric:
        caption += " The values have no order."
    return {
        "title": group.name,
        "figure": name,
        "caption": caption,
        "heads": axis_heads(group),
        "rows": axis_rows(group),
        "note": axis_note(group),
    }


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
    """Why there is no surface over diameter and depth, or what to know beside one; set-ups of one reason together."""
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
