"""Stored renders: nothing damaged or hostile is ever read as a view, and the cache's folder keeps
within its limit."""

from __future__ import annotations

import io
import os
import random
import time
import zlib
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest

from harness.vocabulary.errors import UserError
from harness.vocabulary.geometry import Region
from scenes.closed_form import plane_view
from scenes.optics import NoiseFreeView, RenderConfig
from scenes.render import cache
from scenes.render.cache import (
    ARRAYS,
    alone,
    cached_view,
    in_use,
    leftovers,
    read_view,
    render_key,
    stored_renders,
    trim_cache,
    write_view,
)
from scenes.sensor.camera import load_camera
from scenes.target.thesis import ThesisTargetConfig

CAMERA = load_camera("azure_kinect_nfov")
REGION = Region(200, 224, 300, 332)
DAY_S = 86_400.0


@pytest.fixture(scope="module")
def view() -> NoiseFreeView:
    return plane_view(CAMERA, REGION, 0.8, 0.5, 0.1)


@pytest.fixture
def stored(tmp_path: Path, view: NoiseFreeView) -> Path:
    path = tmp_path / f"{'0' * 16}.npz"
    write_view(path, view)
    return path


def equal(a: NoiseFreeView, b: NoiseFreeView) -> bool:
    same = (a.region, a.frequencies_hz, a.surface_names, a.seconds, a.variant) == (
        b.region,
        b.frequencies_hz,
        b.surface_names,
        b.seconds,
        b.variant,
    )
    return same and all(
        getattr(a, name).dtype == getattr(b, name).dtype
        and np.array_equal(getattr(a, name), getattr(b, name), equal_nan=True)
        for name in ARRAYS
    )


def sealed(path: Path, content: bytes) -> None:
    """Write a content with a checksum that fits it."""
    path.write_bytes(content + zlib.crc32(content).to_bytes(cache.CHECKSUM_BYTES, "little"))


# ---------------------------------------------------------------- one file


def test_a_view_comes_back_bit_by_bit_and_can_be_written_to(stored, view):
    read = read_view(stored)
    assert read is not None and equal(read, view)
    assert all(
        getattr(read, name).flags.writeable and getattr(read, name).flags.c_contiguous
        for name in ARRAYS
    )


def test_the_same_view_gives_the_same_bytes(
    stored,
    view,
    tmp_path,
):
    again = tmp_path / "again.npz"
    write_view(again, view)
    assert again.read_bytes() == stored.read_bytes()


def test_flipped_bits_are_found_wherever_they_are(stored, view):
    content = stored.read_bytes()
    rng = random.Random(1)
    for position in (0, len(content) - 1, *(rng.randrange(len(content)) for _ in range(60))):
        spoilt = bytearray(content)
        spoilt[position] ^= 1 << rng.randrange(8)
        stored.write_bytes(bytes(spoilt))
        assert read_view(stored) is None, position


@pytest.mark.parametrize("share", [0.0, 0.001, 0.3, 0.9, 0.999])
def test_truncated_files_are_absent(stored, share):
    content = stored.read_bytes()
    stored.write_bytes(content[: int(share * len(content))])
    assert read_view(stored) is None


def test_a_file_of_another_version_is_absent(
    stored,
    view,
    monkeypatch,
):
    monkeypatch.setattr(cache, "VIEW_VERSION", cache.VIEW_VERSION + 1)
    write_view(stored, view)
    assert read_view(stored) is not None
    monkeypatch.undo()
    assert read_view(stored) is None


@pytest.mark.parametrize("content", [b"", b"x" * 1000, b"PK\x05\x06" + bytes(18)])
def test_what_is_no_view_is_absent_whatever_its_checksum(stored, content):
    sealed(stored, content)
    assert read_view(stored) is None


def test_an_object_array_is_not_unpickled(stored, tmp_path):
    class Hostile:
        def __reduce__(self):
            return (Path.touch, (tmp_path / "was here",))

    content = io.BytesIO()
    parts = {
        "facts": np.array("{}"),
        **dict.fromkeys(ARRAYS, np.array([[Hostile()]], dtype=object)),
    }
    np.savez(content, allow_pickle=True, **parts)
    sealed(stored, content.getvalue())
    assert read_view(stored) is None
    assert not (tmp_path / "was here").exists()


def test_a_file_larger_than_any_render_is_not_read(stored):
    with stored.open("r+b") as file:
        file.truncate(cache.MOST_BYTES + 1)  # takes no room on the disk
    assert read_view(stored) is None


def test_folders_links_and_pipes_under_a_renders_name(
    stored,
    view,
    tmp_path,
):
    name = tmp_path / f"{'1' * 16}.npz"
    name.mkdir()
    assert read_view(name) is None
    with pytest.raises(UserError, match="cannot be written"):
        write_view(name, view)
    name.rmdir()
    name.symlink_to(tmp_path / "nowhere")
    assert read_view(name) is None
    # a link is replaced, and what it points at is left alone
    text_file = tmp_path / "other.txt"
    text_file.write_text("mine")
    name.unlink()
    name.symlink_to(text_file)
    assert read_view(name) is None
    write_view(name, view)
    assert not name.is_symlink() and read_view(name) is not None and text_file.read_text() == "mine"
    name.unlink()
    os.mkfifo(name)
    assert read_view(name) is None


