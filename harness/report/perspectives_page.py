"""The page of an experiment with several views: whether more of them beat one, and what registering and merging do."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from itertools import count
from typing import TYPE_CHECKING, Any

from harness.evaluation.maps import (
    THESIS_MERGE,
    THESIS_REGISTRATION,
    AgainstOne,
    MapCase,
    against_one,
    compare_maps,
    map_cases,
)
from harness.evaluation.registration import by_views, summarise_registrations
from harness.evaluation.summary import found_rule, summarise_holes
from harness.report.examples import MappedExample
from harness.report.page_parts import closing, template
from harness.report.perspectives_rows import (
    Ways,
    against_rows,
    by_views_rows,
    call_cell,
    found_cell,
    noise_cell,
    registration_rows,
    time_cell,
    variation_rows,
)
from harness.report.registration_figures import BEFORE, fiducials_figure, method_text, tre_figure
from harness.report.views_figures import (
    found_figure,
    merged_figure,
    noise_views_figure,
    shadow_figure,
    two_views_figure,
)
from harness.tables.trials import ResultTables
from harness.thesis.verdicts import Verdict
from harness.thesis.views import duels_of, score_views

if TYPE_CHECKING:
    import pandas as pd

MOST_CLOUDS = 5
RESPECTS = {"holes": "holes found", "size": "their size", "noise": "noise"}
"""In what H1's map may be ahead."""
LEADS = {"borne out": "Yes", "not borne out": "Not in every respect", "undecided": "That stays open"}
"""The first words of the answer, by the verdict on H1."""


def perspectives_html(
    tables: ResultTables,
    examples: Sequence[MappedExample],
    provenance: Mapping[str, Any],
    experiment_yaml_text: str,
    title: str,
) -> str:
    """The page as text; the arguments are those of `harness.report.page.write_report`."""
    summary = summarise_holes(tables.holes, [str(path) for path in tables.axes["path"]])
    compared = compare_maps(tables, summary)
    cases = map_cases(tables, summary)
    ways = Ways.of(tables, compared)
    verdicts = score_views(cases)
    set_ups = compared[~compared["is_variation"]] if len(compared) else compared
    own = tables.registrations[~tables.registrations["variant"].isin(_variations(tables))]
    registered = by_views(own, ways.views)
    shown = ways.shown_frames[::-1]
    return template("perspectives.html").render(
        title=title,
        answer=answer_sentence(cases, verdicts),
        found_rule=found_rule(int(set_ups["repeats"].max()) if len(set_ups) else 0),
        repeats=int(set_ups["repeats"].max()) if len(set_ups) else 0,
        ways=ways,
        most_frames=shown[0] if shown else 0,
        verdicts=verdicts,
        found=[(n, ways.table(compared, n, found_cell)) for n in shown],
        calls=[(n, ways.table(compared, n, call_cell)) for n in shown],
        times=[(n, ways.table(compared, n, time_cell)) for n in shown],
        noise=[(n, ways.table(compared, n, noise_cell)) for n in shown],
        registrations=registration_rows(summarise_registrations(own)),
        by_views=[(n, by_views_rows(registered, ways.views, n)) for n in shown],
        against=against_rows(cases),
        variations=variation_rows(tables, compared),
        figures=_figures(tables, examples, cases, summary, ways, set_ups, own),
        links=[(map_text(example), name) for name, example in map_files(examples).items()],
        **closing(tables, provenance, experiment_yaml_text),
    )


def answer_sentence(cases: Sequence[MapCase], verdicts: Sequence[Verdict]) -> str:
    """What the experiment says: the holes found with one view, two merged as the thesis did, and the most fused."""
    said = []
    for case in cases:
        counts = _counts(case)
        if counts:
            where = f"{case.place}: " if len(cases) > 1 else ""
            said.append(f"{where}{counts}.")
    if not said:
        return "No trial of any set-up finished, so there is no answer."
    answers = ", ".join(f"{verdict.claim} is {verdict.verdict}" for verdict in verdicts)
    leads = [LEADS[verdict.verdict] for verdict in verdicts if verdict.claim == "H1"]
    ahead = _ahead(cases) if leads == [LEADS["borne out"]] else ""
    return f"Do more views beat one? {' / '.join(dict.fromkeys(leads))}{ahead}. {' '.join(said)} {answers}."


def _ahead(cases: Sequence[MapCase]) -> str:
    """In what the fused map is ahead of its rivals everywhere, such as ", in size and noise"."""
    duels = [duel for case in cases for duel in duels_of(case)]
    everywhere = [name for name in RESPECTS if all(duel.standings[name] == "ahead" for duel in duels)]
    return f", in {' and '.join(RESPECTS[name] for name in everywhere)}" if everywhere else ""


