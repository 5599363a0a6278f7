"""The base of every declaration that a user writes: strict, finite, frozen, no unknown keys."""

from __future__ import annotations

import json
from typing import Any, Self

from pydantic import BaseModel, ConfigDict


class Config(BaseModel):
    """A declaration. Unknown keys, NaN, infinity, and text or booleans in place of numbers are refused.

    Fields carry their unit in their name (``width_mm``).
    """

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False)

    @classmethod
    def from_data(cls, data: Any) -> Self:
        """Validate plain data (dicts, lists, numbers, text: what YAML and JSON hold).

        Goes through JSON because pydantic's strict mode takes a list for a tuple there and nowhere else.
        Raises pydantic.ValidationError, whose ``loc`` paths match the data's.
        """
        return cls.model_validate_json(json.dumps(data))

    def to_data(self) -> dict[str, Any]:
        """Plain data with every default filled in; ``from_data`` inverts it."""
        return self.model_dump(mode="json")
