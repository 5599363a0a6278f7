"""The page of an experiment with several views: whether more of them beat one, and what registering and merging do."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import count
from typing import TYPE_CHECKING, Any

import numpy as np
from markupsafe import Markup

from harness.evaluation.maps import (
    THESIS_MERGE,
    THESIS_REGISTRATION,
    AgainstOne,
    MapCase,
    against_one,
    change_text,
    compare_maps,
    label_of,
    map_cases,
    maps_of,
    ratio_text,
    span,
)
from harness.evaluation.registration import PARTS, by_views, summarise_registrations, trusted
from harness.evaluation.summary import found_rule, hole_list, summarise_holes
from harness.report.blocks import bullets, closing, figure, folded, heading, links, note, page, paragraph, subheading
from harness.report.claims import claims_section
from harness.report.examples import MappedExample
from harness.report.set_ups import count_text, error_text, found_text, left_out, limit_text, records
from harness.report.views_figures import (
    BEFORE,
    fiducials_figure,
    found_figure,
    merged_figure,
    method_text,
    noise_views_figure,
    shadow_figure,
    tre_figure,
    two_views_figure,
)
from harness.tables.grid import Cell, Grid
from harness.tables.text import bounded, mm
from harness.tables.trials import ResultTables
from harness.thesis.verdicts import Verdict
from harness.thesis.views import duels_of, score_views

if TYPE_CHECKING:
    import pandas as pd

Row = Mapping[str, Any]

MOST_CLOUDS = 5
RESPECTS = {"holes": "holes found", "size": "their size", "noise": "noise"}
"""Respects in which H1's map may be ahead."""
LEADS = {"borne out": "Yes", "not borne out": "Not in every respect", "undecided": "That stays open"}
"""The first words of the answer, by the verdict on H1."""


@dataclass(frozen=True)
class Ways:
    """The set-ups by way of making a map (down) and number of views (across).

    ``views``: numbers of views, ascending. ``rows``: the way in words -> variant by number of views. ``shown_frames``:
    the least and the most frames a view. ``several_places``: whether a way's words name a place too.
    """

    views: tuple[int, ...]
    rows: Mapping[str, Mapping[int, str]]
    shown_frames: tuple[int, ...]
    several_places: bool

    @staticmethod
    def of(tables: ResultTables, compared: pd.DataFrame) -> Ways:
        """The layout of an experiment's set-ups, variations left out."""
        set_ups = [one for one in maps_of(tables) if not one.is_variation]
        several_places = len({one.place for one in set_ups}) > 1
        rows: dict[str, dict[int, str]] = {}
        for one in set_ups:
            way = label_of(one.registration, one.merge, one.place if several_places else "")
            rows.setdefault(way, {})[one.views] = one.variant
        own = compared[~compared["is_variation"]] if len(compared) else compared
        frames = sorted(int(n) for n in own["frames"].unique()) if len(own) else []
        shown = tuple(dict.fromkeys([*frames[:1], *frames[-1:]]))
        return Ways(tuple(sorted({one.views for one in set_ups})), rows, shown, several_places)

    def found(self, compared: pd.DataFrame, frames: int) -> Grid:
        """Holes found with ``frames``: a row for each way with a cell for each number of views, the bluer the more."""
        rows = [[row["name"], *row["cells"]] for row in self.table(compared, frames, _found_cell)]
        return Grid.of(("registration, merge", *(_views(n) for n in self.views)), rows)

    def table(self, compared: pd.DataFrame, frames: int, cell: Callable[[Row | None], Any]) -> list[dict[str, Any]]:
        """One row for each way with a cell for each number of views, made of the row of ``compared`` or of None."""
        there = {(row["variant"], row["frames"]): row for row in records(compared)}
        return [
            {"name": name, "cells": [cell(there.get((variants.get(n, ""), frames))) for n in self.views]}
            for name, variants in self.rows.items()
        ]

    def numbers(self, compared: pd.DataFrame, frames: int) -> Grid:
        """Noise, threshold, false calls and time of every map with ``frames``: a row for each way and views."""
        there = {(row["variant"], row["frames"]): row for row in records(compared)}
        rows = []
        for name, variants in self.rows.items():
            for at, n in enumerate(n for n in self.views if n in variants):
                row = there.get((variants[n], frames))
                rows.append(["" if at else name, str(n), *(["–"] * 7 if row is None else _numbers(row))])
        heads = ("registration, merge", "views", "temporal noise (mm)", "systematic (mm)", "surface noise (mm)")
        calls = ("threshold (mm; k)", "false calls", "time (s)", "views left out")
        return Grid.of((*heads, *calls), rows)