def map_files(examples: Sequence[MappedExample]) -> dict[str, MappedExample]:
    """The file of each map that turns in the browser, beside the report."""
    files: dict[str, MappedExample] = {}
    for example in _in_order(examples):
        words = f"map {example.views} views {example.registration} {example.merge} {example.frames} frames"
        words += f" {example.variant}" if example.is_variation else ""
        name = re.sub(r"[^a-z0-9]+", "-", words.lower()).strip("-")
        number = next(n for n in count(1) if _file(name, n) not in files)
        files[_file(name, number)] = example
    return files


def _file(name: str, number: int) -> str:
    return f"{name}{f'-{number}' if number > 1 else ''}.html"


def map_text(example: MappedExample) -> str:
    """One map in words."""
    way = ", ".join(part for part in (method_text(example.registration), example.merge) if part)
    return (
        f"{example.views} view{'s' if example.views > 1 else ''} ({way}), {example.frames} "
        f"frame{'s' if example.frames > 1 else ''} a view{f': {example.variant}' if example.is_variation else ''}"
    )


def _counts(case: MapCase) -> str:
    """Holes found with one view, two by the thesis' way, and the most fused; empty where no single view is there."""
    one, duel = case.single(), next(iter(duels_of(case)), None)
    if one is None:
        return ""
    shown = {"": one, " (CPD, grid)": case.named(2, THESIS_REGISTRATION, THESIS_MERGE)}
    if duel is not None:
        shown[f" ({method_text(duel.registration)}, fusion)"] = duel.mapped
    said: list[str] = []
    for way, mapped in shown.items():
        if mapped is not None:
            states = list(case.status(mapped).values())
            views = "one view finds" if mapped.views == 1 else f"{mapped.views} views{way}"
            open_ = f" ({states.count('undecided')} undecided)" if "undecided" in states else ""
            said.append(f"{views} {states.count('found')}{f' of {len(states)} holes' if not said else ''}{open_}")
    return f"With {one.frames} frame{'s' if one.frames > 1 else ''} a view {', '.join(said)}"


def _variations(tables: ResultTables) -> list[str]:
    return [str(name) for name in tables.variants["variant"][tables.variants["is_variation"].astype(bool)]]


def _figures(
    tables: ResultTables,
    examples: Sequence[MappedExample],
    cases: Sequence[MapCase],
    summary: pd.DataFrame,
    ways: Ways,
    set_ups: pd.DataFrame,
    own: pd.DataFrame,
) -> dict[str, str]:
    """The figures that the data allow, as SVG text by name; of several places those that need one show the first."""
    figures: dict[str, str] = {}
    if len(set_ups):
        first = set_ups[set_ups["place"] == cases[0].place]
        figures["found"] = found_figure(first, ways.shown_frames)
        most = first[first["frames"] == ways.shown_frames[-1]]
        if (most["temporal_mm"] > 0).any():
            figures["map_noise"] = noise_views_figure(first, ways.shown_frames[-1])
    if len(own):
        figures["tre"] = tre_figure(own, ways.shown_frames)
    shown = [example for example in _in_order(examples) if len(example.placed) > 1 and _has_marks(example)]
    if shown:
        figures["fiducials"] = fiducials_figure(max(shown, key=lambda e: (len(e.placed[1].T_board_view), e.frames)))
    several = [example for example in _in_order(examples) if example.views > 1][:MOST_CLOUDS]
    if several:
        figures["merged"] = merged_figure(several)
    against = _thesis_pair(cases)
    if against is not None and len(against.sizes.holes):
        figures["two_views"] = two_views_figure(against, summary)
    if len(tables.walls):
        figures["shadow"] = shadow_figure(tables.walls)
    return figures


def _thesis_pair(cases: Sequence[MapCase]) -> AgainstOne | None:
    return against_one(cases[0], THESIS_REGISTRATION, THESIS_MERGE) if cases else None


def _has_marks(example: MappedExample) -> bool:
    first, second = example.placed[:2]
    placed = "truth" in first.T_board_view and BEFORE in second.T_board_view
    return placed and len(first.marks_mm) > 0 and len(second.marks_mm) > 0


def _in_order(examples: Sequence[MappedExample]) -> list[MappedExample]:
    """The most frames first, then by views and way."""
    return sorted(examples, key=lambda e: (-e.frames, e.views, e.registration, e.merge, e.variant))
