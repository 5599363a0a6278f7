"""Targets of plain data, as of YAML and JSON."""

from __future__ import annotations

from pydantic import TypeAdapter

from scenes.target.thesis import AnyTargetConfig

target_from_data = TypeAdapter(AnyTargetConfig).validate_python
"""Raises pydantic.ValidationError; its ``loc`` starts with the kind."""
