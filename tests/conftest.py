"""Fixtures shared by all tests."""

from __future__ import annotations

import gc
import os
from collections.abc import Callable, Generator
from contextlib import suppress
from importlib import import_module
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]


def pytest_configure(config: pytest.Config) -> None:
    """Mitsuba starts before any test imports Open3D, whose C++ library LLVM cannot use
    (`scenes.render.scene`); not in the process that only hands out tests, which should import
    nothing of tofpod. Nothing that imports and collection create is garbage: looking for some
    would take a fifth of their time."""
    gc.disable()
    if "PYTEST_XDIST_WORKER" in os.environ or config.getoption("dist", "no") == "no":
        from scenes.render.scene import load_mitsuba

        load_mitsuba()
    worker = getattr(config, "workerinput", None)
    if worker and [Path(path).resolve() for path in config.args] == [Path(__file__).parent]:
        _share_compilation(int(worker["workerid"].removeprefix("gw")), worker["workercount"])


def _share_compilation(number: int, count: int) -> None:
    """Import all test files, each process from another one on: it finds compiled what the others
    had before it."""
    files = sorted(Path(__file__).parent.rglob("test_*.py"))
    first = len(files) * number // count
    for file in (*files[first:], *files[:first]):
        with suppress(Exception, pytest.skip.Exception):  # the collection reports it
            import_module(".".join(file.relative_to(ROOT).with_suffix("").parts))


LONGEST = (
    *(
        "engine_cluster",
        "engine",
        "detect_program",
        "detect_views",
        "engine_learning",
        "study_page",
        "pod_program",
    ),
    *(
        "compare",
        "experiment_files",
        "third_party_package",
        "gauge",
        "engine_maps",
        "claim_views",
        "reference",
        "peers",
    ),
)
"""Files of tests of 20 processor seconds and more: processes that begin with these end at about
the same time."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Let the longest files come first (pytest-xdist hands files out in this order)."""
    items.sort(key=lambda item: item.path.stem.removeprefix("test_") not in LONGEST)


def pytest_collection_finish() -> None:
    """Exclude what imports and collection have created from garbage collection, which saves 2 % of
    processor time."""
    gc.enable()
    gc.collect()
    gc.freeze()


@pytest.hookimpl(wrapper=True)
def pytest_pyfunc_call() -> Generator[None, object, object]:
    """A test that needs Open3D skips, and says which package is missing, where the system lacks a
    library of it."""
    from detectors.open3d_library import MissingLibrary

    try:
        return (yield)
    except MissingLibrary as missing:
        pytest.skip(str(missing))


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder of real captures beside the checkout; tests that need it skip where it is absent."""
    folder = Path(__file__).resolve().parents[2] / "shared" / "data"
    if not folder.is_dir():
        pytest.skip("no folder of real captures beside the checkout")
    return folder


def made_once(factory: pytest.TempPathFactory, name: str, make: Callable[[Path], object]) -> Path:
    """A folder of the session that the first process to need it makes; the other processes of the
    session wait."""
    base = factory.getbasetemp()
    home = (base.parent if "PYTEST_XDIST_WORKER" in os.environ else base) / f"shared-{name}"
    home.mkdir(exist_ok=True)
    from harness.vocabulary import system

    with (home / "lock").open("ab") as lock:
        system.lock(lock, shared=False, wait=True)
        if not (home / "made").exists():
            make(home)
            (home / "made").touch()
    return home


@pytest.fixture
def control_detectors(monkeypatch: pytest.MonkeyPatch) -> None:
    """The detectors ``oracle`` and ``blind``, which test the harness, by their names."""
    from detectors import BUILT_IN

    monkeypatch.setitem(BUILT_IN, "oracle", "tests.support.control_detectors:Oracle")
    monkeypatch.setitem(BUILT_IN, "blind", "tests.support.control_detectors:BlindDetector")


@pytest.fixture
def unpictured(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of the files that a detection writes the pictures take longest: left empty by tests that
    look at the others."""
    monkeypatch.setattr("harness.report.findings._figure", lambda *_: None)
    monkeypatch.setattr("harness.report.findings._save", lambda path, _: path.write_bytes(b""))


@pytest.fixture
def unsaved(monkeypatch: pytest.MonkeyPatch) -> None:
    """Figures are drawn but not written, which is most of a page's time, for tests that look at
    the words about them; ``monkeypatch.undo()`` in one that looks at figures too."""

    def save(_figure: object, target: object, **_how: object) -> None:
        target.write_bytes(b"") if isinstance(target, Path) else target.write("<svg></svg>")  # type: ignore[attr-defined]

    monkeypatch.setattr("matplotlib.figure.Figure.savefig", save)
    monkeypatch.setattr("harness.report.blocks._lay_out", lambda _figure: None)


@pytest.fixture(scope="session")
def tiny_out(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished sweep before the thesis' target, by worker processes, with tiny.yaml beside it;
    not to be changed."""
    from tests.support.tiny_sweep import TINY, finished

    return (
        made_once(tmp_path_factory, "sweep", lambda home: finished(home, TINY, "--jobs", "1"))
        / "out"
    )


@pytest.fixture(scope="session")
def study_out(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished study of random boards, by one process, likewise."""
    from tests.support.tiny_sweep import STUDY, finished

    return (
        made_once(tmp_path_factory, "study", lambda home: finished(home, STUDY, "--serial")) / "out"
    )


@pytest.fixture(scope="session")
def dataset_home(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a finished data set of ten boards, ``set``; not to be changed."""
    from tests.support.tiny_dataset import write

    def make(home: Path) -> None:
        assert write(home, "set") == 0

    return made_once(tmp_path_factory, "dataset", make)
