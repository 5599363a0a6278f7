"""Numbers of holes found, of which some may be undecided, and how two of them compare."""

from __future__ import annotations

from typing import Literal, NamedTuple, get_args

Standing = Literal["ahead", "level", "behind", "open"]
STANDINGS: tuple[Standing, ...] = get_args(Standing)


class HoleCount(NamedTuple):
    """The fewest and the most holes that a camera, or a map, may find."""

    fewest: int
    most: int

    @property
    def text(self) -> str:
        """``8``, or ``8 to 9`` if it is not certain."""
        if self.fewest == self.most:
            return str(self.fewest)
        return f"{self.fewest} to {self.most}"

    def against(self, rival: HoleCount) -> Standing:
        """Return the standing against a rival: "open" if the ranges allow several."""
        if self.fewest > rival.most:
            return "ahead"
        if self.most < rival.fewest:
            return "behind"
        is_certain = self.fewest == self.most and rival.fewest == rival.most
        return "level" if is_certain else "open"
