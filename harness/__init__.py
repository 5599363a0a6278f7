"""The harness: shared vocabulary, experiments, engine, evaluation, report and programs."""

from harness.vocabulary.writable_caches import use_writable_caches

__version__ = (
    "0.2.0"  # the one source: pyproject.toml reads it; tests compare what documents repeat
)
use_writable_caches()
