"""The program `tofpod target` and the files that it writes."""

from __future__ import annotations

import io
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import trimesh

from harness.target import main
from harness.vocabulary.errors import UserError
from harness.vocabulary.provenance import RESULTS_VERSION
from scenes.target.mesh import Target, _srgb_bytes, build_target, write_mesh, write_truth
from scenes.target.thesis import ThesisTargetConfig
from tests.support.declared_targets import target_from_data


@pytest.fixture(scope="module")
def thesis() -> Target:
    return build_target(ThesisTargetConfig().declare())


def test_thesis_from_the_command_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    mesh = tmp_path / "new" / "board.glb"
    truth = tmp_path / "new" / "truth.json"
    assert main(["thesis", "--out", str(mesh), "--truth", str(truth)]) == 0
    printed = capsys.readouterr().out
    assert "25.400" in printed
    assert "tape_4" in printed
    assert f"wrote {mesh}" in printed
    data = json.loads(truth.read_text())
    assert data["results_version"] == RESULTS_VERSION
    assert [row["id"] for row in data["damages"]] == list(range(1, 12))
    assert target_from_data(data["target"]) == ThesisTargetConfig().declare()
    assert sorted(path.name for path in mesh.parent.iterdir()) == ["board.glb", "truth.json"]


def test_glb_holds_each_part_upright(thesis: Target, tmp_path: Path) -> None:
    write_mesh(thesis, tmp_path / "board.glb")
    scene = trimesh.load_scene(tmp_path / "board.glb")
    assert set(scene.geometry) == {part.name for part in thesis.parts}
    for part in thesis.parts:
        transform, _ = scene.graph[part.name]
        loaded = scene.geometry[part.name].copy().apply_transform(transform)
        turned = part.mesh.vertices * (1, -1, -1)
        assert loaded.bounds == pytest.approx(
            np.array([turned.min(axis=0), turned.max(axis=0)]), abs=1e-6
        )


def test_glb_grain_lies_where_the_renderer_sees_it(thesis: Target, tmp_path: Path) -> None:
    """The image of the GLB at the file's own co-ordinates is the texture at the part's."""
    write_mesh(thesis, tmp_path / "board.glb")
    board = trimesh.load_scene(tmp_path / "board.glb").geometry["board"]
    part = thesis.parts[0]
    image = np.asarray(board.visual.material.baseColorTexture.convert("RGB"))
    assert part.texture_rgb is not None
    assert part.uv is not None
    assert np.array_equal(image, _srgb_bytes(part.texture_rgb))
    assert board.visual.uv[:, 0] == pytest.approx(part.uv[:, 0], abs=1e-6)
    assert 1 - board.visual.uv[:, 1] == pytest.approx(part.uv[:, 1], abs=1e-6)


def test_ply_is_in_the_camera_frame(thesis: Target, tmp_path: Path) -> None:
    write_mesh(thesis, tmp_path / "board.ply")
    loaded = trimesh.load_mesh(
        io.BytesIO((tmp_path / "board.ply").read_bytes()), file_type="ply", process=False
    )
    expected = np.concatenate([part.mesh.vertices for part in thesis.parts])
    assert loaded.vertices == pytest.approx(expected, abs=1e-6)
    assert len(loaded.faces) == sum(len(part.mesh.faces) for part in thesis.parts)
    first_of_tape = len(thesis.parts[0].mesh.vertices)
    assert list(loaded.visual.vertex_colors[first_of_tape][:3]) == list(
        _srgb_bytes(thesis.parts[1].rgb)
    )


def test_srgb_code() -> None:
    assert list(_srgb_bytes(np.array([0.0, 0.001, 0.2158605, 1.0]))) == [0, 3, 128, 255]


def test_other_suffix_is_refused_and_nothing_written(thesis: Target, tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"no mesh format is called '\.stl'"):
        write_mesh(thesis, tmp_path / "board.stl")
    assert list(tmp_path.iterdir()) == []


def test_unwritable_folder(thesis: Target, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(UserError, match="cannot be written"):
        write_truth(thesis, tmp_path / "file" / "truth.json")


def test_hole_free(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["thesis", "--hole-free"]) == 0
    assert "no damage" in capsys.readouterr().out


DECLARATION = """
name: custom
board: {width_mm: 300, height_mm: 200, thickness_mm: 12}
holes:
  - {id: 1, diameter_mm: 10, centre_mm: [0, 0]}
"""


@pytest.mark.parametrize("suffix", [".yaml", ".json"])
def test_a_declaration_from_a_file(
    suffix: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / f"board{suffix}"
    if suffix == ".json":
        board = {"width_mm": 300, "height_mm": 200, "thickness_mm": 12}
        hole = {"id": 1, "diameter_mm": 10, "centre_mm": [0, 0]}
        path.write_text(
            json.dumps({"name": "custom", "board": board, "holes": [hole]}, indent="\t")
        )
    else:
        path.write_text(DECLARATION)
    assert main([str(path)]) == 0
    assert f"{np.pi * 25 * 12:.3f}" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            DECLARATION.replace("width_mm", "widht_mm"),
            "board.yaml:3:9: unknown key `widht_mm` in `board`",
        ),
        (
            DECLARATION.replace("10,", "true,"),
            "`holes.0.diameter_mm` is true: it should be a valid number",
        ),
        (
            DECLARATION.replace("[0, 0]", "[0, .inf]"),
            "`holes.0.centre_mm.1` is .inf: it should be a finite number",
        ),
        (DECLARATION.replace("name: ", "name: [a] #"), "`name` is"),
        (DECLARATION.replace("id: 1, ", ""), "`holes.0` lacks the key `id`"),
        (DECLARATION + "name: thesis\n", "board.yaml:6:1: "),
        (DECLARATION.replace("name: custom", "name: [custom"), "board.yaml:"),
        (
            DECLARATION.replace("custom", "costum"),
            "did you mean: custom",
        ),
        (DECLARATION.replace("300", "2020-01-01"), '`board.width_mm` is "2020-01-01"'),
        (
            DECLARATION.replace("[0, 0]", "[149, 0]"),
            "hole 1 (diameter 10 mm at (149, 0) mm): leaves the board",
        ),
        ("", "board.yaml:1:1: the file is empty"),
        ("- 1\n", "board.yaml:1:1: the file does not hold a mapping"),
    ],
)
def test_a_bad_declaration_is_one_message(
    text: str, message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "board.yaml"
    path.write_text(text)
    assert main([str(path), "--out", str(tmp_path / "board.glb")]) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert message in captured.err
    assert not (tmp_path / "board.glb").exists()


def test_no_such_file(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["tesis"]) == 2
    assert "tesis: there is no such file or named target" in capsys.readouterr().err


def test_binary_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "board.yaml"
    path.write_bytes(b"\xff\xfe\x00\x01")
    assert main([str(path)]) == 2
    assert "is not UTF-8" in capsys.readouterr().err


def test_help_loads_nothing_heavy() -> None:
    code = (
        "import sys, harness.target\n"
        "try: harness.target.main(['--help'])\n"
        "except SystemExit as end: assert end.code == 0\n"
        "assert not {'numpy', 'trimesh', 'pydantic', 'scipy'} & set(sys.modules), 'heavy import'"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "--truth" in done.stdout
