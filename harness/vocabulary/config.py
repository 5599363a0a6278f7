"""The base class of every declaration that a user writes: strict, finite and frozen, without
unknown keys."""

from typing import Any, Self

from pydantic import BaseModel, ConfigDict, model_validator


class Config(BaseModel):
    """A declaration. It refuses unknown keys, NaN, infinity, and text or booleans in place of
    numbers."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False)

    @model_validator(mode="before")
    @classmethod
    def _lists_are_tuples(cls, data: Any) -> Any:
        # Strict mode accepts no list in place of a tuple, and YAML and JSON have only lists.
        return (
            {key: _as_tuple(value) for key, value in data.items()}
            if isinstance(data, dict)
            else data
        )

    def model_copy(self, **options: Any) -> Self:
        """Copy as pydantic does, but drop the values that the original has cached."""
        copied = super().model_copy(**options)
        for name in copied.__dict__.keys() - type(self).model_fields.keys():
            del copied.__dict__[name]
        return copied

    @classmethod
    def from_data(cls, data: Any) -> Self:
        """Validate plain data. Raises pydantic.ValidationError, whose ``loc`` entries are paths in
        the data."""
        return cls.model_validate(data)

    def to_data(self) -> dict[str, Any]:
        """Return plain data with every default filled in; ``from_data`` inverts it."""
        return self.model_dump(mode="json")


def _as_tuple(value: Any) -> Any:
    """Convert nested lists to nested tuples. Lists within a mapping are converted by the mapping's
    own model."""
    return tuple(_as_tuple(item) for item in value) if isinstance(value, list) else value
