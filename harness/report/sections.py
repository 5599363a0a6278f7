"""Sections that several pages of a sweep share, and the final tables for a terminal."""

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any, Literal, NamedTuple

import pandas as pd
from markupsafe import Markup

from harness.evaluation.maps import label_of
from harness.evaluation.set_ups import set_ups_of
from harness.evaluation.study.result import conditions_of
from harness.evaluation.summary import MAIN, found_rule
from harness.records.schema import Column, Table
from harness.records.trials import CLAIMS, MARKS, SET_UPS, SUMMARY, ResultTables
from harness.report.blocks import closing, fold, heading, joined, note, paragraph, template
from harness.report.claims import ClaimSet, Verdict
from harness.report.scene import scene_svg
from harness.report.summaries import Summaries, of_set_ups
from harness.vocabulary.path_names import in_words
from harness.vocabulary.text import Cell, Grid, Tone, inches, many, plus_minus

Row = Mapping[str, Any]

# ---------------------------------------------------------------- the frame of a page


class About(NamedTuple):
    """Title and origin of a report."""

    provenance: Mapping[str, Any]
    """The origin, as in `harness.report.blocks.closing`."""
    experiment_yaml_text: str
    """The resolved experiment as YAML."""
    title: str
    """The title of the page."""
    claim_set: ClaimSet | None = None
    """The claims about the experiment's target, if there are any."""
    facts: Mapping[str, Any] = MappingProxyType({})
    """The resolved experiment as plain data."""


def sweep_page(
    name: str,
    tables: ResultTables,
    about: About,
    answer: str,
    figures: Mapping[str, str],
    **parts: Any,
) -> str:
    """Return a sweep's page from the template ``name``, with the sections of all pages and its own
    ``parts``."""
    holes = None
    if len(tables.holes):
        holes = int(tables.holes.groupby("variant")["hole"].nunique().min())
    last_sections = closing(about.provenance, about.experiment_yaml_text, left_out(tables.runs))
    return template(name).render(
        title=about.title,
        answer=answer,
        warnings=about.provenance.get("warnings", ()),
        figures=figures,
        scene=scene_svg(about.facts),
        conditions=conditions_of(about.facts, holes),
        calls_note=CALLS_NOTE,
        closing=joined(last_sections),
        **parts,
    )


CALLS_NOTE = (
    "Detections that match no hole, with exact 95 % Poisson intervals. A calibrated threshold is"
    " the highest of the quiet thresholds of R hole-free runs; one more such run would exceed it"
    " with probability 1/(R + 1)."
)


def rule_note(repeats: int, *sentences: str) -> Markup:
    """Return the note below the answer: what counts as found, and what intervals do not cover."""
    draws = "The one repeat is one draw" if repeats == 1 else f"The repeats are {repeats} draws"
    scope = (
        f"{draws} of the noise for the same board in the same place with one unit of each camera:"
        " the intervals hold for these set-ups, not for other boards, places or units."
    )
    return note(" ".join((found_rule(repeats), *sentences, scope)))


def left_out(runs: pd.DataFrame) -> str:
    """State how many frames were left out of averages as disturbed, over all runs; empty if there
    were none."""
    disturbed = int(runs["left_out"].sum())
    frames = disturbed + int(runs["frames_used"].sum())
    if not disturbed:
        return ""
    return f"{disturbed} of {frames} frames were left out of an average as disturbed."


def shown_frames(compared: pd.DataFrame) -> tuple[int, ...]:
    """Return the least and the greatest number of frames."""
    if not len(compared):
        return ()
    frames = sorted(int(n) for n in compared["frames"].unique())
    return tuple(dict.fromkeys([frames[0], frames[-1]]))


def records(table: pd.DataFrame) -> list[dict[str, Any]]:
    """Return the rows of a table as mappings."""
    return [{str(key): value for key, value in row.items()} for row in table.to_dict("records")]


# ---------------------------------------------------------------- claims

RULES_NOTE = (
    "Each criterion is part of the program and is the same for every run. If the data allow both"
    " answers, the claim is undecided."
)


def claims_section(title: str, verdicts: Sequence[Verdict]) -> Markup:
    """Return a heading and the table of claims; empty without verdicts, as on pages of other
    targets."""
    if not verdicts:
        return Markup("")
    rows = [vars(verdict) for verdict in verdicts]
    table = CLAIMS.grid(rows, only=("claim", "says", "verdict", "evidence"))
    criteria = CLAIMS.grid(rows, only=("claim", "criterion"))
    return joined(
        [
            heading(title),
            paragraph(f"{counted_verdicts(verdicts)} {RULES_NOTE}"),
            table.html(),
            fold("Criteria, fixed in advance", criteria.html()),
        ]
    )


