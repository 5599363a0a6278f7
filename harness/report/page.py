"""The report of a sweep: result tables in, one self-contained HTML page out. It needs no network and runs no script."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from markupsafe import Markup

from harness.evaluation.noise import noise_against_frames
from harness.evaluation.profile import RINGS, hole_shapes
from harness.evaluation.set_ups import compare_set_ups, set_ups_of
from harness.evaluation.summary import (
    MAIN,
    STATES,
    false_calls,
    found_holes,
    found_rule,
    hole_list,
    summarise_holes,
)
from harness.report.blocks import closing, figure, heading, note, page, paragraph
from harness.report.claims import claims_section, counted_verdicts, verdict_cell
from harness.report.clouds import LOOKS, cloud_figure, profile_figure, residual_figure
from harness.report.examples import ExampleCloud, MappedExample
from harness.report.measures import positions_figure, sizes_figure
from harness.report.perspectives import map_files, map_text, perspectives_html
from harness.report.set_ups import CALLS_NOTE, calls_grid, left_out, records, set_ups_html, varied_section
from harness.report.set_ups_figures import noise_figure
from harness.report.view3d import write_view3d
from harness.tables.grid import Cell, Grid
from harness.tables.text import bounded, inches, mm, plus_minus
from harness.tables.trials import ResultTables
from harness.thesis.claims import RULES, score_claims, verdicts_by_variant
from harness.thesis.verdicts import Verdict
from harness.vocabulary.files import write_text

if TYPE_CHECKING:
    import pandas as pd

DRAWS = (
    "{} of the camera's noise before the same board in the same place: the intervals speak of this set-up, not of "
    "other boards, places or cameras."
)


def write_report(
    folder: Path,
    tables: ResultTables,
    examples: Sequence[ExampleCloud | MappedExample],
    provenance: Mapping[str, Any],
    experiment_yaml_text: str,
    title: str,
    target: str = "",
) -> Path:
    """Write ``folder/report.html`` and return its path: the page of one set-up, that of several side by side, or that
    of maps, with a page beside it for each map of ``examples`` that turns in the browser.

    ``provenance`` may hold: ``command``, ``commit``, ``dirty``, ``versions``, ``mitsuba_variant``, ``seed``,
    ``machine``, ``started``, ``seconds`` (by stage), ``indirect_noise_mm``, ``renders``, ``failures`` (texts, or
    mappings with their parts); whatever else it holds is shown as it is, and a missing one as not recorded. ``target``:
    its name; claims of the thesis are scored where it is "thesis". The same input gives the same bytes. Raises
    UserError where the folder cannot be written.
    """
    rest = provenance, experiment_yaml_text, title, target == "thesis"
    clouds = [example for example in examples if isinstance(example, ExampleCloud)]
    maps = [example for example in examples if isinstance(example, MappedExample)]
    if len(tables.registrations):
        text = perspectives_html(tables, maps, *rest)
    else:
        text = (set_ups_html if len(set_ups_of(tables)) > 1 else report_html)(tables, clouds, *rest)
    for name, example in map_files(maps).items():
        write_view3d(Path(folder) / name, example, map_text(example))
    path = Path(folder) / "report.html"
    write_text(path, text)
    return path


def report_html(
    tables: ResultTables,
    examples: Sequence[ExampleCloud],
    provenance: Mapping[str, Any],
    experiment_yaml_text: str,
    title: str,
    with_claims: bool = False,
) -> str:
    """The page of an experiment with one set-up as text; see `write_report`."""
    summary = summarise_holes(tables.holes)
    main = summary[summary["variant"] == MAIN]
    repeats = int(main["n"].max()) if len(main) else 0
    frames = sorted(int(n) for n in main["frames"].unique())
    noise = noise_against_frames(tables.probes[tables.probes["variant"] == MAIN])
    clouds = sorted((e for e in examples if e.variant == MAIN), key=lambda e: e.frames)
    figures: dict[str, str] = {}
    if frames:
        figures |= {"sizes": sizes_figure(main, frames[0], frames[-1]), "positions": positions_figure(main, frames[-1])}
    if clouds:
        drawn = {"cloud": cloud_figure, "residual": residual_figure, "profile": profile_figure}
        figures |= {name: draw(clouds) for name, draw in drawn.items()}
    if len(noise) and (noise["temporal_rms_mm"] > 0).all():
        figures["noise"] = noise_figure(noise)

    verdicts = score_claims(tables, MAIN, examples, summary) if with_claims else []
    draws = "The one repeat is one draw" if repeats == 1 else f"The repeats are {repeats} draws"
    body = [
        heading("Holes against frames"),
        paragraph(
            "Detections of trials, with the 95 % Wilson interval of the rate beneath. The bluer, the more often the "
            "hole was detected."
        ),
        _rates(main, frames).html(),
        heading("Sizes"),
        figure(
            figures,
            "sizes",
            "Means over the trials in which the hole was detected; error bars are one standard deviation over the "
            "repeats. The extent is that of the thresholded cluster; the model is a blurred hole fitted to the "
            "residuals. Below: against the true diameter.",
        ),
        *_measured(main),
        heading("Positions"),
        figure(
            figures,
            "positions",
            "Distance from the centre of the largest cluster (extent) or from the largest cluster's modelled centre "
            "(model). Right: the difference from the truth, with one graduation of a ruler in sixteenths of an inch.",
        ),
        heading("Averaged cloud"),
        figure(
            figures,
            "cloud",
            "Front view in the camera's frame. Magenta: pixels of detected clusters. Rings: the true holes, dashed "
            "where this cloud shows no detection in them; the smallest are drawn wider than they are. Grey: no valid "
            "point. These are single clouds, one for each number of frames; the rates above are over all repeats.",
        ),
        heading("Range residual"),
        figure(
            figures,
            "residual",
            "Distance of each point behind (+) or before (−) the fitted surface. The scale is linear within ±1 mm and "
            "logarithmic beyond. Grey: no valid point, or outside the crop.",
        ),
        heading("Depth through holes"),
        figure(
            figures,
            "profile",
            "Residual along the row of pixels through each hole's centre, depth downwards. The dashed curve is the "
            "hemisphere on the hole's rim with its depth fitted to all pixels inside the outline.",
        ),
        *([_shapes(clouds[-1]).html()] if clouds else []),
        heading("Noise against frames"),
        figure(
            figures,
            "noise",
            "Over the probe pixels of the undamaged face: the temporal noise is the scatter over repeats, "
            "displacements of whole clouds taken out, the systematic error is what every repeat shares. The guide "
            "falls as one over the square root of the number of frames; the floor is what no averaging removes.",
        ),
        *([_noise(noise).html()] if len(noise) else []),
        *claims_section("The thesis' claims", verdicts),
    ]
    variants = [MAIN, *(str(name) for name in tables.variants["variant"] if name != MAIN)]
    compared = compare_set_ups(tables, summary, variants, half_sizes=False)
    body += varied_section(tables, compared, list(dict.fromkeys([*frames[:1], *frames[-1:]])), of=MAIN)
    if verdicts and len(variants) > 1:
        table = verdicts_by_variant(tables, examples, summary).set_index("variant").loc[variants]
        usual = table.loc[MAIN]
        cells = [[name, *(verdict_cell(str(table.loc[name, c]), str(usual[c])) for c in RULES)] for name in variants]
        body += [
            paragraph(
                "The claims with each change. ≠: another verdict than as declared. C6 needs a kept cloud and is "
                "undecided where there is none."
            ),
            Grid.of(("variation", *RULES), cells, left=1 + len(RULES)).html(),
        ]
    calls = false_calls(tables.runs)
    body += [heading("False calls"), note(CALLS_NOTE), calls_grid(calls[calls["variant"] == MAIN]).html()]
    under = [note(f"{found_rule(repeats)} {DRAWS.format(draws)}")]
    end = closing(provenance, experiment_yaml_text, left_out(tables.runs))
    return page(title, answer_sentence(main, verdicts), [*body, *end], under)


def answer_sentence(main: pd.DataFrame, verdicts: Sequence[Verdict] = ()) -> str:
    """Say what the experiment found in a sentence or two: the holes found with the most and the fewest frames, and
    the claims.

    ``main``: summary rows of the main variant.
    """
    if main.empty:
        return "No trial of the main experiment finished, so there is no answer."
    frames = sorted(int(n) for n in main["frames"].unique())
    parts: list[str] = []
    for n in dict.fromkeys((frames[-1], frames[0])):
        status = found_holes(main, MAIN, n)
        found = [hole for hole, state in status.items() if state == "found"]
        open_ = [hole for hole, state in status.items() if state == "undecided"]
        text = f"{len(found)} of {len(status)} holes"
        if found:
            least = float(main["true_diameter_mm"][main["hole"].isin(found)].min())
            drill = f", {inches(least)}" if inches(least) else ""
            text += f" ({hole_list(found)}; the smallest is {least:.2f} mm{drill})"
        text += f", with {hole_list(open_)} undecided" if open_ else ""
        counted = "one frame" if n == 1 else f"{n} averaged frames"
        parts.append(f"with {counted} {text}" if parts else f"With {counted} the camera finds {text}")
    return f"{'; '.join(parts)}.{counted_verdicts(verdicts)}"


def _rates(main: pd.DataFrame, frames: Sequence[int]) -> Grid:
    """A row per hole with a cell per number of frames: counts, interval, status, shade of blue by rate."""
    rows = []
    for hole, part in main.groupby("hole", sort=False):
        first, there = part.iloc[0], {int(row["frames"]): row for row in records(part)}
        cells: list[str | Cell] = [str(hole), inches(float(first["true_diameter_mm"]))]
        cells += [f"{first['true_diameter_mm']:.2f}", str(first["kind"])]
        rows.append(cells + [_rate(there[n]) if n in there else "–" for n in frames])
    heads = ("hole", "drill", "true diameter (mm)", "kind", *(f"{n} frame{'s' if n > 1 else ''}" for n in frames))
    return Grid.of(heads, rows, left=2)


def _rate(row: Mapping[str, Any]) -> Cell:
    rate, low, high = (float(row[name]) for name in ("rate", "rate_low", "rate_high"))
    shares = {state: float(row[f"share_{state.replace(' ', '_')}"]) for state in STATES}
    seen = ", ".join(f"{state} {100 * share:.0f} %" for state, share in shares.items() if share > 0)
    interval = f"rate {bounded(rate, low, high)}, 95 % Wilson interval"
    hover = f"{row['status']}: {interval}. The hole's pixels: {seen or 'unknown'}"
    return Cell(f"{row['detected']}/{row['n']}\n{low:.2f}–{high:.2f}, {row['status']}", share=rate, hover=hover)


def _measured(main: pd.DataFrame) -> list[Markup]:
    """Size, depth and centre of each hole with the most frames, by both measures, against the truth."""
    if main.empty:
        return []
    rows = [
        (
            str(row["hole"]),
            mm(row["true_diameter_mm"]),
            plus_minus(row["extent_diameter_mean_mm"], row["extent_diameter_std_mm"]),
            plus_minus(row["model_diameter_mean_mm"], row["model_diameter_std_mm"]),
            mm(row["model_diameter_se_mean_mm"]),
            f"{100 * row['model_diameter_covered']:.0f} %" if np.isfinite(row["model_diameter_covered"]) else "–",
            mm(row["seen_depth_mm"], 1),
            plus_minus(row["model_depth_mean_mm"], row["model_depth_std_mm"]),
            mm(row["model_depth_se_mean_mm"]),
            mm(row["extent_error_mean_mm"]),
            mm(row["model_error_mean_mm"]),
        )
        for row in records(main[main["frames"] == main["frames"].max()])
    ]
    heads = (
        *("hole", "true (mm)", "extent (mm)", "model (mm)", "its stated error (mm)", "truth within 1.96 of it"),
        *("depth seen (mm)", "model's depth (mm)", "its stated error (mm)"),
        *("centre off, extent (mm)", "centre off, model (mm)"),
    )
    said = (
        "With the most frames: mean ± one standard deviation over the repeats, which share one fixed pattern; another "
        "unit of the camera differs by more than they do. The stated errors are those of the fits. \"Depth seen\" is "
        "along the optical axis to the floor or to what stands behind the hole; centres are in three dimensions, and "
        "that of the extent lies at the points' mean depth."
    )  # fmt: skip
    return [Grid.of(heads, rows).html(), note(said)]


def _shapes(cloud: ExampleCloud) -> Grid:
    """Misfits of bowl and cylinder to each hole, and to the true geometry at the same pixels."""
    heads = (
        *("hole", "pixels", "true depth (mm)", "misfit as a bowl (mm)", "as a cylinder (mm)"),
        *("as the true hole seen (mm)", "true geometry as a bowl (mm)", "as a cylinder (mm)"),
        *(f"reached at {ring:g} R" for ring in RINGS),
        "looks",
    )
    rows = [
        (
            shape.hole,
            str(shape.pixels),
            mm(shape.true_depth_mm, 1),
            *map(mm, (shape.bowl_rms_mm, shape.cylinder_rms_mm, shape.seen_rms_mm)),
            *map(mm, (shape.true_bowl_rms_mm, shape.true_cylinder_rms_mm)),
            *(f"{100 * share:.0f} %" if np.isfinite(share) else "–" for share in shape.reached),
            LOOKS[shape.looks],
        )
        for shape in hole_shapes(cloud)
    ]
    return Grid.of(heads, rows)


def _noise(noise: pd.DataFrame) -> Grid:
    shown = {
        "temporal_rms_mm": "temporal noise (mm)",
        "guide_mm": "1/√N guide (mm)",
        "offset_mm": "offset (mm)",
        "pattern_mm": "pattern (mm)",
        "systematic_mm": "systematic (mm)",
        "total_rms_mm": "total (mm)",
        "displacement_mm": "whole cloud displaced (mm)",
    }
    rows = [
        (
            str(row["frames"]),
            *(f"{row[name]:+.3f}" if name == "offset_mm" else mm(row[name], 3) for name in shown),
            f"{row['pixels']} × {row['repeats']}",
        )
        for row in records(noise)
    ]
    return Grid.of(("frames", *shown.values(), "pixels × repeats"), rows, left=0)
