"""Simulated beside published: the score of each figure, and the baseline that no change may fall behind."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from harness.scorecard.estimate import Estimate
from harness.scorecard.published import Figure
from harness.vocabulary.errors import UserError
from harness.vocabulary.files import write_text
from harness.vocabulary.json_text import strict_json
from harness.vocabulary.limits import TEXT_BYTES, bounded_bytes
from harness.vocabulary.versions import check_version

BASELINE_FILE = Path(__file__).with_name("baseline.json")
SCORECARD_VERSION = 1
"""Of a baseline; raised when the meaning of its keys changes."""
AGAIN = "remove it, and write it anew with --update-baseline"


@dataclass(frozen=True)
class Score:
    """One figure, what the simulation gave, whether it passed in the baseline (None where that does not know it)."""

    figure: Figure
    simulated: Estimate
    passed_before: bool | None

    @property
    def passes(self) -> bool:
        """Whether the simulated value lies within what was published, tolerance included; False without a value."""
        low, high = self.figure.entry.published.limits
        return bool(np.isfinite(self.simulated.value) and low <= self.simulated.value <= high)

    @property
    def regressed(self) -> bool:
        """Whether the figure passed in the baseline and fails now."""
        return self.passed_before is True and not self.passes

    @property
    def verdict(self) -> str:
        """``pass``, ``fail``, or ``FAIL (passed before)``."""
        return "pass" if self.passes else "FAIL (passed before)" if self.regressed else "fail"


def judged(
    figures: Sequence[Figure], simulated: Mapping[str, Estimate], baseline: Mapping[str, bool]
) -> tuple[Score, ...]:
    """The scores of figures whose estimates are given by name."""
    return tuple(Score(figure, simulated[figure.name], baseline.get(figure.name)) for figure in figures)


def read_baseline(path: Path) -> dict[str, bool]:
    """Which figures passed, by name; empty where there is no file. Raises UserError where it is no baseline, or one
    of another version."""
    return {name: one["passes"] for name, one in _figures(path).items()}


def _figures(path: Path) -> dict[str, dict[str, Any]]:
    """What a baseline says of each figure."""
    if not path.exists():
        return {}
    try:
        data = strict_json(bounded_bytes(path, TEXT_BYTES))
        check_version(data["scorecard_version"], SCORECARD_VERSION, path, "a baseline of the scorecard", again=AGAIN)
        figures: dict[str, dict[str, Any]] = data["figures"]
        is_one = all(isinstance(one["passes"], bool) for one in figures.values())
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise _no_baseline(path) from error
    if not is_one:
        raise _no_baseline(path)
    return figures


def _no_baseline(path: Path) -> UserError:
    return UserError(
        f"{path}: is no baseline of the scorecard",
        legal='JSON: {"scorecard_version": 1, "figures": {NAME: {"passes": true or false, "simulated": number}}}',
        fix=AGAIN,
    )


def write_baseline(path: Path, scores: Iterable[Score], known: Iterable[str]) -> None:
    """Write which figures pass, and the simulated values for the reader of a change.

    Entries of other figures stay as they are where their name is among the ``known`` ones.
    """
    figures = {name: one for name, one in _figures(path).items() if name in set(known)}
    figures |= {score.figure.name: {"passes": score.passes, "simulated": _rounded(score)} for score in scores}
    lines = [f"    {json.dumps(name)}: {json.dumps(one)}" for name, one in sorted(figures.items())]
    head = f'{{\n  "scorecard_version": {SCORECARD_VERSION},\n  "figures": {{\n'
    write_text(path, head + ",\n".join(lines) + "\n  }\n}\n")


def _rounded(score: Score) -> float | None:
    value = score.simulated.value
    return float(f"{value:.4g}") if np.isfinite(value) else None
