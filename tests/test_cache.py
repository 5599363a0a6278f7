"""Stored renders: nothing damaged or hostile is ever read as a view, and the cache's folder keeps within its limit."""

from __future__ import annotations

import io
import json
import multiprocessing
import os
import random
import subprocess
import sys
import time
import zipfile
from pathlib import Path

import numpy as np
import pytest

from harness.vocabulary.errors import UserError
from harness.vocabulary.geometry import Region
from scenes.closed_form import plane_view
from scenes.render import cache
from scenes.render.cache import (
    ARRAYS,
    alone,
    cached_view,
    damaged_renders,
    in_use,
    leftovers,
    read_view,
    render_key,
    stored_renders,
    stored_view,
    trim_cache,
    view_bytes,
    write_view,
)
from scenes.render.settings import RenderConfig
from scenes.sensor.camera import load_camera
from scenes.target.thesis import ThesisTargetConfig
from scenes.view import NoiseFreeView

ROOT = Path(__file__).resolve().parents[1]
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


def parts_of(path: Path) -> dict[str, bytes]:
    with zipfile.ZipFile(path) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def put_together(path: Path, parts: dict[str, bytes], kind: int = zipfile.ZIP_STORED) -> None:
    with zipfile.ZipFile(path, "w", kind) as archive:
        for name, content in parts.items():
            archive.writestr(name, content)


ABSENT = object()


def with_facts(path: Path, **changed: object) -> None:
    """The same file with other facts, and a checksum that fits them."""
    parts = parts_of(path)
    facts = {**json.loads(parts["facts.json"]), **changed}
    facts = {name: value for name, value in facts.items() if value is not ABSENT}
    facts.pop("checksum")
    arrays = {name: np.load(io.BytesIO(parts[f"{name}.npy"])) for name in ARRAYS}
    parts["facts.json"] = json.dumps({**facts, "checksum": cache._checksum(facts, arrays)}).encode()
    put_together(path, parts)


# ---------------------------------------------------------------- one file


def test_a_view_comes_back_bit_by_bit_and_can_be_written_to(stored, view):
    found = read_view(stored)
    assert found is not None and equal(found, view)
    assert all(getattr(found, name).flags.writeable and getattr(found, name).flags.c_contiguous for name in ARRAYS)


def test_the_same_view_gives_the_same_bytes_and_about_the_size_foretold(stored, view, tmp_path):
    again = tmp_path / "again.npz"
    write_view(again, view)
    assert again.read_bytes() == stored.read_bytes()
    # a closed form has its surfaces, coverage and colour in larger types than a render
    large = Region(100, 300, 100, 400)
    rendered = plane_view(CAMERA, large, 0.8, 0.5)
    small = {"surface": np.int16, "coverage": np.float32, "rgb": np.float32}
    types = {name: getattr(rendered, name).astype(small.get(name, getattr(rendered, name).dtype)) for name in ARRAYS}
    types |= {name: types[name].astype(np.complex64) for name in ("phasor", "phasor_direct")}
    write_view(again, NoiseFreeView(**{**rendered.__dict__, **types}))
    assert again.stat().st_size == pytest.approx(view_bytes(large, 3), rel=0.01)


def test_flipped_bits_are_found_wherever_they_are(stored, view):
    whole = stored.read_bytes()
    rng = random.Random(1)
    # every byte of the facts and of the archive's own directory, and places anywhere
    directory = whole.rindex(b"PK\x01\x02", 0, len(whole))
    places = [*range(0, 900), *range(directory - 100, len(whole)), *(rng.randrange(len(whole)) for _ in range(400))]
    noticed = 0
    for place in places:
        spoilt = bytearray(whole)
        spoilt[place] ^= 1 << rng.randrange(8)
        stored.write_bytes(bytes(spoilt))
        found = stored_view(stored)
        noticed += found is None
        # a bit that means nothing, such as one of a date, may be passed over; a wrong view may not come out
        assert found is None or equal(found, view), place
    assert noticed > 0.8 * len(places)


@pytest.mark.parametrize("share", [0.0, 0.001, 0.3, 0.9, 0.999])
def test_truncated_files_are_absent(stored, share):
    whole = stored.read_bytes()
    stored.write_bytes(whole[: int(share * len(whole))])
    assert read_view(stored) is None


def test_a_file_that_states_no_version_is_absent(stored):
    parts = parts_of(stored)
    facts = json.loads(parts["facts.json"])
    del facts["version"]
    put_together(stored, {**parts, "facts.json": json.dumps(facts).encode()})
    assert stored_view(stored) is None


def test_a_file_of_another_version_is_absent(stored):
    with_facts(stored)
    assert read_view(stored) is not None
    for version in (0, 2, None, "1"):
        with_facts(stored, version=version)
        assert read_view(stored) is None, version


