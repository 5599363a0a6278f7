"""Facts that nobody has measured, in a study: the table of their effects, and sentences."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from harness.evaluation.study.limit import SetUpLimit
from harness.evaluation.study.record import DrawnUnknown
from harness.evaluation.study.result import SetUpResult, StudyResult
from harness.evaluation.study.unknowns import UnknownEffect
from harness.records.schema import Column, Estimate, Table
from harness.tables.limits import SET_UP
from harness.vocabulary import text
from harness.vocabulary.path_names import (
    UNKNOWNS,
    names_of,
    on_one_line,
    unit_of,
    value_text,
)


@dataclass(frozen=True, eq=False)
class UnknownRow:
    """One value of one unknown in one set-up."""

    limit: SetUpLimit
    """The set-up."""
    rank: int
    """Rank of the unknown among those of the set-up, from 1; the largest factor first."""
    name: str
    """The unknown in words."""
    effect: UnknownEffect
    """What it does."""
    level: int
    """Number of the value."""

    @property
    def value(self) -> str:
        """The value in words."""
        return level_text(self.effect, self.level)

    @property
    def a90(self) -> Estimate:
        """a90 at the value, with its interval."""
        ends = self.effect.intervals_mm[self.level]
        size_mm = float(self.effect.a90_mm[self.level])
        return Estimate(size_mm, ends.low, ends.high, self.limit.largest_mm)


def level_text(effect: UnknownEffect, level: int) -> str:
    """Return a value of an unknown, or an end of its range, in words."""
    return _value_text(effect.unknown.key, effect.levels[level])


def _value_text(key: str, value: Any) -> str:
    """Return a value at a key in words, also one that is null."""
    return "none" if value is None else value_text(key, value)


def stated_text(unknown: DrawnUnknown) -> str:
    """Return the stated value in words; of a mapping, the keys that its values name."""
    stated = unknown.stated
    if isinstance(stated, dict):
        keys: dict[str, None] = {}
        for value in unknown.values or ():
            if isinstance(value, dict):
                keys |= dict.fromkeys(value)
        stated = {key: stated[key] for key in keys if key in stated}
    return _value_text(unknown.key, stated)


def unknown_names(effects: Sequence[UnknownEffect]) -> dict[str, str]:
    """Return the name of each unknown by its key."""
    return names_of(sorted(effect.unknown.key for effect in effects))


def unknown_rows(results: Sequence[SetUpResult]) -> list[UnknownRow]:
    """Return a row for each value of each unknown of all set-ups."""
    rows = []
    for result in results:
        effects = result.unknowns.effects if result.unknowns else ()
        names = unknown_names(effects)
        for rank, effect in enumerate(effects, start=1):
            name = names[effect.unknown.key]
            for level in range(len(effect.levels)):
                row = UnknownRow(
                    limit=result.limit, rank=rank, name=name, effect=effect, level=level
                )
                rows.append(row)
    return rows


UNKNOWN_TABLE = Table(
    "unknowns",
    "one row per set-up, unknown and value (both ends of a range): a90 at that value, "
    "averaged over the other unknowns",
    (
        Column("set_up", "set-up", "limit.record.label", SET_UP.note, text.unbroken),
        Column("rank", "", "rank", "rank of the unknown by its factor, from 1"),
        Column("key", "", "effect.unknown.key", "dotted key of the unknown"),
        Column("", "unknown", "name"),
        Column(
            "value",
            "",
            lambda row: on_one_line(row.effect.levels[row.level]),
            "value of the unknown",
        ),
        Column("", "value", "value"),
        Column(
            "a90_mm",
            "a90 (mm)",
            lambda row: row.a90,
            "size found 90 % of the time at this value, with its 95 % interval over boards",
            interval=True,
        ),
        Column(
            "factor",
            "largest over smallest",
            ("effect.factor", "effect.factor_interval"),
            "largest a90 of the unknown over its smallest, with the 95 % interval over boards",
        ),
        Column(
            "beyond_chance",
            "beyond chance",
            "effect.beyond_chance",
            "whether an interval of that factor that allows for all pairs of values excludes 1",
            lambda beyond: "yes" if beyond else "no",
        ),
        Column(
            "stated",
            "",
            lambda row: stated_text(row.effect.unknown),
            "value that the experiment states, in words",
        ),
        Column(
            "<axis>",
            "",
            "limit.record.axes",
            "one column per axis, named by its dotted path: the value",
            spread=True,
        ),
        Column("frames", "", "limit.record.frames", "number of averaged frames"),
        Column("detector", "", "limit.record.detector", "name of the detector"),
        Column("reason", "", "effect.unknown.reason", "reason for the values, by the experiment"),
    ),
    left=3,
)


def stated_of(result: StudyResult, drawn: SetUpLimit) -> SetUpLimit | None:
    """Return the limit of the same set-up at the stated values; None if there is none."""
    axes = _axes_but_unknowns(drawn)
    for limit in result.limits:
        has_same_axes = _axes_but_unknowns(limit) == axes
        has_same_frames = limit.record.frames == drawn.record.frames
        if has_same_axes and has_same_frames and not limit.record.drawn:
            return limit
    return None


def _axes_but_unknowns(limit: SetUpLimit) -> dict[str, Any]:
    """Return a set-up's values of all axes but that of unknowns."""
    return {name: value for name, value in limit.record.axes.items() if name != UNKNOWNS}


