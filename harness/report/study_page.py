"""The page of a study: its detection limits, their basis and validity, and its figures."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from harness.evaluation.study.limit import SetUpLimit
from harness.evaluation.study.result import SetUpResult, StudyResult
from harness.evaluation.study.surface import depth_varies
from harness.records.examples import StudyExample
from harness.records.schema import Table
from harness.report.blocks import COLOURS, closing, joined, template
from harness.report.clouds import examples_figure, sight_figure
from harness.report.limits_figure import MOST_ROWS, limits_figure
from harness.report.scene import scene_svg
from harness.report.study_figures import (
    MOST_CURVES,
    axis_figure,
    depth_limits_figure,
    operating_figure,
    overlay_figure,
    with_room,
)
from harness.report.tornado import tornado_figure
from harness.tables import study
from harness.tables.limits import (
    is_within_sizes,
    limit_notes,
    limits_grid,
    name_of,
    short_names,
    study_answer,
)
from harness.tables.references import reference_headline
from harness.tables.unknowns import (
    UNKNOWN_TABLE,
    stated_of,
    undetermined,
    unknown_headline,
    unknown_rows,
    unknown_sentences,
)
from harness.vocabulary.text import Grid, unbroken


def study_parts(result: StudyResult) -> list[str | Grid]:
    """Return the parts of a study for a terminal: warnings, limits, notes on them, the answer."""
    parts: list[str | Grid] = []
    parts += [f"warning: {text}" for text in study.threshold_warnings(result.limits)]
    parts.append(limits_grid(result.limits, terminal=True))
    notes = limit_notes(result.limits)
    if notes:
        parts += ["", *notes]
    if result.record.designs:
        parts += ["", *(design.sentence for design in result.record.designs)]
    sentences = unknown_sentences(result)
    if sentences:
        parts += ["", *sentences]
    return [*parts, "", " ".join(_answers(result))]


def _answers(result: StudyResult) -> list[str]:
    """Return the answer at the stated values and, of a study with unknowns, before it the range of
    the best set-up over them; of one that compares references, what they buy."""
    stated = [limit for limit in result.limits if not limit.record.drawn]
    headline = unknown_headline(result) or reference_headline(stated)
    answer = study_answer(stated)
    return [headline, answer] if headline else [answer]


def study_html(
    result: StudyResult,
    examples: Iterable[StudyExample],
    provenance: Mapping[str, Any],
    resolved_yaml: str,
    title: str,
) -> str:
    """Return the page as text; the same input gives the same bytes. ``examples`` are used after
    the other figures."""
    limits = result.limits
    rows = study.study_tables(result)
    inspections = [limit.record.inspected for limit in limits]
    groups = {f"axis-{n}": group for n, group in enumerate(study.axis_groups(result.axes), 1)}
    # limits over unknowns have a section of their own
    stated = [set_up for set_up in result.set_ups if not set_up.limit.record.drawn]
    shown = with_room(stated)
    answers = [unbroken(answer) for answer in _answers(result)]
    figures = {name: axis_figure(group, name) for name, group in groups.items()}
    if any(set_up.limit.inspections for set_up in stated):
        figures["limits"] = limits_figure([set_up.limit for set_up in stated])
    figures |= _curves(shown)
    figures |= _tornadoes(result)
    drawn = list(examples)
    pictures = _pictures(shown, drawn)
    figures |= {name: picture for name, (_, picture) in pictures.items()}
    best = _best(stated, drawn)
    if best is not None:
        figures["sight"] = sight_figure("sight", _examples_of(best, drawn), name_of(best))
    warnings = [unbroken(text) for text in study.threshold_warnings(limits)]

    def table(declared: Table) -> Any:
        return declared.grid(rows[declared]).html() if rows[declared] else None

    return template("study.html").render(
        title=title,
        answer=answers[0],
        further_answers=answers[1:],
        conditions=result.conditions,
        rule=(
            f"Fixed in advance: a damage is found {result.record.hit_rule}, and no finding counts"
            " twice. Repeats of the noise on a board are not additional targets."
        ),
        limits=limits_grid(limits).html() if limits else None,
        limit_notes=[unbroken(text) for text in limit_notes(limits)],
        set_ups=len(stated),
        most_curves=MOST_CURVES,
        most_rows=MOST_ROWS,
        scene=scene_svg(result.facts),
        best="" if best is None else short_names([best])[best.record.label],
        unknowns=_unknown_parts(result),
        axes=[_axis_part(name, group) for name, group in groups.items()],
        has_depths=any(
            inspected.limit_of != "depth" and depth_varies(inspected.depth_mm)
            for inspected in inspections
        ),
        size_of=" or ".join(dict.fromkeys(inspected.size_of for inspected in inspections)),
        surface_notes=_surface_notes(result),
        judged=any(limit.false_calls is not None for limit in limits),
        chance=table(study.CHANCE),
        thresholds=table(study.THRESHOLDS),
        threshold_note=study.threshold_note(result.record),
        warnings=[*provenance.get("warnings", ()), *warnings],
        operating=table(study.OPERATING),
        operating_notes=study.operating_notes(result.set_ups),
        examples=[(head, name) for name, (head, _) in pictures.items()],
        undetermined=undetermined(result.facts),
        validity=result.validity,
        figures=figures,
        closing=joined(closing(provenance, resolved_yaml)),
    )


def _curves(shown: Sequence[SetUpResult]) -> dict[str, str]:
    """Return the figures over set-ups by name, as far as there are data for them."""
    figures: dict[str, str] = {}
    inspected = [set_up.limit for set_up in shown if set_up.limit.inspections]
    # depths and diameters need separate axes
    if len({limit.record.inspected.limit_of for limit in inspected}) == 1:
        figures["overlay"] = overlay_figure(inspected)
    if any(set_up.surface for set_up in shown):
        figures["depth-limits"] = depth_limits_figure(shown)
    curved = [set_up for set_up in shown if set_up.roc or set_up.free_response or set_up.pixels]
    if curved:
        figures["operating"] = operating_figure(curved)
    return figures


def _pictures(
    shown: Sequence[SetUpResult], examples: Sequence[StudyExample]
) -> dict[str, tuple[str, str]]:
    """Return the heading and the figure of each set-up's examples by the figure's name."""
    pictures: dict[str, tuple[str, str]] = {}
    for set_up in shown:
        of_set_up = _examples_of(set_up.limit, examples)
        if of_set_up:
            name = f"examples-{len(pictures) + 1}"
            head = name_of(set_up.limit)
            by_limit = is_within_sizes(set_up.limit)
            pictures[name] = (head, examples_figure(name, of_set_up, head, by_limit=by_limit))
    return pictures


def _examples_of(limit: SetUpLimit, examples: Sequence[StudyExample]) -> list[StudyExample]:
    record = limit.record
    return [
        example
        for example in examples
        if (example.variant, example.frames) == (record.variant, record.frames)
    ]


def _best(set_ups: Sequence[SetUpResult], examples: Sequence[StudyExample]) -> SetUpLimit | None:
    """Return the smallest limit of the set-ups with examples, among those that limit the same size
    as the first (a width and a diameter do not compare); None if there is none."""
    limits = [set_up.limit for set_up in set_ups if _examples_of(set_up.limit, examples)]
    comparable = [limit for limit in limits if _limited_size(limit) == _limited_size(limits[0])]
    return min(comparable, key=lambda limit: limit.a90_95.value, default=None)


def _limited_size(limit: SetUpLimit) -> str:
    return limit.record.inspected.limit_of


def _tornadoes(result: StudyResult) -> dict[str, str]:
    """Return the tornado chart of each set-up that has one, by the figure's name."""
    figures: dict[str, str] = {}
    for set_up, name in _drawn_set_ups(result):
        if name:
            stated = stated_of(result, set_up.limit)
            stated_mm = np.nan if stated is None else stated.a90_mm
            figures[name] = tornado_figure(set_up, stated_mm)
    return figures


