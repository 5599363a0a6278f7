"""Tables of efficiency: detectors compared with the ideal observer, and the ideal observer's
result on each damage."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

from harness.evaluation.intervals import UNKNOWN
from harness.programs.efficiency.statistics import Efficiency, Level
from harness.records.schema import Column, Estimate, Table
from harness.tables.limits import CALLS, SET_UP, a50_of, a90_of
from harness.vocabulary.text import unbroken

INDEX = "d' of the ideal observer for the damage"
INDEX_50 = f"{INDEX} that the detector finds {50} % of the time"
INDEX_90 = f"{INDEX} that the detector finds {90} % of the time"
IDEAL_A90 = "diameter that the ideal observer finds 90 % of the time"


def _ideal_size(level: Level) -> Estimate:
    """Return the ideal observer's size; it has no interval if the observer misses nothing."""
    ends = UNKNOWN if level.at_most else level.ideal_mm_interval
    return Estimate(level.ideal_mm, ends.low, ends.high, at_most=level.at_most)


EFFICIENCY = Table(
    "efficiency",
    (
        "one row per set-up and number of frames of a study: its detector compared with the "
        "ideal observer"
    ),
    (
        Column("set_up", "set-up", "limit.record.label", SET_UP.note, unbroken),
        Column("variant", "", "limit.record.variant", "name of the set-up"),
        Column("frames", "", "limit.record.frames", "number of averaged frames"),
        Column("detector", "detector", "limit.record.detector", "name of the detector"),
        Column("detector_version", "", "limit.record.detector_version", "version of the detector"),
        Column(
            "ideal_a50_mm",
            "ideal a50 (mm)",
            lambda row: _ideal_size(row.half),
            (
                "diameter that the ideal observer finds 50 % of the time, with its 95 % "
                "interval over boards"
            ),
            interval=True,
        ),
        Column(
            "ideal_is_at_most",
            "",
            "half.at_most",
            "whether it misses nothing: its sizes are then upper bounds",
        ),
        Column(
            "a50_mm", "a50 (mm)", lambda row: a50_of(row.limit), "the detector's a50", interval=True
        ),
        Column(
            "ideal_a90_mm",
            "ideal a90 (mm)",
            lambda row: _ideal_size(row.most),
            IDEAL_A90,
            interval=True,
        ),
        Column(
            "a90_mm", "a90 (mm)", lambda row: a90_of(row.limit), "the detector's a90", interval=True
        ),
        Column("ideal_index_50", "", "half.ideal_index", f"{INDEX} that it finds 50 % of the time"),
        Column("index_50", "d' at 50 %", ("half.index", "half.index_interval"), INDEX_50),
        Column(
            "efficiency_50_share",
            "efficiency at 50 %",
            ("half.efficiency", "half.interval"),
            "(ideal_index_50 / index_50) squared, interval over boards",
        ),
        Column("ideal_index_90", "", "most.ideal_index", f"{INDEX} that it finds 90 % of the time"),
        Column("index_90", "d' at 90 %", ("most.index", "most.index_interval"), INDEX_90),
        Column(
            "efficiency_90_share",
            "efficiency at 90 %",
            ("most.efficiency", "most.interval"),
            "(ideal_index_90 / index_90) squared, interval over boards",
        ),
        replace(
            CALLS[0], value=("limit.false_calls.rate_per_m2", "limit.false_calls.interval_per_m2")
        ),
        Column("units", "", "ideal.units", "number of units whose noise the ideal observer knows"),
        Column("kurtosis", "", "ideal.kurtosis", "excess kurtosis of that noise; 0 if Gaussian"),
        Column("notes", "", "why", "reason why there is no efficiency, if there is none"),
    ),
    title="efficiency: detectors compared with the ideal observer",
    left=2,
)


@dataclass(frozen=True)
class EfficiencyRow:
    """One damage of a set-up: the entry with the index ``number`` of every array of ``of``."""

    of: Efficiency
    number: int

    def __getattr__(self, name: str) -> object:
        """Return the damage's entry in the array ``name`` of ``of``."""
        return getattr(self.of, name)[self.number].item()


DAMAGES = Table(
    "ideal",
    (
        "one row per damage, set-up and number of frames: the ideal observer's probability, and "
        "the detector's hits"
    ),
    (
        Column("set_up", "", "of.limit.record.label", SET_UP.note),
        Column("board", "", "board", "number of the damaged board"),
        Column("hole", "", "hole", "number of the damage on the board"),
        Column("diameter_mm", "", "size_mm", "true diameter"),
        Column("index", "", "index", INDEX),
        Column(
            "threshold",
            "",
            "threshold",
            "its threshold in standard deviations of its statistic; empty if d' is 0",
        ),
        Column("pod", "", "pod", "the ideal observer's probability of detection"),
        Column(
            "hits", "", "hits", "number of the detector's hits by depth (not by missing returns)"
        ),
        Column(
            "inspections",
            "",
            "inspections",
            "number of inspections of the damage, with different noise",
        ),
    ),
)
EFFICIENCY_TABLES = (EFFICIENCY, DAMAGES)


def damage_rows(rows: Sequence[Efficiency]) -> Iterator[EfficiencyRow]:
    """Yield every damage of all set-ups."""
    for row in rows:
        yield from (EfficiencyRow(row, number) for number in range(len(row.index)))