@pytest.mark.parametrize(
    "changed",
    [
        {"region": {"row0": 0, "row1": 25, "col0": 0, "col1": 32}},
        {"region": {"row0": 0, "row1": 10**9, "col0": 0, "col1": 10**9}},
        {"region": {"row0": 0, "row1": -24, "col0": 0, "col1": -32}},
        {"region": {"row0": 0.0, "row1": 24.0, "col0": 0, "col1": 32}},
        {"region": None},
        {"version": ABSENT},
        {"seconds": ABSENT},
        {"surface_names": ABSENT},
        {"frequencies_hz": [1e8] * 4},
        {"frequencies_hz": 3},
        {"types": {}},
        {"types": dict.fromkeys(ARRAYS, "|O")},
        {"types": dict.fromkeys(ARRAYS, "<f8")},
        {"types": [["<f8"]]},
    ],
)
def test_facts_that_do_not_fit_the_arrays_are_refused(stored, changed):
    with_facts(stored, **changed)
    assert read_view(stored) is None


@pytest.mark.parametrize("facts", [b"", b"[]", b"null", b"{}", b"\xff\xfe", b"[" * 100_000, b" " * (2 << 20) + b"{}"])
def test_facts_that_are_none(stored, facts):
    put_together(stored, {**parts_of(stored), "facts.json": facts})
    assert read_view(stored) is None


def test_nothing_is_decompressed(stored, monkeypatch):
    """A part of a kilobyte that would be a gigabyte is refused by what the archive says of it."""
    parts = parts_of(stored)
    put_together(stored, parts, zipfile.ZIP_DEFLATED)
    assert read_view(stored) is None
    bomb = {**parts, "phasor.npy": b"\x00" * (64 << 20)}
    put_together(stored, bomb, zipfile.ZIP_DEFLATED)
    assert stored.stat().st_size < 1 << 20
    monkeypatch.setattr(zipfile.ZipFile, "read", lambda *_: pytest.fail("was read"))
    assert read_view(stored) is None


def test_a_part_that_claims_ten_gigabytes_takes_no_memory(stored):
    """The archive's directory and the facts agree on a size that is not there; the process has a gigabyte."""
    side = 40_000
    facts = {
        **json.loads(parts_of(stored)["facts.json"]),
        "region": {"row0": 0, "row1": side, "col0": 0, "col1": side},
    }
    put_together(stored, {**parts_of(stored), "facts.json": json.dumps(facts).encode()})
    for name in ARRAYS:
        types = facts["types"][name]
        lengths = {"f": 3, "h": side, "w": side, "2": 2, "3": 3}
        shape = tuple(lengths[axis] for axis in cache.AXES.get(name, "hw"))
        size = len(cache._header(np.dtype(types), shape)) + int(np.prod(shape)) * np.dtype(types).itemsize
        _claim(stored, f"{name}.npy", size)
    code = (
        "import resource, sys; from pathlib import Path; from scenes.render.cache import read_view\n"
        "used = int(open('/proc/self/statm').read().split()[0]) * resource.getpagesize()\n"
        "resource.setrlimit(resource.RLIMIT_AS, (used + (1 << 30),) * 2)\n"
        f"assert read_view(Path({str(stored)!r})) is None\n"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, timeout=900)
    assert done.returncode == 0, done.stderr


def _claim(path: Path, name: str, size: int) -> None:
    """Write a size of 4 GB less one (the most without an extension) or less into the directory's entry of a part."""
    content = bytearray(path.read_bytes())
    at = content.index(b"PK\x01\x02")
    while True:
        length = int.from_bytes(content[at + 28 : at + 30], "little")
        if content[at + 46 : at + 46 + length] == name.encode():
            break
        at = content.index(b"PK\x01\x02", at + 4)
    told = min(size, 0xFFFFFFFE).to_bytes(4, "little")
    content[at + 20 : at + 28] = told + told
    path.write_bytes(bytes(content))


def test_an_object_array_is_not_unpickled(stored, tmp_path):
    class Hostile:
        def __reduce__(self):
            return (Path.touch, (tmp_path / "was here",))

    content = io.BytesIO()
    np.save(content, np.array([[Hostile()]], dtype=object), allow_pickle=True)
    put_together(stored, {**parts_of(stored), "rgb.npy": content.getvalue()})
    assert read_view(stored) is None
    assert not (tmp_path / "was here").exists()


def test_folders_links_and_pipes_under_a_renders_name(stored, view, tmp_path):
    name = tmp_path / f"{'1' * 16}.npz"
    name.mkdir()
    assert read_view(name) is None
    with pytest.raises(UserError, match="cannot be written"):
        write_view(name, view)
    name.rmdir()
    name.symlink_to(tmp_path / "nowhere")
    assert read_view(name) is None
    # a link is replaced, and what it points at is left alone
    other = tmp_path / "other.txt"
    other.write_text("mine")
    name.unlink()
    name.symlink_to(other)
    assert read_view(name) is None
    write_view(name, view)
    assert not name.is_symlink() and read_view(name) is not None and other.read_text() == "mine"
    name.unlink()
    os.mkfifo(name)
    assert read_view(name) is None


