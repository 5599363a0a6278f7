"""The harness: shared vocabulary, experiments, engine, evaluation, report and programs."""

__version__ = (
    "0.2.0"  # the one source: pyproject.toml reads it; tests compare what documents repeat
)
