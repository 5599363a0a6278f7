"""Prints how much of the project's code a sweep enters: ``python tests/entered_files.py``.

A small `averaging` sweep runs in this process, from nothing, in a temporary folder. A file or a
function counts if its code is called in any thread. Importing a module and making a class are no
calls, and neither are comprehensions, lambdas and loops that Numba compiled.
"""

from __future__ import annotations

import argparse
import contextlib
import inspect
import io
import sys
import tempfile
import threading
from collections.abc import Sequence
from pathlib import Path
from types import CodeType, FrameType
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
CODE_FOLDERS = ("harness", "scenes", "detectors")
SMALL = (
    "repeats=2",
    "threshold.calibrate.repeats=2",
    "sweep={capture.frames: [1, 5]}",
    "sensitivity=null",
)


def entered_code(experiment: str, settings: Sequence[str]) -> set[CodeType]:
    """Run a sweep and return the functions of this checkout that were called."""
    codes: set[CodeType] = set()

    def remember(frame: FrameType, event: str, argument: Any) -> None:
        if event == "call":
            codes.add(frame.f_code)

    with tempfile.TemporaryDirectory() as folder:
        arguments = [experiment, "--serial", "--out", folder]
        for setting in settings:
            arguments += ["--set", setting]
        sys.path.insert(0, str(ROOT))
        threading.setprofile(remember)
        sys.setprofile(remember)
        try:
            from harness.sweep import main

            with contextlib.redirect_stdout(io.StringIO()):
                exit_code = main(arguments)
        finally:
            sys.setprofile(None)
            threading.setprofile(None)
    if exit_code != 0:
        raise RuntimeError(f"the sweep of {experiment} ended with exit code {exit_code}")
    return {code for code in codes if is_function_of_project(code)}


def is_function_of_project(code: CodeType) -> bool:
    """Return whether code is that of a named function or method in the project's folders."""
    path = Path(code.co_filename)
    is_function = bool(code.co_flags & inspect.CO_OPTIMIZED) and not code.co_name.startswith("<")
    return is_function and any(path.is_relative_to(ROOT / folder) for folder in CODE_FOLDERS)


def main() -> int:
    """Print the numbers of files and functions. Returns 0."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--list", action="store_true", help="name the functions of each file")
    options = parser.parse_args()
    codes = entered_code("averaging", SMALL)
    by_file: dict[str, list[str]] = {}
    for code in sorted(codes, key=lambda code: (code.co_filename, code.co_firstlineno)):
        path = Path(code.co_filename).relative_to(ROOT).as_posix()
        by_file.setdefault(path, []).append(code.co_qualname)
    if options.list:
        for path, names in by_file.items():
            print(f"{path}: {', '.join(names)}")
    print(f"{len(by_file)} files and {len(codes)} functions entered")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
