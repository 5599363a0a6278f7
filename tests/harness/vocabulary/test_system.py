"""The operating system's part, also where it is taken away (`tests/support/bare`)."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from harness.vocabulary import system
from harness.vocabulary.files import one_at_a_time, opened_lock, write_text
from tests.support import recorded_plane as plane

ROOT = Path(__file__).resolve().parents[3]
BARE = {
    "PYTHONPATH": os.pathsep.join((str(ROOT / "tests" / "support" / "bare"), str(ROOT))),
    "PYTHONIOENCODING": "cp1252",
    # files that are opened without an encoding hold ASCII only
    "LC_ALL": "C",
    "PYTHONCOERCECLOCALE": "0",
    "PYTHONUTF8": "0",
    "OMP_NUM_THREADS": "1",
}


def run_bare(*arguments: str | Path, folder: Path = ROOT, **stated: str) -> str:
    """Run Python with the platform taken away; return what it printed, decoded as its console
    does."""
    command = [sys.executable, *map(str, arguments)]
    environment = os.environ | BARE | stated
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, timeout=900)
    printed = (done.stdout + done.stderr).decode("cp1252")
    assert done.returncode == 0, printed
    return printed


LOCKS = """
import sys
from pathlib import Path
from harness.vocabulary import system
from harness.vocabulary.files import limited_memory, one_at_a_time, opened_lock, write_text

for module in ("fcntl", "resource"):
    assert sys.modules[module] is None
path = Path(sys.argv[1])
with opened_lock(path) as first, opened_lock(path) as second, opened_lock(path) as third:
    assert system.lock(first, shared=True, wait=False) == "held"
    assert system.lock(second, shared=True, wait=False) == "held"
    assert system.lock(third, shared=False, wait=False) == "busy"
    first.close()
    assert system.lock(third, shared=False, wait=False) == "busy"
    second.close()
    assert system.lock(third, shared=False, wait=False) == "held"
    with opened_lock(path) as fourth:
        assert system.lock(fourth, shared=True, wait=False) == "busy"
with one_at_a_time(path, 2**32 - 1), opened_lock(path) as other:
    msvcrt = sys.modules["msvcrt"]
    assert not system._lock_bytes(msvcrt, other, (2**32 - 1) % system.WINDOWS_BYTES, 1)
    assert system._lock_bytes(msvcrt, other, 7, 1)
write_text(path, "flushed and renamed")
with limited_memory():
    assert system.peak_memory_bytes() == 0
system.reset_peak_memory()
system.limit_private_memory(1)
system.end_with_parent()
assert not system.limits_private_memory() and not system.can_fork()
assert system.forked_processes().get_start_method() == "spawn"
"""


def test_locks_hold_and_nothing_fails_with_the_platform_taken_away(tmp_path: Path) -> None:
    run_bare("-c", LOCKS, tmp_path / "lock")


def test_a_system_without_locks_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for module in ("fcntl", "msvcrt"):
        monkeypatch.setitem(sys.modules, module, None)
    with opened_lock(tmp_path / "lock") as file:
        assert system.lock(file, shared=False, wait=True) == "no locks"
    with one_at_a_time(tmp_path / "lock", 7):
        pass


class InUse(PermissionError):
    """What Windows raises where a program looks into a file."""

    winerror = 32


def test_a_file_that_is_open_for_a_moment_is_renamed_over(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    replace = os.replace
    refusals = [InUse(), InUse()]

    def replaced_at_last(source: Path, target: Path) -> None:
        if refusals:
            raise refusals.pop()
        replace(source, target)

    monkeypatch.setattr("os.replace", replaced_at_last)
    write_text(tmp_path / "text", "new")
    assert (tmp_path / "text").read_text() == "new" and not refusals
    monkeypatch.setattr(system, "RENAMES_S", 0.0)
    refusals.append(PermissionError())
    with pytest.raises(PermissionError):
        system.replace(tmp_path / "text", tmp_path / "other")


def test_a_second_name_of_a_folder_is_a_copy_where_there_are_no_links(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refused(*_: object, **__: object) -> None:
        raise OSError

    (tmp_path / "rgb").mkdir()
    (tmp_path / "rgb" / "0.png").touch()
    system.link_or_copy(tmp_path / "rgb", tmp_path / "linked")
    assert os.readlink(tmp_path / "linked") == "rgb"
    monkeypatch.setattr("os.symlink", refused)
    system.link_or_copy(tmp_path / "rgb", tmp_path / "copied")
    assert (tmp_path / "copied" / "0.png").exists() and not (tmp_path / "copied").is_symlink()


@pytest.mark.parametrize(
    ("code", "cause"),
    [(3, "exited with code 3"), (-9, "ended by SIGKILL: by a user"), (-99, "ended by signal 99")],
)
def test_the_cause_of_an_end_is_told(code: int, cause: str) -> None:
    assert cause in system.cause_of_end(code)


@pytest.mark.parametrize(
    ("platform", "names"),
    [
        ("linux", ("lib/libLLVM.so.9", "lib/libLLVM.so.23.1")),
        ("darwin", ("lib/libLLVM.dylib", "lib/libLLVM-20.dylib")),
        ("win32", ("Library/bin/LLVM-C.dll",)),
    ],
)
def test_llvm_is_found_where_each_system_has_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, platform: str, names: tuple[str, ...]
) -> None:
    for prefix in ("prefix", "base_prefix"):
        monkeypatch.setattr(sys, prefix, str(tmp_path))
    monkeypatch.setattr(sys, "platform", platform)
    assert system.llvm_libraries() == []
    for name in names:
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).touch()
    assert system.llvm_libraries()[0] == tmp_path / names[-1]


HELP = """
from harness.__main__ import MODULES, main
for name in MODULES:
    try:
        main([name, "--help"])
    except SystemExit as end:
        assert end.code == 0