def _found_cell(row: Row | None) -> Cell:
    if row is None:
        return Cell("–", hover="not finished")
    hover = f"all found from {limit_text(row)} on" if np.isfinite(row["limit_mm"]) else "none found"
    return Cell(f"{count_text(row)}\n{found_text(row)}", share=len(row["found"]) / row["holes"], hover=hover)


def _numbers(row: Row) -> list[str]:
    calls = f"{int(row['false_calls'])} in {int(row['runs'])}" if np.isfinite(row["runs"]) else "–"
    return [
        mm(row["temporal_mm"], 3),
        mm(float(np.hypot(row["offset_mm"], row["pattern_mm"])), 3),
        mm(row["surface_mm"], 3),
        f"{mm(row['threshold_mm'])}; {mm(row['threshold'], 1)}",
        calls,
        mm(row["seconds_map"]),
        f"{row['views_left_out']:.2f}",
    ]


def perspectives_html(
    tables: ResultTables,
    examples: Sequence[MappedExample],
    provenance: Mapping[str, Any],
    experiment_yaml_text: str,
    title: str,
    with_claims: bool = False,
) -> str:
    """The page as text; the arguments are those of `harness.report.page.write_report`."""
    summary = summarise_holes(tables.holes, [str(path) for path in tables.axes["path"]])
    compared = compare_maps(tables, summary)
    cases = map_cases(tables, summary)
    ways = Ways.of(tables, compared)
    verdicts = score_views(cases) if with_claims else []
    set_ups = compared[~compared["is_variation"]] if len(compared) else compared
    varied = tables.variants["variant"][tables.variants["is_variation"].astype(bool)]
    own = tables.registrations[~tables.registrations["variant"].isin(varied)]
    pair = _two_against_one(cases)
    figures = _figures(tables, examples, cases, summary, ways, set_ups, own, pair)
    repeats = int(set_ups["repeats"].max()) if len(set_ups) else 0
    draws = "The one repeat is one draw" if repeats == 1 else f"The repeats are {repeats} draws"
    under = note(
        f"{found_rule(repeats)} Each set-up has hole-free runs and a threshold of its own. {draws} of the camera's "
        "noise and of the error of the nominal poses; the poses, the board and the camera's unit stay the same, and "
        "the same frames feed every set-up, so that differences are paired. Of a single view all ways of registering "
        "are the same."
    )
    shown = ways.shown_frames[::-1]
    others = " Other places than the first are in the tables." if ways.several_places else ""
    body = [
        *claims_section("The thesis' claims and its proposal", verdicts),
        heading("Holes found"),
        figure(
            figures,
            "found",
            "Holes found against the number of views, for each way of registering (lines, set a little apart) and of "
            f"merging (columns).{others}",
        ),
        *folded([(_frames(n), ways.found(set_ups, n).html()) for n in shown]),
        heading("Fiducials before and after"),
        figure(
            figures,
            "fiducials",
            "Points of the fiducial colour of the first view (orange) and the second (blue) in the board's true frame: "
            "first the whole face, then one mark, then edge-on with the height out of the face drawn larger than it "
            "is. “Before” is the nominal pose, on a scale of its own where edge-on.",
        ),
        *_registration_section(figures, own, ways),
        heading("Merged clouds"),
        figure(
            figures,
            "merged",
            "Points from the front, thinned out, in the colour of the view that they came from. Rings: the true holes, "
            "dashed where this map shows none; the smallest are drawn wider than they are. Crosses: findings that are "
            "no hole.",
        ),
    ]
    files = map_files(examples)
    if files:
        targets = links((map_text(example), name) for name, example in files.items())
        body.append(paragraph("The same maps, to turn with the mouse: ", targets))
    body += _two_views_section(figures, cases, pair)
    frames = f"{ways.shown_frames[-1]} frame{'s' if ways.shown_frames[-1] > 1 else ''}" if shown else "no frames"
    body += [
        heading("Shadow in the holes"),
        figure(
            figures,
            "shadow",
            "From the geometry alone: the share of the wall's area that no lens sees through the mouth, and that no "
            "view both sees and lights, averaged over holes of one size.",
        ),
        heading("Noise, thresholds, false calls and time of the maps"),
        figure(
            figures,
            "map_noise",
            f"With {frames} a view, at fixed places of the hole-free board. Above: scatter over repeats, displacements "
            "of whole maps taken out, with the guide 1/√views. Below: what all repeats share, offset and pattern "
            "together.",
        ),
        *folded([(_frames(n), ways.numbers(set_ups, n).html()) for n in shown]),
        note(
            "Surface noise: robust deviation from the fitted surface on undamaged face, which a threshold has to "
            "clear. It holds whatever does not follow that surface, systematic or not. A grid that keeps the points of "
            "all views keeps their noise; a map with one value a cell averages it. False calls: detections that belong "
            "to no hole, in runs on the damaged board. Where the threshold is calibrated, it is the highest of the "
            "quiet thresholds of R hole-free runs with other noise (the lowest k without a false cluster in each); one "
            "more such run would exceed it with probability 1/(R + 1). Time: seconds from the views' clouds to the "
            "map, median of the runs on the damaged board; registrations that set-ups share count where they were "
            "made. Views left out: mean number that a run leaves out because their registration failed."
        ),
        *_varied_section(tables, compared),
    ]
    end = closing(provenance, experiment_yaml_text, left_out(tables.runs))
    return page(title, answer_sentence(cases, verdicts), [*body, *end], [under])


