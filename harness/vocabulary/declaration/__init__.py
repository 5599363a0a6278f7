"""Reads and validates declarations that users write in YAML, and reports every problem with its
place."""
