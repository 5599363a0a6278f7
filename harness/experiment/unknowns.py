"""Facts that nobody has measured, and the values that are drawn for them.

Every board of a study, or every set-up of an experiment with ``draws``, has one value of each
unknown. Draws are balanced: boards take the values (or the parts of a range) in blocks, each of
which has every value once in random order. So boards 0 to n have nearly equal numbers of all
values, whatever n is, and another unknown or a further board changes no value.

Not modelled: unknowns that hang together (a dark paint that is also glossy)."""

from collections import Counter
from typing import Annotated, Any, Self

from pydantic import Field, model_validator

from harness.vocabulary.config import Config
from harness.vocabulary.seeds import canonical_json, random_stream

PARTS = 6
"""Number of equal parts of a range that a block of boards has once each."""
DIGITS = 6
"""Significant digits of a number drawn from a range, so that tables and YAML state it in full."""
WORLD = ("source.target.", "source.camera.")
"""Beginnings of the keys of what is there, whether or not it is known."""
CHOSEN = ("source.camera.name", "source.target.name", "source.target.seed", "source.target.damage")
"""Keys below these that somebody chooses, so that they cannot be unknown."""


class UnknownConfig(Config):
    """A fact of the target or of the camera that nobody has measured: its key, and either some
    ``values`` that are equally probable, or a ``range`` in which all numbers are."""

    key: Annotated[str, Field(min_length=1, max_length=200)] = Field(
        description="dotted key below source.target or source.camera"
    )
    values: Annotated[tuple[Any, ...], Field(min_length=2, max_length=20)] | None = Field(
        None, description="equally probable values"
    )
    range: tuple[float, float] | None = Field(
        None, description="ends of a range of equally probable numbers"
    )
    reason: Annotated[str, Field(min_length=1, max_length=1000)]

    @model_validator(mode="after")
    def _one_of_the_two(self) -> Self:
        if (self.values is None) == (self.range is None):
            raise ValueError("give either `values` or `range`, and not both")
        if self.range is not None and not self.range[0] < self.range[1]:
            raise ValueError(f"the range {self.range[0]:g} to {self.range[1]:g} is empty")
        if not self.key.startswith(WORLD):
            raise ValueError(f"`{self.key}` is no fact of source.target or source.camera")
        if any(self.key == key or self.key.startswith(f"{key}.") for key in CHOSEN):
            raise ValueError(f"`{self.key}` is chosen and cannot be unknown")
        texts = Counter(canonical_json(value) for value in self.values or ())
        repeated = [text for text, count in texts.items() if count > 1]
        if repeated:
            raise ValueError(
                f"`values` repeat {', '.join(repeated)}: equally probable values stand once each"
            )
        return self

    @property
    def levels(self) -> tuple[Any, ...]:
        """All values, or the ends of the range."""
        return self.range or self.values or ()

    def drawn(self, seed: int, purpose: str, number: int) -> Any:
        """Return the value for the board of a purpose, or the set-up, of this number."""
        size = PARTS if self.values is None else len(self.values)
        block = number // size
        index = number % size
        stream = random_stream(seed, "unknown", self.key, purpose, block)
        part = int(stream.permutation(size)[index])
        if self.values is not None:
            return self.values[part]
        low, high = self.levels
        share = (part + stream.random(size)[index]) / size
        value = low + (high - low) * share
        return float(f"{value:.{DIGITS}g}")


def is_same_fact(first: str, second: str) -> bool:
    """Return whether two dotted keys set the same thing, wholly or in part."""
    return f"{first}.".startswith(f"{second}.") or f"{second}.".startswith(f"{first}.")
