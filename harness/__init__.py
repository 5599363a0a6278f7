"""The harness: shared vocabulary, experiments, engine, evaluation, report and programs."""

__version__ = "0.1.0"
