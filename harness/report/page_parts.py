"""Names that the study's page takes from here: the template and its closing sections."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from harness.report.blocks import closing, joined, template
from harness.tables.grid import aligned
from harness.tables.text import mm

__all__ = ["aligned", "closing_sections", "mm", "template"]


def closing_sections(provenance: Mapping[str, Any], experiment_yaml_text: str) -> dict[str, Any]:
    """The closing sections for a template that extends page.html."""
    return {"closing": joined(closing(provenance, experiment_yaml_text))}
