"""Make recordings of all kinds, answer them with the default command, and print right, warned and
wrong by kind."""

from __future__ import annotations

import argparse
import math
import sys
import tempfile
import zlib
from pathlib import Path

import numpy as np
from scipy import stats

from tests.strangers.kinds import KINDS
from tests.strangers.recording import flat_field_arguments, recorded, written
from tests.strangers.score import Score, answered, scored

LEAST_CHANCE = 1e-3
"""Least probability of as many doubtful findings that are false, if as many are expected as the
answers state."""


def made(kind: str, seed: int, folder: Path) -> Score:
    """Make one recording in ``folder``, answer it and score the answer; what was printed goes to
    answer.txt there."""
    rng = np.random.default_rng([zlib.crc32(kind.encode()), seed])
    stranger = KINDS[kind](rng)
    stack, view, truths = recorded(stranger, rng)
    path = written(stranger, stack, folder / "in")
    arguments = (*stranger.format.arguments, *flat_field_arguments(stranger, rng, path))
    code, printed, rows = answered(path, folder / "out", arguments)
    score = scored(stranger, view, truths, code, printed, rows)
    (folder / "answer.txt").write_text(f"{score.verdict}: {'; '.join(score.why)}\n{printed}")
    return score


def main() -> int:
    """Run the chosen kinds; returns 0 where no answer is wrong, else 1."""
    parser = argparse.ArgumentParser(prog="python -m tests.strangers", description=__doc__)
    parser.add_argument("kinds", nargs="*", metavar="KIND", help=f"default all: {', '.join(KINDS)}")
    parser.add_argument(
        "--seeds", type=int, default=2, metavar="N", help="recordings of each kind (default 2)"
    )
    parser.add_argument(
        "--first", type=int, default=0, metavar="SEED", help="first seed (default 0)"
    )
    parser.add_argument(
        "--keep", type=Path, metavar="DIR", help="keep all recordings and answers here"
    )
    arguments = parser.parse_args()
    unknown = sorted(set(arguments.kinds) - set(KINDS))
    if unknown:
        parser.error(f"no such kind: {', '.join(unknown)}")
    with tempfile.TemporaryDirectory() as scratch:
        return _report(arguments, arguments.keep or Path(scratch))


def _report(arguments: argparse.Namespace, root: Path) -> int:
    print(f"{'kind':22s} right warned wrong needless  clear found false")
    total = np.zeros(7, int)
    doubtful = 0
    expected = 0.0
    wrong = []
    for kind in arguments.kinds or KINDS:
        counts = np.zeros(7, int)
        for seed in range(arguments.first, arguments.first + arguments.seeds):
            score = made(kind, seed, root / kind / str(seed))
            verdicts = [score.verdict == verdict for verdict in ("right", "warned", "wrong")]
            counts += [*verdicts, score.needless, score.clear, score.found, score.false]
            if not math.isnan(score.expected):
                doubtful += score.doubtful
                expected += score.expected
            if score.verdict == "wrong":
                wrong.append(f"{kind} {seed}: {'; '.join(score.why)}")
        print(_row(kind, counts), flush=True)
        total += counts
    print(_row("all", total))
    chance = float(stats.poisson.sf(doubtful - 1, expected))
    print(f"{doubtful} doubtful findings are false, {expected:.1f} expected: chance {chance:.2g}")
    if chance < LEAST_CHANCE:
        wrong.append("more doubtful findings are false than the answers expect together")
    print("wrong without a word:" if wrong else "none is wrong without a word")
    for line in wrong:
        print(f"  {line}")
    return int(bool(wrong))


def _row(name: str, counts: np.ndarray) -> str:
    widths = (6, 7, 6, 9, 7, 6, 6)
    return f"{name:22s}" + "".join(f"{n:{width}d}" for n, width in zip(counts, widths, strict=True))


if __name__ == "__main__":
    sys.exit(main())
