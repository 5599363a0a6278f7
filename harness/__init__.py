"""The harness: shared vocabulary, experiments, engine, evaluation, report and programs."""

from harness.vocabulary.compiled_loops import keep_loops_where_writable

__version__ = (
    "0.2.0"  # the one source: pyproject.toml reads it; tests compare what documents repeat
)
keep_loops_where_writable()
