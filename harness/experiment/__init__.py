"""Reads an experiment's YAML, validates it as a whole, and unfolds it into points. This room runs
nothing."""