def answer_sentence(cases: Sequence[MapCase], verdicts: Sequence[Verdict] = ()) -> str:
    """Say what the experiment found: the holes found with one view and with several; with verdicts also by the
    thesis' way of merging two, and by the most fused."""
    said = []
    for case in cases:
        alone = case.single()
        if alone is None:
            continue
        shown = {"": alone}
        if verdicts:
            duel = next(iter(duels_of(case)), None)
            two = case.named(2, THESIS_REGISTRATION, THESIS_MERGE)
            shown |= {" (CPD, grid)": two} if two else {}
            shown |= {f" ({method_text(duel.registration)}, fusion)": duel.mapped} if duel else {}
        else:
            several = [
                (f" ({label_of(method_text(one.registration), one.merge)})", found)
                for one in sorted(case.set_ups, key=lambda one: -one.views)
                if one.views > 1 and (found := case.named(one.views, one.registration, one.merge, alone.frames))
            ]
            # Of the maps with the most views the one that finds the most holes.
            most = [each for each in several if each[1].views == several[0][1].views]
            shown |= dict(sorted(most, key=lambda each: -list(case.status(each[1]).values()).count("found"))[:1])
        counts: list[str] = []
        for way, mapped in shown.items():
            states = list(case.status(mapped).values())
            views = "one view finds" if mapped.views == 1 else f"{mapped.views} views{way}"
            open_ = f" ({states.count('undecided')} undecided)" if "undecided" in states else ""
            of = "" if counts else f" of {len(states)} holes"
            counts.append(f"{views} {states.count('found')}{of}{open_}")
        where = f"{case.place}: " if len(cases) > 1 else ""
        said.append(f"{where}With {_frames(alone.frames)} {', '.join(counts)}.")
    if not said:
        return "No trial of any set-up finished, so there is no answer."
    if not verdicts:
        return " ".join(said)
    leads = list(dict.fromkeys(LEADS[verdict.verdict] for verdict in verdicts if verdict.claim == "H1"))
    ahead = ""
    if leads == [LEADS["borne out"]]:
        duels = [duel for case in cases for duel in duels_of(case)]
        everywhere = [RESPECTS[name] for name in RESPECTS if all(duel.standings[name] == "ahead" for duel in duels)]
        ahead = f", in {' and '.join(everywhere)}" if everywhere else ""
    answers = ", ".join(f"{verdict.claim} is {verdict.verdict}" for verdict in verdicts)
    return f"Do more views beat one? {' / '.join(leads)}{ahead}. {' '.join(said)} {answers}."


