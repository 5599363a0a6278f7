"""Imported by the process that workers fork from (`harness.engine.processes`): it loads what all trials need, once."""

import harness.engine.trial  # noqa: F401
from harness.vocabulary.provenance import remember_loaded

remember_loaded()
