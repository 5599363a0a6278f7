"""Simulated beside published: the score of each figure, and the baseline that no change may fall behind."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from harness.scorecard.estimate import Estimate
from harness.scorecard.published import Figure
from harness.vocabulary.errors import UserError
from harness.vocabulary.files import write_text

BASELINE_FILE = Path(__file__).with_name("baseline.json")


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
    """Which figures passed, by name; empty where there is no file. Raises UserError where it is no baseline."""
    if not path.exists():
        return {}
    try:
        figures = json.loads(path.read_text(encoding="utf-8"))["figures"]
        found = {str(name): one["passes"] for name, one in figures.items()}
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise _no_baseline(path) from error
    if not all(isinstance(passes, bool) for passes in found.values()):
        raise _no_baseline(path)
    return found


def _no_baseline(path: Path) -> UserError:
    return UserError(
        f"{path}: is no baseline of the scorecard",
        legal='JSON: {"figures": {NAME: {"passes": true or false, "simulated": number}}}',
        fix="write it anew with --update-baseline",
    )


def write_baseline(path: Path, scores: Iterable[Score], known: Iterable[str]) -> None:
    """Write which figures pass, and the simulated values for the reader of a change.

    Entries of other figures stay as they are where their name is among the ``known`` ones.
    """
    read_baseline(path)
    before = json.loads(path.read_text(encoding="utf-8"))["figures"] if path.exists() else {}
    figures = {name: one for name, one in before.items() if name in set(known)}
    figures |= {score.figure.name: {"passes": score.passes, "simulated": _rounded(score)} for score in scores}
    lines = [f"    {json.dumps(name)}: {json.dumps(one)}" for name, one in sorted(figures.items())]
    write_text(path, '{\n  "figures": {\n' + ",\n".join(lines) + "\n  }\n}\n")


def _rounded(score: Score) -> float | None:
    value = score.simulated.value
    return float(f"{value:.4g}") if np.isfinite(value) else None