def counted_verdicts(verdicts: Sequence[Verdict]) -> str:
    """Return ``Of 7 claims, 5 are borne out (C1, ...), 2 are undecided (...).``"""
    counts = []
    for answer in MARKS:
        claims = [verdict.claim for verdict in verdicts if verdict.verdict == answer]
        verb = "is" if len(claims) == 1 else "are"
        if claims:
            counts.append(f"{len(claims)} {verb} {answer} ({', '.join(claims)})")
    return f"Of {many(len(verdicts), 'claim')}, {', '.join(counts)}."


# ---------------------------------------------------------------- variations


class Varied(NamedTuple):
    """A variation with one number of frames, beside the set-up that it changes."""

    variant: Row
    """Its row of the table of variants."""
    row: Row | None
    """Its row of `SET_UPS`; None if no trial finished."""
    original: Row | None
    """The row of the set-up that it changes; None if there is none."""

    @property
    def differs(self) -> bool:
        """True if other holes are found."""
        if self.row is None or self.original is None:
            return False
        return any(
            list(self.row[name]) != list(self.original[name]) for name in ("found", "undecided")
        )


def _why(varied: Varied) -> str:
    """Return the reason for a variation, and its settings if its name does not state them."""
    variant = varied.variant
    settings = variant["settings"].strip("{}").replace('"', "").replace(": ", "=")
    lines = [variant["reason"]]
    if settings != variant["variant"]:
        lines.append(variant["settings"])
    return "\n".join(line for line in lines if line)


def _frames(varied: Varied) -> Any:
    return "no trial of it finished" if varied.row is None else varied.row["frames"]


def _mark(varied: Varied) -> Cell:
    return Cell("≠", "changed") if varied.differs else Cell("")


def _side(label: str, side: Literal["row", "original"]) -> Column:
    """Return the column ``label`` of `SET_UPS` for one side of a variation."""
    declared = next(column for column in SET_UPS.columns if column.label == label)

    def cell(varied: Varied) -> Cell:
        row = getattr(varied, side)
        return Cell("–") if row is None else Cell(declared.cell(row).text)

    return Column("", label if side == "row" else f"{label}, without", cell)


VARIED = Table(
    "variations",
    "one row per variation and number of frames, beside the set-up that it changes",
    (
        Column("", "variation", lambda varied: in_words(varied.variant["variant"])),
        Column("", "why", _why),
        Column("", "changes", lambda varied: in_words(varied.variant["reference"] or "–")),
        Column("", "frames", _frames),
        Column("", "≠", _mark),
        _side("found", "row"),
        _side("found", "original"),
        _side("threshold (mm)", "row"),
        _side("threshold (mm)", "original"),
        _side("surface noise (mm)", "row"),
        _side("surface noise (mm)", "original"),
    ),
    formats=(),
    left=4,
    kind="limits varied",
)


def varied_section(
    tables: ResultTables, compared: pd.DataFrame, frames: Sequence[int] = (), original: str = ""
) -> Markup:
    """Return the sensitivity study: each variation beside the set-up that it changes (or else
    ``original``) with as many frames (or else the most). ``compared`` comes from
    `compare_set_ups`; empty ``frames`` show all."""
    rows_of: dict[str, list[Row]] = {}
    for row in records(compared):
        if not frames or row["frames"] in frames:
            rows_of.setdefault(str(row["variant"]), []).append(row)
    is_variation = tables.variants["is_variation"].astype(bool)
    varied: list[Varied] = []
    for variant in records(tables.variants[is_variation]):
        variant["reference"] = variant["reference"] or original
        originals = rows_of.get(variant["reference"], [])
        rows = rows_of.get(str(variant["variant"]), [])
        varied += _beside(variant, rows, originals)
    if not varied:
        return Markup("")
    text = (
        "Each row changes a setting of the set-up that it names and is compared with it; ≠ marks"
        " other holes found. A variation with fewer repeats and hole-free runs has a lower"
        " threshold."
    )
    grid = VARIED.grid(varied, heads={"changes": ""} if original else None)
    return joined([heading("If the facts were different"), paragraph(text), grid.html()])


def _beside(variant: Row, rows: Sequence[Row], originals: Sequence[Row]) -> list[Varied]:
    """Return the rows of one variation, each beside the original with as many frames, or else the
    most. The reason appears once."""
    if not rows:
        return [Varied(variant, None, originals[-1] if originals else None)]
    varied = []
    for row in rows:
        as_many = [original for original in originals if original["frames"] == row["frames"]]
        candidates = [*as_many, *originals[-1:]]
        varied.append(Varied(variant, row, candidates[0] if candidates else None))
        variant = {**variant, "reason": "", "settings": ""}
    return varied