def map_files(examples: Sequence[MappedExample]) -> dict[str, MappedExample]:
    """The file of each map that turns in the browser, beside the report."""
    files: dict[str, MappedExample] = {}
    for example in _in_order(examples):
        words = f"map {example.views} views {example.registration} {example.merge} {example.frames} frames"
        words += f" {example.variant}" if example.is_variation else ""
        stem = re.sub(r"[^a-z0-9]+", "-", words.lower()).strip("-")
        names = (f"{stem}{f'-{number}' if number > 1 else ''}.html" for number in count(1))
        files[next(name for name in names if name not in files)] = example
    return files


def map_text(example: MappedExample) -> str:
    """One map in words."""
    way = ", ".join(part for part in (method_text(example.registration), example.merge) if part)
    variation = f": {example.variant}" if example.is_variation else ""
    return f"{_views(example.views)} ({way}), {_frames(example.frames)}{variation}"


def _frames(frames: int) -> str:
    return f"{frames} frame{'s' if frames > 1 else ''} a view"


def _views(views: int) -> str:
    return f"{views} view{'s' if views > 1 else ''}"


def _in_order(examples: Sequence[MappedExample]) -> list[MappedExample]:
    """The most frames first, then by views and way."""
    return sorted(examples, key=lambda e: (-e.frames, e.views, e.registration, e.merge, e.variant))


def _figures(
    tables: ResultTables,
    examples: Sequence[MappedExample],
    cases: Sequence[MapCase],
    summary: pd.DataFrame,
    ways: Ways,
    set_ups: pd.DataFrame,
    own: pd.DataFrame,
    pair: AgainstOne | None,
) -> dict[str, str]:
    """The figures that the data allow, as SVG text by name; of several places those that need one show the first."""
    figures: dict[str, str] = {}
    if len(set_ups):
        first = set_ups[set_ups["place"] == cases[0].place]
        figures["found"] = found_figure(first, ways.shown_frames)
        if (first["temporal_mm"][first["frames"] == ways.shown_frames[-1]] > 0).any():
            figures["map_noise"] = noise_views_figure(first, ways.shown_frames[-1])
    if len(own):
        figures["tre"] = tre_figure(own, ways.shown_frames)
    several = [example for example in _in_order(examples) if example.views > 1]
    marked = [
        example
        for example in several
        if len(example.placed) > 1
        and "truth" in example.placed[0].T_board_view
        and BEFORE in example.placed[1].T_board_view
        and all(len(view.marks_mm) for view in example.placed[:2])
    ]
    if marked:
        figures["fiducials"] = fiducials_figure(max(marked, key=lambda e: (len(e.placed[1].T_board_view), e.frames)))
    if several:
        figures["merged"] = merged_figure(several[:MOST_CLOUDS])
    if pair is not None and len(pair.sizes.holes):
        figures["two_views"] = two_views_figure(pair, summary)
    if len(tables.walls):
        figures["shadow"] = shadow_figure(tables.walls)
    return figures


