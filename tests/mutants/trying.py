"""Runs the tests of a room on a mutant, in a copy of the tree that is thrown away."""

import contextlib
import hashlib
import json
import math
import os
import re
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from tests.mutants.draw import PRODUCT, product_modules
from tests.mutants.kinds import Mutant
from tests.mutants.rooms import imported, module_name, room_tests

EXTRA_S = 60.0
FACTOR = 3.0
"""The tests of a mutant may take so many processor seconds more than this multiple of the seconds
of the unchanged tests, as kernels are compiled anew."""
PATIENCE = 10.0
"""Real seconds per processor second of this limit after which a process waits in vain."""
PYTEST = ("-m", "pytest", "-q", "-m", "not slow", "-p", "no:cacheprovider", "--hypothesis-seed=0")
FAILURE = re.compile(r"^(?:FAILED|ERROR) (\S+)", re.MULTILINE)
NO_TESTS = 5  # pytest's exit code if all tests are deselected
OWN = "tests/mutants/"  # not copied: another equivalent mutant changes no test
COPIED = (*PRODUCT, "tests")  # folders with compiled files
COMPILED = ("*.nbi", "*.nbc")  # files in which numba keeps kernels


@dataclass(frozen=True)
class TestRun:
    """A run of some test files."""

    __test__ = False

    state: str
    """``passed``, ``failed`` or ``timed out``."""
    test: str
    """The first test that failed."""
    seconds: float


class BrokenTests(Exception):
    """The tests fail without any fault."""


class Tree:
    """A copy of a checkout in which the unchanged tests have passed, so that bytecode and kernels
    are compiled."""

    def __init__(self, root: Path, home: Path) -> None:
        """Make or update the copy below ``home``."""
        self.folder = home / "tree"
        self._record = home / "baseline.json"
        files = _files(root)
        digest = hashlib.sha256()
        for name in files:
            digest.update(name.encode() + b"\0" + (root / name).read_bytes())
        self._digest = digest.hexdigest()
        self._seconds: dict[str, dict[str, float]] = {}
        self._failures: dict[str, str] = {}
        stored = json.loads(self._record.read_text()) if self._record.exists() else {}
        if stored.get("digest") == self._digest:
            self._seconds = stored["seconds"]
            return
        shutil.rmtree(self.folder, ignore_errors=True)
        for name in files:
            target = self.folder / name
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(root / name, target)
        # compiled files stay valid, as the copies keep the times of their sources
        for cache in sorted(path for room in COPIED for path in (root / room).rglob("__pycache__")):
            relative = cache.relative_to(root)
            if (self.folder / relative.parent).is_dir():
                shutil.copytree(cache, self.folder / relative)

    def seconds(self, files: list[str]) -> dict[str, float]:
        """Return the seconds of test files on the unchanged product, which are measured once for
        all files of a folder. Raises BrokenTests if one of them fails."""
        seconds: dict[str, float] = {}
        for folder in sorted({Path(file).parent.as_posix() for file in files}):
            if folder in self._failures:
                raise BrokenTests(self._failures[folder])
            if folder not in self._seconds:
                self._seconds[folder] = self._measured(folder)
                record = {"digest": self._digest, "seconds": self._seconds}
                self._record.write_text(json.dumps(record, indent=1))
            seconds.update(self._seconds[folder])
        return {file: seconds[file] for file in files}

    def _measured(self, folder: str) -> dict[str, float]:
        paths = sorted((self.folder / folder).glob("test_*.py"))
        files = [path.relative_to(self.folder).as_posix() for path in paths]
        report = self.folder.parent / "report.xml"
        run = run_tests(self.folder, files, 3600.0, f"--junitxml={report}")
        if run.state != "passed":
            outcome = run.test or run.state
            self._failures[folder] = f"{outcome}: the tests fail on the unchanged product"
            raise BrokenTests(self._failures[folder])
        return _seconds_of_files(report, files)


def _files(root: Path) -> list[str]:
    """Return the files of a checkout that Git does not ignore, but those of this tool."""
    command = ["git", "ls-files", "--cached", "--others", "--exclude-standard", "-z"]
    listed = subprocess.run(command, cwd=root, check=True, capture_output=True, text=True).stdout
    names = [name for name in listed.split("\0") if name and not name.startswith(OWN)]
    return sorted(name for name in names if (root / name).is_file())