def unknown_sentences(result: StudyResult) -> list[str]:
    """Return a sentence for each set-up that draws unknowns: the range of its a90, on what it
    depends, and a90 at the stated values and over all boards."""
    return [_sentence(result, set_up) for set_up in result.set_ups if set_up.unknowns]


def unknown_headline(result: StudyResult) -> str:
    """Return the range of the set-up with the smallest a90 over the unknowns; empty for a study
    without unknowns."""
    drawn = [set_up for set_up in result.set_ups if set_up.unknowns]
    if not drawn:
        return ""

    def a90_or_infinity(set_up: SetUpResult) -> float:
        return float(np.nan_to_num(set_up.limit.a90_mm, nan=np.inf))

    return f"{_range_words(min(drawn, key=a90_or_infinity))}."


def _sentence(result: StudyResult, set_up: SetUpResult) -> str:
    """Return the sentence of a set-up that draws unknowns: its range, and a90 at the stated values
    and over all boards."""
    limit = set_up.limit
    stated = stated_of(result, limit)
    parts = [f"{_size(limit, limit.a90_mm)} over the unknowns (drawn for each board)"]
    if stated is not None:
        parts.insert(0, f"{_size(limit, stated.a90_mm)} at the stated values")
    return f"{_range_words(set_up)}; {' and '.join(parts)}."


def _range_words(set_up: SetUpResult) -> str:
    """Return ``50 frames: a90 is 3.4 to 5.2 mm, depending on backing (most) and blur``, or why
    there is no range."""
    limit = set_up.limit
    unknowns = set_up.unknowns
    assert unknowns is not None
    label = limit.record.label.replace(f"{UNKNOWNS} drawn, ", "")
    over_unknowns = f"{label}: a90 is {_size(limit, limit.a90_mm)}"
    if unknowns.why:
        return f"{over_unknowns}; {unknowns.why}"
    names = unknown_names(unknowns.effects)
    deciding = [names[effect.unknown.key] for effect in unknowns.deciding]
    if not deciding:
        largest = unknowns.effects[0]
        factor = f"{names[largest.unknown.key]}, a factor of {largest.factor:.2f}"
        return f"{over_unknowns}; no unknown moves it beyond chance (at most {factor})"
    if len(deciding) > 1:
        deciding[0] += " (most)"
    lowest = text.size(unknowns.lowest_mm, limit.largest_mm)
    ends = f"{lowest} to {_size(limit, unknowns.highest_mm)}"
    return f"{label}: a90 is {ends}, depending on {text.joined_words(deciding)}"


def _size(limit: SetUpLimit, size_mm: float) -> str:
    """Return a size with its unit, or that it is unknown."""
    if np.isnan(size_mm):
        return "unknown"
    return f"{text.size(size_mm, limit.largest_mm)} mm"


def undetermined(facts: Any) -> tuple[str, ...]:
    """Return a sentence on each unknown that an experiment declares, from its plain data."""
    unknowns = facts.get(UNKNOWNS) or ()
    names = names_of([unknown["key"] for unknown in unknowns])
    sentences = []
    for unknown in unknowns:
        key = unknown["key"]
        if unknown["range"] is not None:
            low, high = unknown["range"]
            values = f"{low:g} to {high:g} {unit_of(key)}".rstrip()
        else:
            values = "; ".join(_value_text(key, value) for value in unknown["values"])
        sentences.append(f"{names[key]}: {values}. {unknown['reason']}")
    return tuple(sentences)