"""


def test_every_help_can_be_printed_on_a_console_of_few_characters() -> None:
    assert run_bare("-c", HELP, PYTHONIOENCODING="ascii").count("usage: tofpod") >= 26


PROGRAMS = """
from harness.__main__ import main
for words in (
    ["pod", "inspections.csv", "--size", "mm", "--hit", "found", "--out", "out"],
    ["ask", "--damage", "hole", "--size", "7mm", "--distance", "1m"],
    ["ls", "results"],
    ["ls", "detectors"],
):
    assert main(words) == 0, words
"""
DETECT = """
from harness.__main__ import main
inputs = ["plane.ply", "--intrinsics", "lens.json", "--set", "hole_model.blur_px=1"]
assert main(["detect", *inputs, "--out", "out"]) == 0
"""


def assert_stored_for_every_system(folder: Path) -> None:
    """Stored files name paths with "/" and end their lines as on every other system."""
    texts = [path for path in folder.iterdir() if path.suffix in (".json", ".csv", ".html")]
    assert texts
    for path in texts:
        assert b"\r" not in path.read_bytes(), path


def test_pod_and_ask_read_and_answer_with_the_platform_taken_away(tmp_path: Path) -> None:
    """A table with Windows' ends of lines, on a console of few characters."""
    sizes = np.linspace(0.5, 12.0, 60)
    hits = np.random.default_rng(4).random(60) < 1 / (1 + np.exp(4 - sizes))
    rows = [f"{size},{int(hit)}" for size, hit in zip(sizes, hits, strict=True)]
    (tmp_path / "inspections.csv").write_text("\r\n".join(["mm,found", *rows, ""]), newline="")
    printed = run_bare("-c", PROGRAMS, folder=tmp_path, WITHOUT_LINKS="1")
    assert "hit/miss, 60 inspections" in printed and "Through-holes of 7 mm at 1 m" in printed
    assert_stored_for_every_system(tmp_path / "out")


@pytest.mark.slow  # 5 s; the readers' own tests have files with such ends of lines
def test_detect_finds_the_hole_with_the_platform_taken_away(tmp_path: Path) -> None:
    plane.write_lens(tmp_path / "lens.json")
    points = plane.points_m(plane.depth_mm(noise_mm=0.6))
    text = "\n".join(" ".join(map(str, point)) for point in points.reshape(-1, 3))
    header = (
        f"ply\nformat ascii 1.0\nelement vertex {points[..., 0].size}\n"
        "property float x\nproperty float y\nproperty float z\nend_header\n"
    )
    (tmp_path / "plane.ply").write_text(f"{header}{text}\n", newline="\r\n")
    printed = run_bare("-c", DETECT, folder=tmp_path, WITHOUT_LINKS="1")
    assert "One hole found" in printed
    assert_stored_for_every_system(tmp_path / "out")


@pytest.mark.slow  # a minute and more: the tests of what asks for the operating system
@pytest.mark.parametrize(
    "file",
    (
        "programs/keeping/test_listing.py",
        "runs/test_engine.py",
        "runs/test_engine_processes.py",
        "runs/test_journal.py",
        "vocabulary/test_errors.py",
        "vocabulary/test_files.py",
        "vocabulary/test_locks.py",
    ),
)
def test_the_suite_passes_with_the_platform_taken_away(file: str) -> None:
    """Sweeps by one process and by several, locks, resumption after Ctrl-C, `ls`, `clean`."""
    where = ROOT / "tests" / "harness" / file
    options = ("-q", "-n", "0", "-p", "no:cacheprovider", "--tb=short")
    # the tests themselves write files without naming an encoding
    run_bare("-m", "pytest", *options, where, PYTHONUTF8="1")
