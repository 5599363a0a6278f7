"""The text of `results/README.md`; ``python -m harness.programs.keeping.readme >
results/README.md`` writes it."""

from collections.abc import Iterable, Iterator

from harness.programs.coverage.tables import COVERAGE_TABLES
from harness.programs.efficiency.tables import EFFICIENCY_TABLES
from harness.programs.filters.tables import FILTER_COSTS
from harness.records.outputs import FILES, JOURNAL, LATEST
from harness.records.schema import Table
from harness.records.trials import (
    FINDINGS_OF_CAPTURE,
    POINTS_OF_CAPTURES,
    STORED,
    STUDY_ONLY,
    SUMMARISED,
)
from harness.tables.limits import SCORES
from harness.tables.study import STUDY_TABLES

HEAD = f"""# Results

`python -m harness.programs.keeping.readme` writes this file from the declarations of tables;
a test keeps it current.

Sweeps write to `results/<experiment>/<digest>/`; the digest covers all settings that can change a
result. `results/<experiment>/{LATEST}` is a link to the newest run that has a report (a text file
with its name where the system has no links). `tofpod ls results` lists all runs, the settings in
which they differ, and their detection limits; `tofpod clean results` removes them. `{JOURNAL}/`
holds finished trials, so that the same command resumes an interrupted sweep. `tofpod check`
compares with `baselines/`. Noise-free renders are kept in `results/.cache/renders/`. Everything
but the baselines can be deleted at any time."""
TABLES = """
# Tables

Parquet files hold all digits. Their schema holds each column's unit and description, and the
origin (key `tofpod`: commit, versions, seed, and the digests of the code, cameras and settings that
the numbers hang on). CSV files hold six digits. The ending of a column's
name is its unit. An empty cell means that the value is unknown or not demonstrated. `x_low` and
`x_high` are the ends of the 95 % interval of `x`. Tables without rows are not written. An
experiment with axes has another column for each axis, named by its dotted path."""
GROUPS = {
    "": "Every sweep",
    "study": "Additional files of a study of detection limits",
    "views": "Additional files of an experiment with several views",
    "capture": "Files of an experiment on real captures "
    "(in `point-000/`, ..., except `summary.csv`)",
    "check": "Also written by `tofpod check`",
    "efficiency": "Also written by `tofpod efficiency`",
    "filters": "Also written by `tofpod filters`",
    "coverage": "Written by `tofpod coverage`",
}


def results_readme() -> Iterator[str]:
    """Yield the lines of the text."""
    yield HEAD
    for group, title in GROUPS.items():
        yield from ("", f"## {title}", "", "| file | content |", "|---|---|")
        yield from (
            f"| `{output.name}` | {output.note} |" for output in FILES if output.of == group
        )
    yield TABLES
    yield from _tables("Trials", [table for table in STORED if table not in STUDY_ONLY])
    yield from _tables("Summaries of an experiment that is not a study", SUMMARISED)
    yield from _tables("Detection limits of a study", STUDY_TABLES)
    yield from _tables("Efficiency of a study's detectors", EFFICIENCY_TABLES)
    yield from _tables("What filters cost (`tofpod filters`)", (FILTER_COSTS,))
    yield from _tables("Coverage of a part (`tofpod coverage`)", COVERAGE_TABLES)
    yield from _tables("Trials of a study", STUDY_ONLY)
    yield from _tables("Anomaly maps on a data set (`tofpod score`)", (SCORES,))
    yield from _tables("Real captures", (POINTS_OF_CAPTURES, FINDINGS_OF_CAPTURE))
    yield ""


def _tables(title: str, tables: Iterable[Table]) -> Iterator[str]:
    yield f"\n## {title}"
    for table in tables:
        yield f"\n### {', '.join(f'`{name}`' for name in table.files)}\n"
        yield f"{table.note[0].upper()}{table.note[1:]}.\n"
        yield "| column | content |"
        yield "|---|---|"
        for column in table.stored:
            names = f"`{column.name}`" + (", `_low`, `_high`" if len(column.names) > 1 else "")
            yield f"| {names} | {column.note} |"


if __name__ == "__main__":
    print("\n".join(results_readme()), end="")
