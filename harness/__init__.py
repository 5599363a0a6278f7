"""The harness: shared vocabulary at its leaf; experiments, engine, evaluation, report and programs above it."""

__version__ = "0.1.0"
