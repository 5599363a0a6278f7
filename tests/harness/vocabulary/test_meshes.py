"""Meshes from files that are damaged, or whose triangles have no corners."""

from __future__ import annotations

import struct
from pathlib import Path

import pytest
import trimesh

from harness.vocabulary.errors import UserError
from harness.vocabulary.meshes import read_mesh

BOX = trimesh.creation.box((0.2, 0.1, 0.05))


def test_a_box_is_read_from_every_format(tmp_path: Path):
    for suffix in ("stl", "ply", "obj", "glb"):
        path = tmp_path / f"box.{suffix}"
        BOX.export(path)
        assert len(read_mesh(str(path)).faces) == 12


@pytest.mark.parametrize("number", [8, 1000])
def test_triangles_of_corners_that_do_not_exist_are_refused(tmp_path: Path, number: int):
    path = tmp_path / "box.ply"
    text = BOX.export(file_type="ply", encoding="ascii").decode()
    *lines, last = text.strip().split("\n")
    count, _, *corners = last.split()
    path.write_text("\n".join([*lines, " ".join([count, str(number), *corners])]) + "\n")
    with pytest.raises(UserError, match=r"box\.ply: (is not a readable mesh|its triangles name)"):
        read_mesh(str(path))


def test_corners_without_a_place_are_refused(tmp_path: Path):
    content = bytearray(BOX.export(file_type="stl"))
    content[96:100] = struct.pack("<f", 1e30)  # the first corner's x
    path = tmp_path / "box.stl"
    path.write_bytes(content)
    with pytest.raises(UserError, match="a corner of its triangles is not a place"):
        read_mesh(str(path))


def test_damaged_files_end_in_one_message(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    """The library tries a damaged STL as text, and would print why both attempts failed."""
    content = BOX.export(file_type="stl")
    text = BOX.export(file_type="stl_ascii").encode()
    cases = (
        ("cut.stl", content[:100]),
        ("text.stl", text.replace(b"vertex", b"vertex x", 1)),
        ("empty.ply", b""),
        ("none.obj", b"v 0 0 0\n"),
        ("beyond.obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 9\n"),
        ("cut.glb", BOX.export(file_type="glb")[:50]),
    )
    for name, damaged in cases:
        (tmp_path / name).write_bytes(damaged)
        with pytest.raises(UserError, match=name):
            read_mesh(str(tmp_path / name))
    assert capsys.readouterr().err == ""