# ---------------------------------------------------------------- tables of holes found

TONES: dict[Any, Tone] = {"found": "key", "missed": "bad", "undecided": "open"}
SHOWN = ("set-up", "frames", "found", "from (mm)", "50 % size (mm)")


def final_tables(tables: ResultTables, computed: Summaries) -> list[str | Grid]:
    """Return what a terminal shows at the end, which depends on the kind of experiment."""
    if not tables.registrations.empty:
        return [ways_grid(computed[SET_UPS])]
    if len(set_ups_of(tables)) > 1:
        return [set_ups_grid(of_set_ups(computed[SET_UPS], tables), terminal=True)]
    return [holes_grid(computed[SUMMARY], terminal=True)]


def holes_grid(summary: pd.DataFrame, *, terminal: bool = False) -> Grid:
    """Return the main set-up's share of detections by hole and frames, with intervals (page) or
    sizes (terminal)."""
    summary = summary[summary["variant"] == MAIN]
    frames = sorted(int(n) for n in summary["frames"].unique())
    diameters_mm = summary["true_diameter_mm"].astype(float)
    has_drills = any(inches(diameter_mm) for diameter_mm in diameters_mm)
    rows = []
    for hole, part in summary.groupby("hole", sort=False):
        by_frames = {row["frames"]: row for row in records(part)}
        last = by_frames[max(by_frames)]
        diameter_mm = float(last["true_diameter_mm"])
        cells: list[str | Cell] = [str(hole)]
        if has_drills:
            cells.append(inches(diameter_mm).replace(" in", '"') or "–")
        cells.append(f"{diameter_mm:.2f}")
        for n in frames:
            cells.append(_detected(by_frames[n], terminal) if n in by_frames else "–")
        if terminal:
            cells += [_diameter(last, "extent"), _diameter(last, "model")]
        rows.append(cells)
    heads = ["hole", "drill", "mm"] if has_drills else ["hole", "mm"]
    heads += [f"N={n}" if terminal else many(n, "frame") for n in frames]
    if terminal:
        heads += ["extent mm", "model mm"]
    return Grid.of(heads, rows, 1, "holes detected of trials, by number of averaged frames (N)")


def _detected(row: Row, terminal: bool) -> Cell:
    count = f"{row['detected']}/{row['n']}"
    if terminal:
        return Cell(count, TONES[row["status"]])
    interval = f"{row['rate_low']:.2f}–{row['rate_high']:.2f}"
    return Cell(f"{count}\n{interval}, {row['status']}", share=row["rate"])


def _diameter(row: Row, measure: str) -> str:
    return plus_minus(row[f"{measure}_diameter_mean_mm"], row[f"{measure}_diameter_std_mm"])


def set_ups_grid(compared: pd.DataFrame, *, terminal: bool = False) -> Grid:
    """Return the table of what each set-up finds with the fewest and the most frames."""
    frames = shown_frames(compared)
    rows = [row for row in records(compared) if row["frames"] in frames]
    return SET_UPS.grid(rows, terminal=terminal, only=SHOWN)


def ways_grid(compared: pd.DataFrame) -> Grid:
    """Return the holes found for each method of registering and merging (down) and each number of
    views (across)."""
    rows = [row for row in records(compared) if not row["is_variation"]]
    frames = shown_frames(compared)
    counts = sorted({row["views"] for row in rows})
    has_conditions = len({row["conditions"] for row in rows}) > 1
    rows_of_way: dict[str, dict[tuple[int, int], Row]] = {}
    for row in rows:
        conditions = row["conditions"] if has_conditions else ""
        method = label_of(row["registration"], row["merge"], conditions)
        rows_of_way.setdefault(method, {})[row["views"], row["frames"]] = row
    cells = []
    for method, by_count in rows_of_way.items():
        line = [method]
        for views in counts:
            line.append(" / ".join(_holes_found(by_count.get((views, n))) for n in frames))
        cells.append(line)
    heads = ["registration, merge", *(many(views, "view") for views in counts)]
    of_holes = f" of {max(row['holes'] for row in rows)}" if rows else ""
    numbers = " / ".join(f"N={n}" for n in frames)
    title = f"holes found{of_holes} with {numbers} frames per view (+: undecided)"
    return Grid.of(heads, cells, title=title)


def _holes_found(row: Row | None) -> str:
    """Return ``8``, or ``8+1`` with an undecided hole."""
    if row is None:
        return "–"
    undecided = f"+{len(row['undecided'])}" if row["undecided"] else ""
    return f"{len(row['found'])}{undecided}"
