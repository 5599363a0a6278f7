"""Declarations that users write in YAML: text with places, validation, and every problem with its place."""