def _registration_section(figures: Mapping[str, str], own: pd.DataFrame, ways: Ways) -> list[Markup]:
    summary = records(summarise_registrations(own))
    rows = []
    for row in summary:
        failed = f"{row['failed']} ({100 * row['failed_low']:.0f}–{100 * row['failed_high']:.0f} %)"
        cells = [row["method"], str(row["frames"]), str(row["n"]), failed, mm(row["guess_mm"], 1)]
        for part in PARTS:
            cells += [
                f"{mm(row[f'{part}_median_mm'])}; {mm(row[f'{part}_q90_mm'])}",
                f"{mm(row[f'{part}_rms_mm'])}; {mm(row[f'{part}_predicted_mm'])}",
                bounded(row[f"{part}_ratio"], row[f"{part}_ratio_low"], row[f"{part}_ratio_high"]),
            ]
        rows.append([*cells, f"{1000 * row['seconds']:.1f}" if np.isfinite(row["seconds"]) else "–"])
    names = [
        f"{where}: {what}" for where in ("in plane", "across") for what in ("median; 90 %", "rms; predicted", "ratio")
    ]
    heads = ("method", "frames", "number", "failed (95 %)", "before (mm)", *names, "time (ms)")
    reasons = [
        f"{row['method']}, {_frames(row['frames'])}: {'; '.join(row['reasons'])}" for row in summary if row["reasons"]
    ]
    counted = {(row["frames"], row["method"], row["views"]): row for row in records(by_views(own, ways.views))}
    tables = []
    for frames in ways.shown_frames[::-1]:
        views = [n for n in ways.views if n > 1]
        lines = [
            [method, *(_rms(counted.get((frames, method, n))) for n in views)]
            for method in dict.fromkeys(method for n, method, _ in counted if n == frames)
        ]
        title = f"By the number of views, {_frames(frames)}: in the plane; across it (mm, rms)"
        tables.append((title, Grid.of(("method", *(f"{n} views" for n in views)), lines).html()))
    return [
        heading("Registration error"),
        paragraph(
            "The target registration error: how far places on the board lie from where they should, as root mean "
            "square over the board, against the truth. A camera that ranges too far displaces all that it sees at an "
            "angle within the plane as well, marks and holes alike: that counts here, though it does not blur the map. "
            "A registration that failed is found out without the truth, and its view is left out of the map."
        ),
        figure(
            figures,
            "tre",
            "Each registration of a view to the first, on a logarithmic scale. The prediction is what the method's own "
            "covariance says; it holds the noise of the marks or points, no error that a whole view shares.",
        ),
        Grid.of(heads, rows).html(),
        note(
            "Errors in mm of those that did not fail; both boards, with and without holes. Ratio: actual over "
            "predicted, 1 is honest, above 1 too sure of itself; its interval is a bootstrap over repeats. Before: "
            "median error of the nominal pose."
        ),
        *([subheading("Why registrations failed"), bullets(reasons)] if reasons else []),
        *([] if reasons else [paragraph("No registration failed.")]),
        *folded(tables),
    ]  # fmt: skip


def _rms(row: Row | None) -> str:
    return "–" if row is None else f"{mm(row['in_plane_rms_mm'])}; {mm(row['across_rms_mm'])}"


def _two_against_one(cases: Sequence[MapCase]) -> AgainstOne | None:
    """Two views against one at the first place: registered by CPD and merged on the grid, else the first way tried."""
    if not cases:
        return None
    ways = [(THESIS_REGISTRATION, THESIS_MERGE), *((one.registration, one.merge) for one in cases[0].set_ups)]
    return next((found for way in ways if (found := against_one(cases[0], *way))), None)


def _two_views_section(figures: Mapping[str, str], cases: Sequence[MapCase], pair: AgainstOne | None) -> list[Markup]:
    rows = []
    for case in cases:
        for registration, merge in dict.fromkeys(
            (one.registration, one.merge) for one in case.set_ups if one.views == 2
        ):
            found, model = (against_one(case, registration, merge, measure=m) for m in ("extent", "model"))
            if found is None or model is None:
                continue
            crossing = f"{found.sizes.crossing_mm:.1f} ({span(found.sizes.crossing_interval, 1)})"
            rows.append(
                [
                    label_of(registration, merge, case.place),
                    f"{change_text(found.large, '')}\nmodel {change_text(model.large, '')}",
                    f"{change_text(found.small, '')}\nmodel {change_text(model.small, '')}",
                    crossing if np.isfinite(found.sizes.crossing_mm) else "none",
                    change_text(found.threshold, ""),
                    ratio_text(found.noise),
                    hole_list(found.lost),
                    hole_list(found.gained),
                ]
            )
    heads = (
        *("registration, merge", "|size error| of 3/8 in and larger (mm)", "|size error| of smaller holes (mm)"),
        *("turn (mm)", "threshold (mm)", "surface noise", "found by one only", "found by two only"),
    )
    way = "" if pair is None else f" {_way_of(cases[0], pair)},"
    caption = (
        f"{way.strip().capitalize()} with the most frames. Below, each hole's change of the absolute size error from "
        "one view to two, paired by repeat, and where the isotonic regression of these changes on the diameter crosses "
        "zero."
    ).strip()  # fmt: skip
    said = (
        "Two views less one, merged in the same way, by the extent and, below it, by the model of the blurred hole: "
        "mean over holes and repeats with Student's 95 % interval over repeats. The draw of the thresholds' "
        "calibration is in no interval."
    )
    body = [heading("One view and two"), figure(figures, "two_views", caption)]
    return [*body, Grid.of(heads, rows).html(), note(said)] if rows else body


