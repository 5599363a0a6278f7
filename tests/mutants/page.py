"""The page on mutants: the share killed, by room, and the survivors by module."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from scipy.stats import binomtest

from tests.mutants.kinds import Mutant

HEAD = """# See what the tests notice

{share} of small faults in the numeric modules are noticed by the tests of their rooms (Wilson's
95 % interval).

<!-- artefact: mutants -->

<!-- end: mutants -->

`make mutants` writes this page. {number} faults are drawn with the seed {seed}, at most one of an
expression. Each is put into a copy of the tree, where the tests of its room run without the slow
ones. A fault is killed if a test fails or takes much too long. Rooms in which faults live:
"""


@dataclass(frozen=True)
class MutantTrial:
    """A mutant with its outcome."""

    mutant: Mutant
    state: str
    """``killed``, ``timed out`` (which counts as killed) or ``survived``."""
    test: str
    """The first test that failed."""
    reason: str | None
    """Why a survivor is no fault; None for a fault."""

    @property
    def is_killed(self) -> bool:
        return self.state != "survived"

    @property
    def is_equivalent(self) -> bool:
        return not self.is_killed and self.reason is not None

    @property
    def lives(self) -> bool:
        """Whether it is a fault that no test has noticed."""
        return not self.is_killed and self.reason is None


def share_text(trials: Sequence[MutantTrial]) -> str:
    """Return the killed share of the faults with Wilson's 95 % interval."""
    faults = [trial for trial in trials if not trial.is_equivalent]
    if not faults:
        return "–"
    killed = sum(trial.is_killed for trial in faults)
    interval = binomtest(killed, len(faults)).proportion_ci(method="wilson")
    share = killed / len(faults)
    return f"{100 * share:.0f} % ({100 * interval.low:.0f} to {100 * interval.high:.0f})"


def _row(name: str, trials: Sequence[MutantTrial]) -> str:
    killed = sum(trial.is_killed for trial in trials)
    equivalent = sum(trial.is_equivalent for trial in trials)
    lives = sum(trial.lives for trial in trials)
    return f"| {name} | {len(trials)} | {killed} | {equivalent} | {lives} | {share_text(trials)} |"


def _table(rooms: dict[str, list[MutantTrial]], trials: Sequence[MutantTrial]) -> list[str]:
    """Return the rows of rooms in which faults live, and of all rooms together."""
    lines = [
        "| room | mutants | killed | equivalent | living | killed of the faults |",
        "|---|---|---|---|---|---|",
    ]
    for room, group in rooms.items():
        if any(trial.lives for trial in group):
            lines.append(_row(room, group))
    return [*lines, _row("all", trials), ""]


def _listed(trials: Sequence[MutantTrial]) -> list[str]:
    lines: list[str] = []
    file = ""
    for trial in trials:
        mutant = trial.mutant
        if mutant.file != file:
            file = mutant.file
            lines += [f"### {file}", ""]
        lines += [f"{mutant.function}, {mutant.kind}:", ""]
        lines += [f"    - {mutant.original}", f"    + {mutant.mutant}", ""]
        if trial.reason is not None:
            lines += [trial.reason, ""]
    return lines or ["None.", ""]


def page(trials: Sequence[MutantTrial], seed: int) -> str:
    """Return the page in Markdown. ``trials``: in the order of their files."""
    rooms: dict[str, list[MutantTrial]] = {}
    for trial in trials:
        room = Path(trial.mutant.file).parent.as_posix()
        rooms.setdefault(room, []).append(trial)
    share = share_text(trials)
    lines = [HEAD.format(share=share, number=len(trials), seed=seed)]
    lines += _table(rooms, trials)
    lines += ["## Faults that live", "", *_listed([trial for trial in trials if trial.lives])]
    lines += [
        "## Equivalent mutants",
        "",
        *_listed([trial for trial in trials if trial.is_equivalent]),
    ]
    return "\n".join(lines).rstrip() + "\n"