def _seconds_of_files(report: Path, files: list[str]) -> dict[str, float]:
    """Return the seconds of each test file in a report in JUnit's format."""
    seconds = dict.fromkeys(files, 0.0)
    module_of = {file.removesuffix(".py").replace("/", "."): file for file in files}
    for case in ElementTree.parse(report).iter("testcase"):
        classname = case.get("classname", "")
        for module, file in module_of.items():
            if classname == module or classname.startswith(f"{module}."):
                seconds[file] += float(case.get("time", "0"))
    return seconds


def run_tests(tree: Path, files: list[str], limit_s: float, *options: str) -> TestRun:
    """Run test files until the first failure, or until a process has used ``limit_s`` processor
    seconds, which do not depend on what else the machine does."""
    limit = math.ceil(limit_s)

    def limited() -> None:
        resource.setrlimit(resource.RLIMIT_CPU, (limit, limit + 5))

    environment = {**os.environ, "PYTHONPATH": str(tree), "OMP_NUM_THREADS": "1"}
    environment.pop("PYTHONDONTWRITEBYTECODE", None)
    began = time.monotonic()
    with tempfile.TemporaryDirectory(prefix="mutant-tests-", ignore_cleanup_errors=True) as scratch:
        output = Path(scratch) / "output.txt"
        command = [sys.executable, *PYTEST, "-x", f"--basetemp={scratch}/base", *options, *files]
        with output.open("w") as stream:
            process = subprocess.Popen(
                command,
                cwd=tree,
                env=environment,
                stdout=stream,
                stderr=subprocess.STDOUT,
                start_new_session=True,
                preexec_fn=limited,
            )
        try:
            code = process.wait(PATIENCE * limit_s)
        except subprocess.TimeoutExpired:
            return TestRun("timed out", "", time.monotonic() - began)
        finally:
            _end(process)
        seconds = time.monotonic() - began
        if code in (-signal.SIGXCPU, -signal.SIGKILL):
            return TestRun("timed out", "", seconds)
        if code in (0, NO_TESTS):
            return TestRun("passed", "", seconds)
        failure = FAILURE.search(output.read_text(errors="replace"))
        return TestRun("failed", failure.group(1) if failure else f"exit code {code}", seconds)


def _end(process: subprocess.Popen[bytes]) -> None:
    """End a process with all that it has started."""
    with contextlib.suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)
    process.wait()


def tried(mutant: Mutant, tree: Tree) -> TestRun:
    """Return the outcome of the room's tests on a mutant: first of the files that import the
    module, and in both groups the fastest file first."""
    direct, indirect = room_tests(tree.folder, mutant.file)
    seconds = tree.seconds([*direct, *indirect])
    limit_s = EXTRA_S + FACTOR * sum(seconds.values())
    compiled_in = users_of_kernels(tree.folder, mutant.file)
    total_s = 0.0
    with tempfile.TemporaryDirectory(prefix="mutant-", ignore_cleanup_errors=True) as scratch:
        copy = Path(scratch) / "tree"
        shutil.copytree(tree.folder, copy)
        put_in(mutant, copy, compiled_in)
        for group in (direct, indirect):
            if not group:
                continue
            files = sorted(group, key=lambda file: seconds[file])
            run = run_tests(copy, files, limit_s)
            total_s += run.seconds
            if run.state != "passed":
                return TestRun(run.state, run.test, total_s)
    return TestRun("passed", "", total_s)


def put_in(mutant: Mutant, tree: Path, compiled_in: Iterable[str]) -> None:
    """Write a mutant into a copy of the tree, and remove what was compiled from the module, and the
    kernels of the modules ``compiled_in``, which contain it."""
    path = tree / mutant.file
    path.write_bytes(mutant.applied(path.read_bytes()))
    _remove(path.parent.glob(f"__pycache__/{path.stem}.*"))
    for user in compiled_in:
        module = tree / user
        for pattern in COMPILED:
            _remove(module.parent.glob(f"__pycache__/{module.stem}.{pattern}"))


def users_of_kernels(tree: Path, file: str) -> list[str]:
    """Return the modules with kernels that contain functions or constants of a module: numba keeps
    these with the kernel, and notices changes of the kernel's own file only."""
    with_kernels = [path for path in product_modules(tree) if b"njit" in path.read_bytes()]
    names = {path: imported(path) for path in with_kernels}
    changed = {module_name(file)}
    users: list[Path] = []
    grows = True
    while grows:
        fresh = [path for path in with_kernels if path not in users and names[path] & changed]
        users += fresh
        changed.update(module_name(path.relative_to(tree).as_posix()) for path in fresh)
        grows = bool(fresh)
    return [path.relative_to(tree).as_posix() for path in users]


def _remove(paths: Iterable[Path]) -> None:
    for path in list(paths):
        path.unlink()