def test_a_damaged_render_is_rendered_again_and_a_found_one_is_not(tmp_path, view, monkeypatch):
    target, config, rendered = ThesisTargetConfig().declare(), RenderConfig(), []
    monkeypatch.setattr(cache, "build_target", lambda target: target)
    monkeypatch.setattr(cache, "render_view", lambda *_: rendered.append(1) or view)
    path = tmp_path / f"{render_key(target, CAMERA.optics, config)}.npz"
    assert cached_view(target, CAMERA.optics, config, tmp_path)[1] is False
    assert cached_view(target, CAMERA.optics, config, tmp_path)[1] is True
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 4
    path.write_bytes(bytes(content))
    found, was_there = cached_view(target, CAMERA.optics, config, tmp_path)
    assert not was_there and equal(found, view) and len(rendered) == 2
    assert cached_view(target, CAMERA.optics, config, tmp_path)[1] is True


def _write_often(path: str, times: int) -> None:
    view = plane_view(CAMERA, REGION, 0.8, 0.5, 0.1)
    for _ in range(times):
        write_view(Path(path), view)


def test_two_processes_that_write_the_same_render_at_once(stored, view):
    context = multiprocessing.get_context("spawn")
    writers = [context.Process(target=_write_often, args=(str(stored), 40)) for _ in range(2)]
    for writer in writers:
        writer.start()
    reads = 0
    while any(writer.is_alive() for writer in writers):
        found = read_view(stored)
        assert found is not None and equal(found, view)
        reads += 1
    assert [writer.exitcode for writer in writers] == [0, 0] and reads > 10
    assert [path.name for path in stored.parent.iterdir()] == [stored.name]


# ---------------------------------------------------------------- the folder


def shelf(folder: Path, view: NoiseFreeView, ages_days: dict[str, float]) -> dict[str, Path]:
    """Renders named by a letter, last used so many days ago."""
    paths = {letter: folder / f"{letter * 16}.npz" for letter in ages_days}
    for letter, path in paths.items():
        write_view(path, view)
        used_s = time.time() - ages_days[letter] * DAY_S
        os.utime(path, (used_s, used_s))
    return paths


def test_the_longest_unused_go_first_and_those_to_keep_never(tmp_path, view):
    paths = shelf(tmp_path, view, {"a": 3, "b": 9, "c": 1, "d": 5})
    size = paths["a"].stat().st_size
    assert [one.path for one in stored_renders(tmp_path)] == [paths[k] for k in "bdac"]
    done = trim_cache(tmp_path, 3 * size, keep={paths["b"]})
    assert (done.renders, done.freed_bytes, done.left, done.left_bytes) == (1, size, 3, 3 * size)
    assert {k for k in paths if paths[k].exists()} == set("abc")
    read_view(paths["a"])  # now the latest
    trim_cache(tmp_path, size)
    assert {k for k in paths if paths[k].exists()} == {"a"}
    assert trim_cache(tmp_path, 0, keep=[paths["a"]]).left == 1
    assert trim_cache(tmp_path, size).renders == 0


def test_a_render_that_cannot_be_touched_is_read_all_the_same(stored, monkeypatch):
    monkeypatch.setattr(os, "utime", lambda *_: (_ for _ in ()).throw(PermissionError()))
    assert read_view(stored) is not None


def test_nothing_but_renders_and_old_leftovers_is_removed(tmp_path, view):
    paths = shelf(tmp_path, view, {"a": 3})
    outside = tmp_path.parent / "outside.npz"
    write_view(outside, view)
    linked = tmp_path / f"{'b' * 16}.npz"
    linked.symlink_to(outside)
    others = [tmp_path / name for name in ("notes.npz", "rates.json", f"{'c' * 16}.npy", f"{'D' * 16}.npz")]
    old, new = (tmp_path / f".{letter * 16}.x1_y2zab.part.npz" for letter in "ef")
    for path in (*others, old, new):
        path.write_bytes(b"x")
    os.utime(old, (time.time() - 2 * DAY_S,) * 2)
    assert [one.path for one in leftovers(tmp_path)] == [old]
    done = trim_cache(tmp_path, 0)
    assert (done.renders, done.leftovers) == (1, 1)
    assert not paths["a"].exists() and not old.exists()
    assert new.exists() and linked.is_symlink() and outside.exists() and all(path.exists() for path in others)


def test_renders_in_use_by_a_sweep_stay(tmp_path, view):
    paths = shelf(tmp_path, view, {"a": 3})
    with in_use(tmp_path), in_use(tmp_path):  # two sweeps may share a cache
        assert trim_cache(tmp_path, 0).left == 1
        with pytest.raises(UserError, match="a sweep that is running"), alone(tmp_path):
            pass
    assert paths["a"].exists()
    assert trim_cache(tmp_path, 0).renders == 1


def test_no_folder_and_damaged_renders(tmp_path, view):
    assert stored_renders(tmp_path / "none") == [] and leftovers(tmp_path / "none") == []
    assert trim_cache(tmp_path / "none", 0).left == 0
    paths = shelf(tmp_path, view, {"a": 1, "b": 2})
    paths["b"].write_bytes(paths["b"].read_bytes()[:-100])
    before_s = paths["a"].stat().st_mtime
    assert [one.path for one in damaged_renders(stored_renders(tmp_path))] == [paths["b"]]
    assert paths["a"].stat().st_mtime == before_s  # to look is not to use
