"""The report: result tables in, one self-contained HTML page out. It opens without a network and runs no script."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from harness.evaluation.noise import noise_against_frames
from harness.evaluation.profile import RINGS, hole_shapes
from harness.evaluation.set_ups import set_ups_of
from harness.evaluation.summary import MAIN, false_calls, found_holes, found_rule, hole_list, summarise_holes
from harness.report.clouds import LOOKS, cloud_figure, profile_figure, residual_figure
from harness.report.examples import ExampleCloud, MappedExample
from harness.report.measures import positions_figure, sizes_figure
from harness.report.noise import noise_figure
from harness.report.page_parts import MARKS, call_row, closing, rate_cell, template
from harness.report.perspectives_page import map_files, map_text, perspectives_html
from harness.report.set_ups_page import set_ups_html
from harness.report.view3d import write_view3d
from harness.tables.text import inches, mm
from harness.tables.trials import ResultTables
from harness.thesis.claims import RULES, score_claims, verdicts_by_variant
from harness.thesis.verdicts import FEW, MANY, Verdict
from harness.vocabulary.files import write_text

if TYPE_CHECKING:
    import pandas as pd


def write_report(
    folder: Path,
    tables: ResultTables,
    examples: Sequence[ExampleCloud | MappedExample],
    provenance: Mapping[str, Any],
    experiment_yaml_text: str,
    title: str,
) -> Path:
    """Write ``folder/report.html`` and return its path: the page of one set-up, that of several side by side, or that
    of maps, with a page beside it for each map of ``examples`` that turns in the browser.

    ``provenance`` may hold: ``command``, ``commit``, ``dirty``, ``versions``, ``mitsuba_variant``, ``seed``,
    ``machine``, ``started``, ``seconds`` (by stage), ``indirect_noise_mm``, ``renders``, ``failures`` (texts, or
    mappings with their parts); whatever else it holds is shown as it is, and a missing one as not recorded. The same
    input gives the same bytes. Raises UserError where the folder cannot be written.
    """
    rest = provenance, experiment_yaml_text, title
    clouds = [example for example in examples if isinstance(example, ExampleCloud)]
    maps = [example for example in examples if isinstance(example, MappedExample)]
    if len(tables.registrations):
        page = perspectives_html(tables, maps, *rest)
    else:
        page = (set_ups_html if len(set_ups_of(tables)) > 1 else report_html)(tables, clouds, *rest)
    for name, example in map_files(maps).items():
        write_view3d(Path(folder) / name, example, map_text(example))
    path = Path(folder) / "report.html"
    write_text(path, page)
    return path


def report_html(
    tables: ResultTables,
    examples: Sequence[ExampleCloud],
    provenance: Mapping[str, Any],
    experiment_yaml_text: str,
    title: str,
) -> str:
    """The page of an experiment with one set-up as text; see `write_report`."""
    summary = summarise_holes(tables.holes)
    main = summary[summary["variant"] == MAIN]
    noise = noise_against_frames(tables.probes[tables.probes["variant"] == MAIN])
    clouds = sorted((e for e in examples if e.variant == MAIN), key=lambda e: e.frames)
    verdicts = score_claims(tables, MAIN, examples, summary)
    calls = false_calls(tables.runs)
    return template("report.html").render(
        title=title,
        answer=answer_sentence(main, verdicts),
        found_rule=found_rule(int(main["n"].max()) if len(main) else 0),
        frames=sorted(int(n) for n in main["frames"].unique()),
        repeats=int(main["n"].max()) if len(main) else 0,
        holes=_hole_rows(main),
        figures=_figures(main, noise, clouds),
        variant_repeats=_largest(summary.loc[summary["variant"] != MAIN, "n"]),
        measures=_measure_rows(main),
        shapes=_shape_rows(clouds),
        rings=[f"{ring:g} R" for ring in RINGS],
        verdicts=verdicts,
        claims=list(RULES),
        variants=_variant_rows(tables, summary, verdicts_by_variant(tables, examples, summary)),
        noise=noise.to_dict("records"),
        calls=[call_row(row) for _, row in calls[calls["variant"] == MAIN].iterrows()],
        **closing(tables, provenance, experiment_yaml_text),
    )


def answer_sentence(main: pd.DataFrame, verdicts: Sequence[Verdict]) -> str:
    """What the experiment says, in a sentence or two: the holes found with the most and the fewest frames, the claims.

    ``main``: summary rows of the main variant.
    """
    if main.empty:
        return "No trial of the main experiment finished, so there is no answer."
    frames = sorted(int(n) for n in main["frames"].unique())
    parts = [f"With {_counted(frames[-1])} the camera finds {_found_phrase(main, frames[-1])}"]
    if len(frames) > 1:
        parts.append(f"with {_counted(frames[0])} {_found_phrase(main, frames[0])}")
    answers = [
        f"{len(names)} {'is' if len(names) == 1 else 'are'} {answer} ({', '.join(names)})"
        for answer in MARKS
        if (names := [verdict.claim for verdict in verdicts if verdict.verdict == answer])
    ]
    listed = answers[0] if len(answers) == 1 else ", ".join(answers[:-1]) + " and " + answers[-1]
    return f"{'; '.join(parts)}. Of the {len(verdicts)} claims scored, {listed}."


def _found_phrase(main: pd.DataFrame, frames: int) -> str:
    status = found_holes(main, MAIN, frames)
    found = [hole for hole, state in status.items() if state == "found"]
    open_ = [hole for hole, state in status.items() if state == "undecided"]
    text = f"{len(found)} of {len(status)} holes"
    if found:
        least = float(main["true_diameter_mm"][main["hole"].isin(found)].min())
        text += f" ({hole_list(found)}; the smallest is {least:.2f} mm{', ' + inches(least) if inches(least) else ''})"
    return text + (f", with {hole_list(open_)} undecided" if open_ else "")


def _counted(frames: int) -> str:
    return "one frame" if frames == 1 else f"{frames} averaged frames"


def _figures(main: pd.DataFrame, noise: pd.DataFrame, clouds: Sequence[ExampleCloud]) -> dict[str, str]:
    """The figures that the data allow, as SVG text by name."""
    figures: dict[str, str] = {}
    if len(main):
        frames = sorted(int(n) for n in main["frames"].unique())
        figures |= {"sizes": sizes_figure(main, frames[0], frames[-1])}
        figures |= {"positions": positions_figure(main, frames[-1])}
    if clouds:
        figures |= {
            "cloud": cloud_figure(clouds),
            "residual": residual_figure(clouds),
            "profile": profile_figure(clouds),
        }
    if len(noise) and (noise["temporal_rms_mm"] > 0).all():
        figures |= {"noise": noise_figure(noise)}
    return figures


def _hole_rows(main: pd.DataFrame) -> list[dict[str, Any]]:
    """One row per hole with a cell per number of frames: counts, interval, shade of blue by rate."""
    out = []
    for hole, part in main.groupby("hole", sort=False):
        first = part.iloc[0]
        out.append(
            {
                "hole": hole,
                "drill": inches(float(first["true_diameter_mm"])),
                "diameter": f"{first['true_diameter_mm']:.2f}",
                "kind": first["kind"],
                "cells": {int(row["frames"]): rate_cell(row) for _, row in part.iterrows()},
            }
        )
    return out


def _shape_rows(clouds: Sequence[ExampleCloud]) -> list[dict[str, Any]]:
    if not clouds:
        return []
    return [
        {
            "hole": shape.hole,
            "pixels": str(shape.pixels),
            "depth": mm(shape.true_depth_mm, 1),
            "seen": mm(shape.seen_rms_mm),
            "bowl": mm(shape.bowl_rms_mm),
            "cylinder": mm(shape.cylinder_rms_mm),
            "true_bowl": mm(shape.true_bowl_rms_mm),
            "true_cylinder": mm(shape.true_cylinder_rms_mm),
            "reached": [f"{100 * share:.0f} %" if np.isfinite(share) else "–" for share in shape.reached],
            "looks": LOOKS[shape.looks],
        }
        for shape in hole_shapes(clouds[-1])
    ]


def _measure_rows(main: pd.DataFrame) -> list[dict[str, str]]:
    """Size, depth and centre of each hole with the most frames, by both measures, against the truth; text in mm."""
    if main.empty:
        return []
    rows = main[main["frames"] == main["frames"].max()]
    return [
        {
            "hole": str(row["hole"]),
            "truth": mm(row["true_diameter_mm"], 2),
            "extent": _spread(row["extent_diameter_mean_mm"], row["extent_diameter_std_mm"]),
            "model": _spread(row["model_diameter_mean_mm"], row["model_diameter_std_mm"]),
            "model_se": mm(row["model_diameter_se_mean_mm"], 2),
            "covered": "–"
            if row["model_diameter_covered"] != row["model_diameter_covered"]
            else f"{100 * row['model_diameter_covered']:.0f} %",
            "seen": mm(row["seen_depth_mm"], 1),
            "depth": _spread(row["model_depth_mean_mm"], row["model_depth_std_mm"]),
            "depth_se": mm(row["model_depth_se_mean_mm"], 2),
            "extent_centre": mm(row["extent_error_mean_mm"], 2),
            "model_centre": mm(row["model_error_mean_mm"], 2),
        }
        for _, row in rows.iterrows()
    ]


def _largest(counts: pd.Series) -> int | None:
    return int(counts.max()) if len(counts) else None


def _spread(mean: float, std: float) -> str:
    return "–" if mean != mean else f"{mean:.2f}\u00a0±\u00a0{std:.2f}"


def _short(label: str) -> str:
    """A variant's label for a narrow column: of ``source.target.distance_m=0.5`` the last key, the value apart."""
    path, equals, value = label.partition("=")
    if not equals or " " in path:
        return label
    return f"{path.rpartition('.')[2].replace('_', ' ')} = {value}"


def _variant_rows(tables: ResultTables, summary: pd.DataFrame, verdicts: pd.DataFrame) -> list[dict[str, Any]]:
    """The sensitivity table's rows; a cell knows whether it differs from the main variant's."""
    merged = tables.variants[["variant", "reason", "settings"]].merge(verdicts, "left", "variant")
    rows = [{str(key): value for key, value in row.items()} for row in merged.to_dict("records")]
    rows.sort(key=lambda row: row["variant"] != MAIN)
    for row in rows:
        row["shown"] = _short(str(row["variant"]))
        for frames in (FEW, MANY):
            status = found_holes(summary, str(row["variant"]), frames)
            found, open_ = ([h for h, state in status.items() if state == s] for s in ("found", "undecided"))
            text = hole_list(found) + (f"; undecided {hole_list(open_)}" if open_ else "")
            row[f"found_{frames}"] = text if status else "not run"
    main = next((row for row in rows if row["variant"] == MAIN), None)
    for row in rows:
        compared = [*RULES, "found_1", "found_50"]
        row["changed"] = {key for key in compared if main is not None and row[key] != main[key]}
    return rows
