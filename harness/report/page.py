"""The report of a sweep: result tables in, one self-contained HTML page out, without network."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from harness.evaluation.set_ups import set_ups_of
from harness.evaluation.summary import MAIN, fit_floor, found_holes
from harness.records.examples import ExampleCloud, MappedExample
from harness.records.outputs import REPORT
from harness.records.trials import (
    FALSE_CALLS,
    NOISE_BY_FRAMES,
    SET_UPS,
    SUMMARY,
    ResultTables,
    hole_list,
)
from harness.report import blocks, sections
from harness.report.claims import claim_set_of
from harness.report.clouds import residual_figure
from harness.report.margins import margin_figure, threshold_figure
from harness.report.perspectives import map_files, map_text, perspectives_html
from harness.report.set_ups_page import averaged_text, set_ups_html
from harness.report.summaries import Summaries, summaries, verdicts_of
from harness.report.view3d import write_view3d
from harness.vocabulary.files import write_text
from harness.vocabulary.text import inches

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

TICKS_MM = (0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 50, 100)


def write_report(
    folder: Path,
    tables: ResultTables,
    examples: Sequence[ExampleCloud | MappedExample],
    provenance: Mapping[str, Any],
    experiment_yaml_text: str,
    title: str,
    facts: Mapping[str, Any] | None = None,
    computed: Summaries | None = None,
) -> Path:
    """Write ``folder/report.html`` and return its path: the page of a set-up, of several set-ups,
    or of maps, with a page for each map of ``examples`` beside it. `harness.report.blocks.closing`
    describes ``provenance``; ``facts`` is the resolved experiment as plain data, ``computed`` the
    result of `summaries`. Claims are judged for a target that has some. The same input gives the
    same bytes. Raises UserError if the folder cannot be written."""
    facts = facts or {}
    origin = sections.About(
        provenance=provenance,
        experiment_yaml_text=experiment_yaml_text,
        title=title,
        claim_set=claim_set_of(facts),
        facts=facts,
    )
    clouds = [example for example in examples if isinstance(example, ExampleCloud)]
    maps = [example for example in examples if isinstance(example, MappedExample)]
    if len(tables.registrations):
        text = perspectives_html(tables, maps, origin, computed)
    elif len(set_ups_of(tables)) > 1:
        text = set_ups_html(tables, clouds, origin, computed)
    else:
        text = report_html(tables, clouds, origin, computed)
    for name, example in map_files(maps).items():
        write_view3d(Path(folder) / name, example.scene, map_text(example))
    path = Path(folder) / REPORT.name
    write_text(path, text)
    return path


def report_html(
    tables: ResultTables,
    examples: Sequence[ExampleCloud],
    about: sections.About,
    computed: Summaries | None = None,
) -> str:
    """Return the page of an experiment with one set-up as text; see `write_report`."""
    computed = computed or summaries(tables, examples, about.claim_set)
    main = _of_main(computed[SUMMARY])
    noise = _of_main(computed[NOISE_BY_FRAMES])
    calls = _of_main(computed[FALSE_CALLS])
    verdicts = verdicts_of(computed)
    frames = sorted(int(n) for n in main["frames"].unique())
    clouds = [example for example in examples if example.variant == MAIN]
    clouds.sort(key=lambda cloud: cloud.frames)
    figures: dict[str, str] = {}
    drawn = {"margins": margin_figure(main), "threshold": threshold_figure(calls, noise)}
    figures |= {name: drawing for name, drawing in drawn.items() if drawing}
    if clouds:
        figures["residual"] = residual_figure(clouds)
    if len(noise) and (noise["temporal_rms_mm"] > 0).all():
        figures["noise"] = noise_figure(noise)
    with_most = main[main["frames"] == main["frames"].max()]
    ends = (*frames[:1], *frames[-1:])
    return sections.sweep_page(
        "sweep.html",
        tables,
        about,
        answer_sentence(main),
        figures,
        rule=sections.rule_note(int(main["n"].max()) if len(main) else 0),
        holes=sections.holes_grid(main).html(),
        sizes=SUMMARY.grid(sections.records(with_most)).html(),
        noise=NOISE_BY_FRAMES.grid(sections.records(noise)).html(),
        claims=sections.claims_section(about.claim_set.title if about.claim_set else "", verdicts),
        varied=sections.varied_section(tables, computed[SET_UPS], ends, original=MAIN),
        calls=FALSE_CALLS.grid(sections.records(calls), heads={"set-up": ""}).html(),
    )


def _of_main(table: pd.DataFrame) -> pd.DataFrame:
    return table[table["variant"] == MAIN]


def answer_sentence(main: pd.DataFrame) -> str:
    """State how many holes were found with the most and the fewest frames (``main``: summary
    rows), and the smallest of them."""
    if main.empty:
        return "No trial of the main experiment finished, so there is no answer."
    frames = sorted(int(n) for n in main["frames"].unique())
    with_most = _found_text(main, frames[-1])
    with_fewest = _found_text(main, frames[0])
    if len(frames) == 1:
        return f"With {averaged_text(frames[0])} the camera finds {with_most}."
    if with_fewest == with_most:
        both_numbers = f"{averaged_text(frames[0])} and with {frames[-1]}"
        return f"With {both_numbers} the camera finds the same: {with_most}."
    return (
        f"With {averaged_text(frames[-1])} the camera finds {with_most};"
        f" with {averaged_text(frames[0])}, {with_fewest}."
    )


def _found_text(main: pd.DataFrame, frames: int) -> str:
    """Return ``8 of 11 holes, from 6.35 mm (1/4 in)``."""
    status = found_holes(main, MAIN, frames)
    detected = [hole for hole, state in status.items() if state == "found"]
    undecided = [hole for hole, state in status.items() if state == "undecided"]
    text = f"{len(detected)} of {len(status)} holes"
    if detected:
        smallest_mm = float(main["true_diameter_mm"][main["hole"].isin(detected)].min())
        drill = f" ({inches(smallest_mm)})" if inches(smallest_mm) else ""
        text += f", from {smallest_mm:.2f} mm{drill}"
    if undecided:
        text += f", {hole_list(undecided)} undecided"
    return text


def noise_figure(noise: pd.DataFrame) -> str:
    """Draw a variant's temporal, systematic and total error against frames, with the 1/sqrt(N)
    guide and the floor."""

    def draw(figure: Figure) -> None:
        axes = figure.subplots()
        _draw_errors(axes, noise)
        frames = noise["frames"].to_numpy(float)
        axes.set_xscale("log")
        axes.set_yscale("log")
        axes.set_xticks(frames, [f"{n:g}" for n in frames])
        axes.minorticks_off()
        low_mm, high_mm = axes.get_ylim()
        ticks_mm = [tick_mm for tick_mm in TICKS_MM if low_mm <= tick_mm <= high_mm]
        axes.set_yticks(ticks_mm, [f"{tick_mm:g}" for tick_mm in ticks_mm])
        axes.set(xlabel="frames averaged", ylabel="range error (mm)")
        axes.legend(loc="center left", bbox_to_anchor=(1.01, 0.5))

    alt = (
        "Range error in millimetres against the number of averaged frames: noise falls, the"
        " systematic error stays."
    )
    return blocks.svg("noise", (10, 4.2), alt, draw)


def _draw_errors(axes: Axes, noise: pd.DataFrame) -> None:
    frames = noise["frames"].to_numpy(float)
    axes.plot(
        frames,
        noise["guide_mm"],
        color=blocks.GUIDE,
        lw=7,
        solid_capstyle="round",
        label="1/√N guide",
    )
    for column, colour, marker, label in (
        ("temporal_rms_mm", blocks.BLUE, "o", "temporal noise, rms"),
        ("systematic_mm", blocks.ORANGE, "s", "systematic error (offset and pattern)"),
        ("pattern_mm", blocks.GREEN, "v", "its pattern over pixels"),
        ("total_rms_mm", blocks.INK, "D", "total error, rms"),
    ):
        errors_mm = noise[column].where(noise[column] > 0)
        axes.plot(
            frames,
            errors_mm,
            marker=marker,
            ms=5,
            lw=1.4,
            color=colour,
            label=label,
        )
    floor_mm = fit_floor(frames, noise["total_rms_mm"].to_numpy(float))
    if floor_mm > 0:
        axes.axhline(
            floor_mm,
            color=blocks.INK,
            label=f"floor {floor_mm:.2f} mm",
            lw=0.8,
            ls=(0, (6, 3)),
        )
