"""Every file that any program writes into a results folder, with the files of its tables."""

from collections.abc import Iterator
from fnmatch import fnmatchcase

from harness.programs.atlas.tables import ATLAS
from harness.programs.coverage.tables import COVERAGE_TABLES
from harness.programs.efficiency.tables import EFFICIENCY_TABLES
from harness.programs.filters.tables import FILTER_COSTS
from harness.records.outputs import FILES, FolderKind, Output
from harness.records.trials import STORED, STUDY_ONLY, SUMMARISED
from harness.tables.study import STUDY_TABLES


def outputs() -> Iterator[Output]:
    """Yield every file, including those of tables."""
    yield from FILES
    for tables, group in (
        (STORED, ""),
        (SUMMARISED, "other"),
        (STUDY_TABLES, "study"),
        (EFFICIENCY_TABLES, "efficiency"),
        ((FILTER_COSTS,), "filters"),
        ((ATLAS,), "atlas"),
        (COVERAGE_TABLES, "coverage"),
    ):
        for table in tables:
            for name in table.files:
                yield Output(name, table.note, of="study" if table in STUDY_ONLY else group)


def is_output(name: str, folder_kind: FolderKind) -> bool:
    """Return whether a program writes a file with this name to this place."""
    return any(
        output.place == folder_kind and fnmatchcase(name, output.name) for output in outputs()
    )