def _way_of(case: MapCase, pair: AgainstOne) -> str:
    """``registered by CPD, merged by grid``, of the several views of a pair."""
    way = next(one for one in case.set_ups if one.variant == pair.several.variant)
    parts = (f"registered by {method_text(way.registration)}", f"merged by {way.merge}")
    return ", ".join(part for part, name in zip(parts, (way.registration, way.merge), strict=True) if name)


def _varied_section(tables: ResultTables, compared: pd.DataFrame) -> list[Markup]:
    """The sensitivity study: each variation, and below it the set-up that it changes, with as many frames or else the
    most that it has; nothing without variations."""
    there: dict[str, list[dict[str, Any]]] = {}
    for row in records(compared):
        there.setdefault(str(row["variant"]), []).append(row)
    rows: list[list[str | Cell]] = []
    for variant in records(tables.variants[tables.variants["is_variation"].astype(bool)]):
        name, reference = str(variant["variant"]), str(variant["reference"])
        of_reference = f"\ncompared with {reference}" if reference else "\nno set-up beside it"
        named = [name, f"{variant['reason']}\n{variant['settings']}{of_reference}"]
        registrations = tables.registrations[tables.registrations["variant"] == name]
        registered = "as the set-up"
        if len(registrations):
            good = trusted(registrations)
            plane, across = (mm(float(good[f"tre_{part}_mm"].median())) for part in PARTS)
            failed = f"{len(registrations) - len(good)} of {len(registrations)} failed"
            registered = f"{plane} in the plane, {across} across; {failed}"
        for row in there.get(name, []):
            others = there.get(reference, [])
            alike = [other for other in others if other["frames"] == row["frames"]]
            other = (alike or others)[-1] if others else None
            differs = other is not None and (row["found"], row["undecided"]) != (other["found"], other["undecided"])
            rows.append(
                [*named, f"with it: {_views(row['views'])} × {_plain_frames(row)}", *_said(row, differs), registered]
            )
            if other is not None:
                rows.append(
                    ["", "", f"without: {_views(other['views'])} × {_plain_frames(other)}", *_said(other, False), ""]
                )
            named = ["", ""]
        if name not in there:
            rows.append([*named, "no trial of it finished", *[""] * 6])
    if not rows:
        return []
    heads = ("variation", "why", "", "found", "threshold (mm)", "surface noise (mm)", "size (mm)", "position (mm)")
    said = (
        "Each row changes something and stands beside the set-up that is like it in views, registration and merging, "
        "where there is one, with as many frames a view or else the most. What is found is marked with ≠ where it "
        "differs. Sizes and positions: mean error ± standard deviation (number) of the extent over the holes found. "
        "Registration error: median in mm."
    )
    table = Grid.of((*heads, "registration error"), rows, left=3)
    return [heading("If facts were otherwise"), paragraph(said), table.html()]


def _plain_frames(row: Row) -> str:
    return f"{row['frames']} frame{'s' if row['frames'] > 1 else ''}"


def _said(row: Row, differs: bool) -> list[str | Cell]:
    found = Cell(f"{'≠ ' if differs else ''}{count_text(row)}\n{found_text(row)}", "changed" if differs else "")
    numbers = [mm(row["threshold_mm"]), mm(row["surface_mm"], 3)]
    return [found, *numbers, error_text(row, "extent"), error_text(row, "extent_place")]
