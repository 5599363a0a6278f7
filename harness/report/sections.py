"""Sections that several pages of a sweep share, and the final tables for a terminal."""

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any, NamedTuple

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


class About(NamedTuple):
    """Title and origin of a report. ``provenance`` is as in `harness.report.blocks.closing`;
    ``facts`` is the resolved experiment as plain data. ``claim_set`` are the claims about its
    target."""

    provenance: Mapping[str, Any]
    experiment_yaml_text: str
    title: str
    claim_set: ClaimSet | None = None
    facts: Mapping[str, Any] = MappingProxyType({})


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
    warnings = about.provenance.get("warnings", ())
    base = {"title": about.title, "answer": answer, "warnings": warnings, "figures": figures}
    seen = (
        int(tables.holes.groupby("variant")["hole"].nunique().min()) if len(tables.holes) else None
    )
    base |= {
        "scene": scene_svg(about.facts),
        "conditions": conditions_of(about.facts, seen),
        "calls_note": CALLS_NOTE,
    }
    end = closing(about.provenance, about.experiment_yaml_text, left_out(tables.runs))
    return template(name).render(**base, closing=joined(end), **parts)


RULES_NOTE = (
    "Each criterion is part of the program and is the same for every run. If the data allow both answers, the claim is "
    "undecided."
)
CALLS_NOTE = (
    "Detections that match no hole, with exact 95 % Poisson intervals. A calibrated threshold is the highest of the "
    "quiet thresholds of R hole-free runs; one more such run would exceed it with probability 1/(R + 1)."
)


class Varied(NamedTuple):
    """A variation with one number of frames: its row of `SET_UPS`, and the row of the set-up that
    it changes."""

    variant: Row
    row: Row | None
    other: Row | None

    @property
    def differs(self) -> bool:
        """True if other holes are found."""
        pair = self.row, self.other
        return len({(*row["found"], "", *row["undecided"]) for row in pair if row is not None}) > 1


def _why(varied: Varied) -> str:
    """Return the reason for a variation, and its settings if its name does not state them."""
    variant = varied.variant
    settings = variant["settings"].strip("{}").replace('"', "").replace(": ", "=")
    return "\n".join(
        filter(
            None, (variant["reason"], "" if settings == variant["variant"] else variant["settings"])
        )
    )


def _side(label: str, side: str) -> Column:
    """Return the column ``label`` of `SET_UPS` for one side of a variation."""
    (column,) = (column for column in SET_UPS.columns if column.label == label)

    def cell(varied: Varied) -> Cell:
        row = getattr(varied, side)
        return Cell("–") if row is None else Cell(column.cell(row).text)

    return Column("", f"{label}{', without' if side == 'other' else ''}", cell)


COMPARED = ("found", "threshold (mm)", "surface noise (mm)")
VARIED = Table(
    "variations",
    "one row per variation and number of frames, beside the set-up that it changes",
    (
        Column("", "variation", lambda row: in_words(row.variant["variant"])),
        Column("", "why", _why),
        Column("", "changes", lambda row: in_words(row.variant["reference"] or "–")),
        Column(
            "",
            "frames",
            lambda row: "no trial of it finished" if row.row is None else row.row["frames"],
        ),
        Column(
            "", "≠", lambda row: Cell("≠" if row.differs else "", "changed" if row.differs else "")
        ),
        *(_side(label, side) for label in COMPARED for side in ("row", "other")),
    ),
    formats=(),
    left=4,
    kind="limits varied",
)


def varied_section(
    tables: ResultTables, compared: pd.DataFrame, frames: Sequence[int] = (), of: str = ""
) -> Markup:
    """Return the sensitivity study: each variation beside the set-up that it changes (or else
    ``of``) with as many frames (or else the most). ``compared`` comes from `compare_set_ups`;
    empty ``frames`` show all."""
    by_variant: dict[str, list[Row]] = {}
    for row in records(compared):
        if not frames or row["frames"] in frames:
            by_variant.setdefault(str(row["variant"]), []).append(row)
    rows = []
    for variant in records(tables.variants[tables.variants["is_variation"].astype(bool)]):
        variant["reference"] = variant["reference"] or of
        originals = by_variant.get(variant["reference"], [])
        for number, own in enumerate(by_variant.get(str(variant["variant"]), [None])):
            alike = [
                original
                for original in originals
                if own is not None and original["frames"] == own["frames"]
            ]
            again = {"reason": "", "settings": ""} if number else {}  # the reason appears once
            rows.append(
                Varied({**variant, **again}, own, next(iter([*alike, *originals[-1:]]), None))
            )
    if not rows:
        return Markup("")
    text = (
        "Each row changes a setting of the set-up that it names and is compared with it; ≠ marks other holes found."
        " A variation with fewer repeats and hole-free runs has a lower threshold."
    )
    grid = VARIED.grid(rows, heads={"changes": ""} if of else None)
    return joined([heading("If the facts were different"), paragraph(text), grid.html()])


def claims_section(title: str, verdicts: Sequence[Verdict]) -> Markup:
    """Return a heading and the table of claims; empty without verdicts, as on pages of other
    targets."""
    if not verdicts:
        return Markup("")
    rows = [vars(verdict) for verdict in verdicts]
    keys = ("claim", "says", "verdict", "evidence")
    criteria = fold(
        "Criteria, fixed in advance", CLAIMS.grid(rows, only=("claim", "criterion")).html()
    )
    return joined(
        [heading(title), paragraph(RULES_NOTE), CLAIMS.grid(rows, only=keys).html(), criteria]
    )