def test_a_damaged_render_is_rendered_again_and_a_found_one_is_not(
    tmp_path,
    view,
    monkeypatch,
):
    target = ThesisTargetConfig().declare()
    config = RenderConfig()
    rendered = []
    monkeypatch.setattr("scenes.target.mesh.build_target", lambda target: target)
    monkeypatch.setattr("scenes.render.view.render_view", lambda *_: rendered.append(1) or view)
    path = tmp_path / f"{render_key(target, CAMERA.optics, config)}.npz"
    assert cached_view(target, CAMERA.optics, config, tmp_path)[1] is False
    assert cached_view(target, CAMERA.optics, config, tmp_path)[1] is True
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 4
    path.write_bytes(bytes(content))
    read, was_there = cached_view(target, CAMERA.optics, config, tmp_path)
    assert not was_there and equal(read, view) and len(rendered) == 2
    assert cached_view(target, CAMERA.optics, config, tmp_path)[1] is True


def test_a_render_is_read_whole_while_two_write_it(stored, view):
    with ThreadPoolExecutor(2) as pool:
        writes = [
            pool.submit(lambda: [write_view(stored, view) for _ in range(10)]) for _ in range(2)
        ]
        while not all(write.done() for write in writes):
            read = read_view(stored)
            assert read is not None and equal(read, view)
    assert [write.exception() for write in writes] == [None, None]
    assert [path.name for path in stored.parent.iterdir()] == [stored.name]


# ---------------------------------------------------------------- the folder


def shelf(
    folder: Path,
    view: NoiseFreeView,
    ages_days: dict[str, float],
) -> dict[str, Path]:
    """Renders named by a letter, last used so many days ago."""
    paths = {letter: folder / f"{letter * 16}.npz" for letter in ages_days}
    for letter, path in paths.items():
        write_view(path, view)
        used_s = time.time() - ages_days[letter] * DAY_S
        os.utime(path, (used_s, used_s))
    return paths


def test_the_longest_unused_go_first_and_those_to_keep_never(tmp_path, view):
    paths = shelf(
        tmp_path,
        view,
        {
            "a": 3,
            "b": 9,
            "c": 1,
            "d": 5,
        },
    )
    size = paths["a"].stat().st_size
    assert [file.path for file in stored_renders(tmp_path)] == [paths[k] for k in "bdac"]
    assert trim_cache(tmp_path, 3 * size, keep={paths["b"]}) == 3
    assert {k for k in paths if paths[k].exists()} == set("abc")
    read_view(paths["a"])  # now the latest
    trim_cache(tmp_path, size)
    assert {k for k in paths if paths[k].exists()} == {"a"}
    assert trim_cache(tmp_path, 0, keep=[paths["a"]]) == 1
    assert trim_cache(tmp_path, size) == 1


def test_a_render_that_cannot_be_touched_is_read_all_the_same(stored, monkeypatch):
    monkeypatch.setattr(os, "utime", lambda *_: (_ for _ in ()).throw(PermissionError()))
    assert read_view(stored) is not None


def test_nothing_but_renders_and_old_leftovers_is_removed(tmp_path, view):
    paths = shelf(tmp_path, view, {"a": 3})
    outside = tmp_path.parent / "outside.npz"
    write_view(outside, view)
    linked = tmp_path / f"{'b' * 16}.npz"
    linked.symlink_to(outside)
    foreign = [
        tmp_path / name
        for name in ("notes.npz", "rates.json", f"{'c' * 16}.npy", f"{'D' * 16}.npz")
    ]
    old = tmp_path / f".{'e' * 16}.x1_y2zab.part.npz"
    new = tmp_path / f".{'f' * 16}.x1_y2zab.part.npz"
    for path in (*foreign, old, new):
        path.write_bytes(b"x")
    os.utime(old, (time.time() - 2 * DAY_S,) * 2)
    assert [file.path for file in leftovers(tmp_path)] == [old]
    assert trim_cache(tmp_path, 0) == 0
    assert not paths["a"].exists() and not old.exists()
    assert (
        new.exists()
        and linked.is_symlink()
        and outside.exists()
        and all(path.exists() for path in foreign)
    )


def test_renders_in_use_by_a_sweep_stay(tmp_path, view):
    paths = shelf(tmp_path, view, {"a": 3})
    with in_use(tmp_path), in_use(tmp_path):  # two sweeps may share a cache
        assert trim_cache(tmp_path, 0) == 1
        with pytest.raises(UserError, match="a sweep that is running"), alone(tmp_path):
            pass
    assert paths["a"].exists()
    assert trim_cache(tmp_path, 0) == 0


def test_no_folder(tmp_path):
    assert stored_renders(tmp_path / "none") == [] and leftovers(tmp_path / "none") == []
    assert trim_cache(tmp_path / "none", 0) == 0