def _drawn_set_ups(result: StudyResult) -> list[tuple[SetUpResult, str]]:
    """Return the set-ups that draw unknowns, each with the name of its tornado chart; empty where
    the boards allow no effects."""
    named_set_ups = []
    charts = 0
    for set_up in result.set_ups:
        if set_up.unknowns is None:
            continue
        name = ""
        if not set_up.unknowns.why:
            charts += 1
            name = f"tornado-{charts}"
        named_set_ups.append((set_up, name))
    return named_set_ups


def _unknown_parts(result: StudyResult) -> list[dict[str, Any]]:
    """Return what the template shows of each set-up that draws unknowns: heading, sentence, figure
    and table."""
    parts: list[dict[str, Any]] = []
    set_ups = _drawn_set_ups(result)
    sentences = unknown_sentences(result)
    for (set_up, figure_name), sentence in zip(set_ups, sentences, strict=True):
        rows = unknown_rows([set_up])
        table = UNKNOWN_TABLE.grid(rows, heads={"set-up": ""}).html() if rows else None
        part = {
            "title": name_of(set_up.limit),
            "sentence": unbroken(sentence),
            "figure": figure_name,
            "table": table,
        }
        parts.append(part)
    return parts


def _axis_part(name: str, group: study.AxisGroup) -> dict[str, Any]:
    """Return what the template shows of an axis."""
    return {
        "title": group.name,
        "figure": name,
        "caption": _axis_caption(group),
        "table": study.axis_grid(group).html(),
        "note": study.axis_note(group),
    }


def _axis_caption(group: study.AxisGroup) -> str:
    caption = (
        "The size found 90 % of the time with its 95 % interval over boards. A dash is a90/95. An"
        " arrow marks a value far beyond the largest size inspected (dotted)."
    )
    lines = len(group.lines)
    if lines > len(COLOURS):
        caption += f" The first {len(COLOURS)} of {lines} lines are drawn; the table holds all."
    if not group.numeric:
        caption += " The values have no order."
    return caption


def _surface_notes(result: StudyResult) -> list[str]:
    """Return the reasons why there is no surface over diameter and depth, or notes on it, with
    their set-ups."""
    names_by_note: dict[str, list[str]] = {}
    for set_up in result.set_ups:
        text = f"No surface: {set_up.surface_why}"
        if set_up.surface is not None:
            text = set_up.surface.note
        if text:
            names_by_note.setdefault(text, []).append(name_of(set_up.limit))
    notes = []
    for text, names in names_by_note.items():
        holds_for_all = len(names) == len(result.set_ups)
        notes.append(f"{text}." if holds_for_all else f"{text} ({', '.join(names)}).")
    return notes
