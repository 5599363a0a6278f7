"""The page of a study that is planned."""

from __future__ import annotations

from harness.report.design_figure import design_svg
from harness.report.design_rows import (
    PLACED,
    StudyDesign,
    answer,
    frames_heads,
    frames_note,
    frames_rows,
    guess_text,
    hole_free_lines,
    notes,
    plan_heads,
    plan_rows,
    repeats_examples,
    repeats_heads,
    repeats_note,
    repeats_rows,
    sizes_text,
)
from harness.report.page_parts import template


def design_html(design: StudyDesign, command: str) -> str:
    """The page as text: answer, figure, plans and sizes, frames, repeats, hole-free area; it needs no network."""
    recommended = design.recommended.plan
    return template("design.html").render(
        title="Planning a study of detection limits",
        answer=answer(design),
        guess=guess_text(design),
        figure=design_svg(design),
        limit=design.limit_name,
        unit=f" ({design.unit})" if design.unit else "",
        heads=plan_heads(design),
        rows=plan_rows(design),
        sizes=[
            (plan is recommended, f"{plan.targets} targets, {PLACED[plan.placement]}", sizes_text(plan))
            for plan in design.plans
        ],
        frames_heads=frames_heads(design),
        frames=[(False, cells) for cells in frames_rows(design)],
        frames_note=frames_note(design) if design.frames else "",
        repeats_heads=repeats_heads(design),
        repeats=[(False, cells) for cells in repeats_rows(design)],
        repeats_note=repeats_note(design) if design.repeats else "",
        examples=repeats_examples(design),
        hole_free=hole_free_lines(design),
        notes=notes(design),
        command=command,
    )
