"""Whether all that a sweep left is declared in `harness.tables`."""

from __future__ import annotations

import re
from pathlib import Path

import pyarrow.parquet as pq

from harness.programs.keeping.written_files import is_output
from harness.records.outputs import JOURNAL, LOCK_NAME
from harness.records.trials import STORED, SUMMARISED
from harness.tables.study import STUDY_TABLES


def assert_declared(folder: Path) -> None:
    """Every file of a folder of results, and every column of its tables that is no axis."""
    for path in folder.iterdir():
        reference = (
            path.name == JOURNAL
            or LOCK_NAME.fullmatch(path.name)
            or is_output(path.name, "results")
        )
        assert reference, (
            f"{path.name} is not declared, so harness.programs.keeping.clean would leave it"
        )
    for table in (*STORED, *SUMMARISED, *STUDY_TABLES):
        declared = {name for column in table.stored for name in column.names}
        for path in (folder / name for name in table.files if name.endswith(".parquet")):
            if path.exists():
                schema = pq.read_schema(path)
                unknown = {
                    name
                    for name in schema.names
                    if name not in declared and not re.match(r"p: |.*\.", name)
                }
                assert not unknown, f"{path.name}: columns without a declaration: {unknown}"
                noted = [name for name in schema.names if name in declared]
                assert all(schema.field(name).metadata[b"note"] for name in noted)
