"""Give malformed inputs to all programs, and print by program how many were refused with one
message, answered, or ended in a traceback. The exit code is 1 after any traceback."""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections import Counter
from contextlib import suppress
from pathlib import Path

from tests.fuzz.bases import written_bases
from tests.fuzz.trying import End, tried

STATES = ("refused", "answered", "stopped", "traceback")


def options() -> argparse.Namespace:
    """Return the options of the command line."""
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz", description=__doc__)
    add = parser.add_argument
    add("--count", type=int, default=2000, metavar="N", help="number of inputs (default 2000)")
    add("--seed", type=int, default=1, metavar="S", help="seed of the faults (default 1)")
    add("--first", type=int, default=0, metavar="N", help="number of the first input (default 0)")
    add("--only", default="", metavar="PROGRAM", help="inputs of this program only")
    add("--bases", type=Path, metavar="DIR", help="keep the valid inputs there for the next run")
    return parser.parse_args()


def table(ends: list[End]) -> str:
    """Return the table of counts by program."""
    lines = [f"{'program':14}{'inputs':>8}" + "".join(f"{state:>11}" for state in STATES)]
    programs = sorted({end.program for end in ends})
    for program in (*programs, "all"):
        chosen = [end for end in ends if program in (end.program, "all")]
        counts = Counter(end.state for end in chosen)
        cells = "".join(f"{counts[state]:>11}" for state in STATES)
        lines.append(f"{program:14}{len(chosen):>8}{cells}")
    return "\n".join(lines)


def main() -> int:
    """Run the command. Returns 1 after a traceback."""
    arguments = options()
    ends = []
    numbers = range(arguments.first, arguments.first + arguments.count)
    with tempfile.TemporaryDirectory() as home:
        base = written_bases(arguments.bases or Path(home) / "bases")
        # Ctrl-C ends the run, and what was counted until then is printed
        with suppress(KeyboardInterrupt):
            for end in tried(base, numbers, arguments.seed, arguments.only):
                ends.append(end)
                if end.state == "traceback":
                    print(f"input {end.number}: tofpod {end.program} {' '.join(end.words)}")
                    print(end.text, flush=True)
    print(table(ends))
    return int(any(end.state == "traceback" for end in ends))


if __name__ == "__main__":
    sys.exit(main())
