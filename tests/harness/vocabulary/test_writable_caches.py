"""An installation that cannot be written: what Numba compiles and Matplotlib lists is kept where
the user may write."""

from __future__ import annotations

import os
import shutil
import stat
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from harness.vocabulary import writable_caches
from tests.support import recorded_plane as plane

ROOT = Path(__file__).resolve().parents[3]
WITHOUT_CAPABILITIES = ("setpriv", "--bounding-set=-all", "--inh-caps=-all")
"""For root, which else may write whatever a folder's permissions are."""
IS_ROOT = hasattr(os, "geteuid") and os.geteuid() == 0

pytestmark = pytest.mark.skipif(
    os.name == "nt" or (IS_ROOT and shutil.which("setpriv") is None),
    reason="needs permissions of folders, and for root setpriv",
)


@pytest.fixture
def installed(tmp_path: Path) -> Iterator[Path]:
    """A copy of the packages, and a home, that nobody may write."""
    folder = tmp_path / "installed"
    for name in ("harness", "detectors", "scenes"):
        ignored = shutil.ignore_patterns("__pycache__")
        shutil.copytree(ROOT / name, folder / name, ignore=ignored)
    (folder / "home").mkdir()
    folders = [folder, *(path for path in folder.rglob("*") if path.is_dir())]
    for path in folders:
        path.chmod(0o555)
    yield folder
    for path in folders:
        path.chmod(0o755)


def run(installed: Path, *words: str, **variables: str) -> str:
    """Run Python on the installation with these variables only; return what it prints."""
    own = {"HOME": str(installed / "home"), "PYTHONPATH": str(installed), "OMP_NUM_THREADS": "1"}
    own["PATH"] = os.environ["PATH"]
    command = [*(WITHOUT_CAPABILITIES if IS_ROOT else ()), sys.executable, "-I", "-c"]
    code = f"import sys; sys.path.insert(0, {str(installed)!r})\n"
    done = subprocess.run(
        [*command, code + words[0], *words[1:]],
        env={**own, **variables},
        cwd=installed,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    assert not done.stderr
    return done.stdout


MEDIANS = (
    "import os\n"
    "import detectors.pixels.medians as medians\n"
    "assert medians.__file__.startswith(sys.path[0])\n"
    "print(os.environ['NUMBA_CACHE_DIR'], os.environ['MPLCONFIGDIR'])\n"
)


def test_a_read_only_installation_uses_the_stated_folders(installed: Path, tmp_path: Path):
    loops = str(tmp_path / "loops")
    fonts = str(tmp_path / "fonts")
    assert run(installed, MEDIANS, NUMBA_CACHE_DIR=loops, MPLCONFIGDIR=fonts).split() == [
        loops,
        fonts,
    ]


def test_without_any_place_a_private_temporary_folder_is_used(installed: Path, tmp_path: Path):
    temporary = tmp_path / "temporary"
    temporary.mkdir()
    loops, fonts = map(Path, run(installed, MEDIANS, TMPDIR=str(temporary)).split())
    assert loops == fonts and loops.parent == temporary
    assert stat.S_IMODE(loops.stat().st_mode) == 0o700
    # somebody else has taken the name: nothing is loaded from there
    loops.chmod(0o777)
    other = Path(run(installed, MEDIANS, TMPDIR=str(temporary)).split()[0])
    assert other.parent == temporary and other != loops


def test_places_of_their_own_are_left_to_them(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    for variable in (writable_caches.NUMBA, writable_caches.MATPLOTLIB):
        monkeypatch.delenv(variable, raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))
    writable_caches.use_writable_caches()
    assert not {writable_caches.NUMBA, writable_caches.MATPLOTLIB} & set(os.environ)


@pytest.mark.slow
def test_a_read_only_installation_inspects_a_capture(installed: Path, tmp_path: Path):
    capture = plane.write_open3d_folder(tmp_path / "capture", 8, 1.0)
    stated = tmp_path / "loops"
    code = "from harness.__main__ import main; sys.exit(main(sys.argv[1:]))"
    words = (code, "detect", str(capture), "--detector", "matched", "--out", str(tmp_path / "out"))
    for _ in range(2):
        shutil.rmtree(tmp_path / "out", ignore_errors=True)
        found = run(installed, *words, NUMBA_CACHE_DIR=str(stated), TMPDIR=str(tmp_path))
        assert found.startswith("One hole found")
    assert any(stated.rglob("*.nbc"))
