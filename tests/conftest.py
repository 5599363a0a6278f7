"""Fixtures shared by all tests."""

from __future__ import annotations

from collections.abc import Generator
from pathlib import Path

import pytest

from detectors.open3d_library import MissingLibrary
from scenes.render.scene import load_mitsuba


def pytest_configure() -> None:
    """Mitsuba starts before any test imports Open3D, whose C++ library LLVM cannot use (`scenes.render.scene`)."""
    load_mitsuba()


@pytest.hookimpl(wrapper=True)
def pytest_pyfunc_call() -> Generator[None, object, object]:
    """A test that needs Open3D skips, and says which package is missing, where the system lacks a library of it."""
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


@pytest.fixture(scope="session")
def tiny_out(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished sweep before the thesis' target, with tiny.yaml beside the folder; not to be changed."""
    from tiny_sweep import TINY, finished

    return finished(tmp_path_factory.mktemp("sweep"), TINY)


@pytest.fixture(scope="session")
def study_out(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished study of random boards, likewise."""
    from tiny_sweep import STUDY, finished

    return finished(tmp_path_factory.mktemp("study"), STUDY)


@pytest.fixture(scope="session")
def dataset_home(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a finished data set of ten boards, ``set``; not to be changed."""
    from tiny_dataset import write

    home = tmp_path_factory.mktemp("dataset")
    assert write(home, "set") == 0
    return home