def counted_verdicts(verdicts: Sequence[Verdict]) -> str:
    """Return ``Of 7 claims, 5 are borne out (C1, ...), 2 are undecided (...).``; empty without
    verdicts."""
    parts = []
    for answer in MARKS:
        if names := [verdict.claim for verdict in verdicts if verdict.verdict == answer]:
            parts.append(
                f"{len(names)} {'is' if len(names) == 1 else 'are'} {answer} ({', '.join(names)})"
            )
    return f" Of {many(len(verdicts), 'claim')}, {', '.join(parts)}." if parts else ""


def rule_note(repeats: int, *more: str) -> Markup:
    """Return the note below the answer: what counts as found, and what the intervals do not cover."""
    draws = "The one repeat is one draw" if repeats == 1 else f"The repeats are {repeats} draws"
    text = (
        f"{draws} of the noise for the same board in the same place with one unit of each camera: the intervals "
        "hold for these set-ups, not for other boards, places or units."
    )
    return note(" ".join((found_rule(repeats), *more, text)))


def left_out(runs: pd.DataFrame) -> str:
    """State how many frames were left out of averages as disturbed, over all runs; empty if there
    were none."""
    out = int(runs["left_out"].sum())
    used = int(runs["frames_used"].sum())
    return f"{out} of {out + used} frames were left out of an average as disturbed." if out else ""


def shown_frames(compared: pd.DataFrame) -> tuple[int, ...]:
    """Return the least and the greatest number of frames."""
    frames = sorted(int(n) for n in compared["frames"].unique()) if len(compared) else []
    return tuple(dict.fromkeys([*frames[:1], *frames[-1:]]))


def records(table: pd.DataFrame) -> list[dict[str, Any]]:
    """Return the rows of a table as mappings."""
    return [{str(key): value for key, value in row.items()} for row in table.to_dict("records")]


TONES: dict[Any, Tone] = {"found": "key", "missed": "bad", "undecided": "open"}
SHOWN = ("set-up", "frames", "found", "from (mm)", "50 % size (mm)")


def final_tables(tables: ResultTables, found: Summaries) -> list[str | Grid]:
    """Return what a terminal shows at the end, which depends on the kind of experiment."""
    if not tables.registrations.empty:
        return [ways_grid(found[SET_UPS])]
    if len(set_ups_of(tables)) > 1:
        return [set_ups_grid(of_set_ups(found[SET_UPS], tables), terminal=True)]
    return [holes_grid(found[SUMMARY], terminal=True)]


def holes_grid(summary: pd.DataFrame, *, terminal: bool = False) -> Grid:
    """Return the main set-up's share of detections by hole and frames, with intervals (page) or
    sizes (terminal)."""
    summary = summary[summary["variant"] == MAIN]
    frames = sorted(int(n) for n in summary["frames"].unique())

    def detected(row: Row) -> Cell:
        if terminal:
            return Cell(f"{row['detected']}/{row['n']}", TONES[row["status"]])
        ends = f"{row['rate_low']:.2f}–{row['rate_high']:.2f}, {row['status']}"
        return Cell(f"{row['detected']}/{row['n']}\n{ends}", share=row["rate"])

    rows = []
    for hole, part in summary.groupby("hole", sort=False):
        by_frames = {row["frames"]: row for row in records(part)}
        last = by_frames[max(by_frames)]
        true = float(last["true_diameter_mm"])
        cells: list[str | Cell] = [
            str(hole),
            inches(true).replace(" in", '"') or "–",
            f"{true:.2f}",
        ]
        cells += [detected(by_frames[n]) if n in by_frames else "–" for n in frames]
        for kind in ("extent", "model") if terminal else ():
            cells.append(
                plus_minus(*(last[f"{kind}_diameter_{what}_mm"] for what in ("mean", "std")))
            )
        rows.append(cells)
    counted = [f"N={n}" if terminal else many(n, "frame") for n in frames]
    heads = ["hole", "drill", "mm", *counted, *(("extent mm", "model mm") if terminal else ())]
    if all(cells[1] == "–" for cells in rows):
        heads = [heads[0], *heads[2:]]
        rows = [[cells[0], *cells[2:]] for cells in rows]
    return Grid.of(heads, rows, 1, "holes detected of trials, by number of averaged frames (N)")


def set_ups_grid(compared: pd.DataFrame, *, terminal: bool = False) -> Grid:
    """Return the table of what each set-up finds with the least and the greatest number of frames."""
    rows = [row for row in records(compared) if row["frames"] in shown_frames(compared)]
    return SET_UPS.grid(rows, terminal=terminal, only=SHOWN)


def ways_grid(compared: pd.DataFrame) -> Grid:
    """Return the holes found for each method of registering and merging (down) and each number of
    views (across)."""
    rows = [row for row in records(compared) if not row["is_variation"]]
    frames = shown_frames(compared)
    views = sorted({row["views"] for row in rows})
    several = len({row["conditions"] for row in rows}) > 1
    by_way: dict[str, dict[tuple[int, int], Row]] = {}
    for row in rows:
        way = label_of(row["registration"], row["merge"], row["conditions"] if several else "")
        by_way.setdefault(way, {})[row["views"], row["frames"]] = row

    def count(row: Row | None) -> str:
        undecided = f"+{len(row['undecided'])}" if row and row["undecided"] else ""
        return "–" if row is None else f"{len(row['found'])}{undecided}"

    heads = ("registration, merge", *(many(n, "view") for n in views))
    cells = []
    for way, found in by_way.items():
        cells.append(
            [way, *(" / ".join(count(found.get((n, at))) for at in frames) for n in views)]
        )
    of_holes = f" of {max(row['holes'] for row in rows)}" if rows else ""
    numbers = " / ".join(f"N={n}" for n in frames)
    return Grid.of(
        heads, cells, title=f"holes found{of_holes} with {numbers} frames per view (+: undecided)"
    )
