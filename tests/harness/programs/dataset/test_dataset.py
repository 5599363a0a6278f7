"""``tofpod dataset``: files are as each layout documents them; a killed run goes on with equal
bytes."""

from __future__ import annotations

import json
import shutil
import struct
from pathlib import Path

import cv2
import numpy as np
import pytest

from harness.programs.dataset import dataset
from harness.programs.dataset.boards import INSET_PX
from harness.programs.dataset.exchange import run_lengths
from harness.report.blocks import template
from harness.vocabulary.path_names import camera_title
from tests.support.tiny_dataset import arrays_of, names_in, truth_of, write


@pytest.fixture
def home(dataset_home: Path) -> Path:
    return dataset_home


def tiff_floats(path: Path) -> np.ndarray:
    """(h, w, 3) of an uncompressed TIFF of float32, by the tags of the specification (TIFF 6.0)
    and nothing else."""
    content = path.read_bytes()
    order = {b"II": "<", b"MM": ">"}[content[:2]]
    (first,) = struct.unpack_from(f"{order}I", content, 4)
    tags = {}
    for k in range(struct.unpack_from(f"{order}H", content, first)[0]):
        tag, kind, count = struct.unpack_from(f"{order}HHI", content, first + 2 + 12 * k)
        size = {3: 2, 4: 4}.get(kind, 1) * count
        value_start = first + 10 + 12 * k
        if size > 4:
            (value_start,) = struct.unpack_from(f"{order}I", content, value_start)
        if kind in (3, 4):
            tags[tag] = struct.unpack_from(
                f"{order}{count}{'H' if kind == 3 else 'I'}", content, value_start
            )
    assert tags[259] == (1,)
    assert tags[258] == (32,) * 3
    assert tags[339] == (3,) * 3
    assert tags[277] == (3,)
    strips = zip(tags[273], tags[279], strict=True)
    pixel_bytes = b"".join(content[start : start + length] for start, length in strips)
    return np.frombuffer(pixel_bytes, f"{order}f4").reshape(tags[257][0], tags[256][0], 3)


def test_the_layout_is_that_of_mvtec_3d_ad(home):
    """As anomalib's loader takes it: every picture is .../split/label/type/file; xyz beside each
    rgb, gt in test."""
    folder = home / "set"
    pictures = [path for path in (folder / "tiny").rglob("*") if path.suffix in (".png", ".tiff")]
    parts = sorted(path.relative_to(folder / "tiny").parts for path in pictures)
    assert {part[:2] for part in parts} == {
        ("train", "good"), ("validation", "good"), ("test", "good"), ("test", "through")
    }  # fmt: skip
    colours = [part for part in parts if part[2] == "rgb"]
    assert len(colours) == 10 == len(names_in(folder))
    assert len(pictures) == 2 * 10 + 5
    for split, label, _, file in colours:
        label_folder = folder / "tiny" / split / label
        stem = Path(file).stem
        points = tiff_floats(label_folder / "xyz" / f"{stem}.tiff")
        name = f"tiny/{split}/{label}/{stem}"
        arrays = arrays_of(folder, name)
        np.testing.assert_array_equal(points, np.nan_to_num(arrays["points_m"]))
        assert 0.6 < np.median(points[arrays["inspected"], 2]) < 0.8
        assert np.isfinite(points).all()
        colour = cv2.imread(str(label_folder / "rgb" / file), cv2.IMREAD_UNCHANGED)
        assert colour.shape == points.shape
        assert colour.dtype == np.uint8
        assert np.ptp(colour) > 100
        assert (label_folder / "gt" / file).exists() == (split == "test")
        if split == "test":
            mask = cv2.imread(str(label_folder / "gt" / file), cv2.IMREAD_UNCHANGED)
            np.testing.assert_array_equal(mask, np.where(arrays["damage"] > 0, 255, 0))
            assert mask.any() == (label != "good")


def test_anomalib_reads_it_unchanged(home):
    """By anomalib's own loader, where it is installed. Its version 2.7 gives no item of any
    training split beside pandas 3, where the mask that such items lack is no text: that alone is
    mended here."""
    loader = pytest.importorskip("anomalib.data.datasets.depth.mvtec_3d").MVTec3DDataset
    for split, count in (("train", 3), ("test", 5)):
        data = loader(root=home / "set", category="tiny", split=split)
        assert len(data) == count
        data.samples["mask_path"] = data.samples["mask_path"].fillna("")
        for item in (data[number] for number in range(count)):
            folder = Path(item.image_path).parents[1]
            stem = Path(item.image_path).stem
            points = tiff_floats(folder / "xyz" / f"{stem}.tiff")
            np.testing.assert_array_equal(np.moveaxis(np.asarray(item.depth_map), 0, -1), points)
            assert np.asarray(item.image).shape == (3, *points.shape[:2])
            assert item.gt_label == (folder.name != "good")
            if split == "test":
                mask = arrays_of(home / "set", f"tiny/{split}/{folder.name}/{stem}")["damage"] > 0
                np.testing.assert_array_equal(np.asarray(item.gt_mask, bool).squeeze(), mask)


def test_coco_masks_are_the_damages(home):
    folder = home / "set"
    data = json.loads((folder / "coco" / "tiny_test.json").read_text())
    assert data["categories"] == [{"id": 1, "name": "through"}]
    assert len(data["images"]) == 5
    assert not json.loads((folder / "coco" / "tiny_train.json").read_text())["annotations"]
    names = {image["id"]: image["file_name"] for image in data["images"]}
    for annotation in data["annotations"]:
        height, width = annotation["segmentation"]["size"]
        counts = annotation["segmentation"]["counts"]
        inside = (
            np.repeat(np.arange(len(counts)) % 2, counts).reshape(width, height).T
        )  # by columns
        split, label, _, file = names[annotation["image_id"]].split("/")[1:]
        damage = arrays_of(folder, f"tiny/{split}/{label}/{Path(file).stem}")["damage"]
        (number,) = np.unique(damage[inside > 0])
        np.testing.assert_array_equal(inside > 0, damage == number)
        rows, columns = np.nonzero(inside)
        box = [
            columns.min(),
            rows.min(),
            columns.max() + 1 - columns.min(),
            rows.max() + 1 - rows.min(),
        ]
        assert annotation["bbox"] == box
        assert annotation["area"] == len(rows)
        assert (folder / names[annotation["image_id"]]).exists()
    assert len(data["annotations"]) == 4 * 2


def test_run_lengths_begin_outside():
    assert run_lengths(np.array([[True, False], [True, True]])) == [0, 2, 1, 1]
    assert run_lengths(np.array([[False, False], [False, True]])) == [3, 1]


def test_truth_depth_and_validity_agree_with_the_cloud(home):
    folder = home / "set"
    name = "tiny/test/through/0002"
    truth = truth_of(folder, name)
    arrays = arrays_of(folder, name)
    board_folder = folder / "boards" / name
    depth = cv2.imread(str(board_folder / f"{'depth'}.png"), cv2.IMREAD_UNCHANGED)
    valid = cv2.imread(str(board_folder / f"{'valid'}.png"), cv2.IMREAD_UNCHANGED)
    intensity = cv2.imread(str(board_folder / f"{'intensity'}.png"), cv2.IMREAD_UNCHANGED)
    mask = cv2.imread(str(board_folder / f"{'mask'}.png"), cv2.IMREAD_UNCHANGED)
    z_m = arrays["points_m"][..., 2]
    np.testing.assert_array_equal(valid > 0, np.isfinite(z_m))
    # 16 bits hold 13.1 m; noise alone may look farther away
    is_stored = (valid > 0) & (z_m < 65535 / 5000)
    assert np.abs(depth[is_stored] / 5000 - z_m[is_stored]).max() <= 1.01e-4
    assert (depth[~is_stored] == 0).all()
    bright = intensity / 65535 * truth["intensity_at_65535"]
    assert (
        np.abs(bright - np.minimum(arrays["intensity"], truth["intensity_at_65535"])).max()
        < bright.max() / 6e4
    )
    np.testing.assert_array_equal(mask, arrays["damage"])
    assert depth.shape == (truth["height"], truth["width"])
    for flaw in truth["damages"]:
        flaw_mask = arrays["damage"] == flaw["id"]
        middle_mm = 1000 * arrays["board_xy_m"][flaw_mask].mean(axis=0)
        assert np.hypot(*(middle_mm - [flaw["x_board_mm"], flaw["y_board_mm"]])) < 1.0
        area_mm2 = (
            flaw_mask.sum() / arrays["inspected"].sum() * 130 * 90 * 0.9
        )  # pixels are some 2 mm2
        assert area_mm2 == pytest.approx(np.pi / 4 * flaw["diameter_mm"] ** 2, rel=0.35)


def test_no_unit_and_no_board_is_in_two_splits(home):
    folder = home / "set"
    units = dict[str, set[int]]()
    poses = set()
    for name in names_in(folder):
        truth = truth_of(folder, name)
        units.setdefault("/".join(name.split("/")[1:3]), set()).add(truth["unit_seed"])
        poses.add(str(truth["T_camera_board"]))
    assert len(poses) == 10
    assert sum(map(len, units.values())) == len(set().union(*units.values())) == 3 + 2 + 1 + 2
    assert (
        "No unit of the camera captures boards of two splits" in (folder / "README.md").read_text()
    )


def test_the_card_shows_its_command_as_text(home, monkeypatch):
    """The command may hold anything, and its page must not run it."""
    folder = home / "set"
    description = json.loads((folder / "dataset.json").read_text())
    description["provenance"]["command"] = "tofpod dataset '`<script>alert(1)</script>`'"
    card = template("dataset_card.md", Path(dataset.__file__).parent)
    text = card.render(about=description, inset=INSET_PX, title=camera_title)
    assert "<script>" not in text
    assert "<pre><code>tofpod dataset &#39;`&lt;script&gt;alert(1)" in text


def test_a_killed_run_goes_on_and_writes_equal_bytes(home, tmp_path, capsys):
    shutil.copytree(home / "set", tmp_path / "set")
    shutil.copytree(home / "results", tmp_path / "results")
    before = {path: path.read_bytes() for path in (tmp_path / "set").rglob("*") if path.is_file()}
    lost = tmp_path / "set" / "boards" / "tiny" / "test" / "through" / "0001"
    (lost / "truth.json").unlink()  # a killed process leaves files of a board, but not the last
    (tmp_path / "set" / "tiny" / "test" / "through" / "xyz" / "0001.tiff").unlink()
    shutil.rmtree(tmp_path / "set" / "boards" / "tiny" / "train" / "good" / "0000")
    index = json.loads((tmp_path / "set" / "dataset.json").read_text())
    (tmp_path / "set" / "dataset.json").write_text(json.dumps({**index, "samples": None}))
    assert write(tmp_path, "set") == 0
    assert "trials 10/10 (8 found)" in capsys.readouterr().err
    after = {path: path.read_bytes() for path in (tmp_path / "set").rglob("*") if path.is_file()}
    assert before.keys() == after.keys()
    with_command = {"README.md", "dataset.json"}  # these name the command
    assert all(
        after[path] == content for path, content in before.items() if path.name not in with_command
    )


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--set", "seed=4"], "holds a data set of another experiment"),
        (["--boards", "9"], "10 to 10000 boards"),
        (["--set", "source.target={name: thesis}", "--set", "study=null"], "no random boards"),
    ],
)
def test_mistakes_are_told(home, capsys, arguments, message):
    index = (home / "set" / "dataset.json").read_bytes()
    changed = arguments + (["--set", "threshold={k: 5.0}"] if "study=null" in arguments else [])
    assert write(home, "set", *changed) == 2
    assert message in capsys.readouterr().err
    assert (home / "set" / "dataset.json").read_bytes() == index


def test_a_folder_with_other_files_is_left_alone(home, tmp_path, capsys):
    (tmp_path / "mine.txt").write_text("mine")
    arguments = [
        "--boards",
        "10",
        "--out",
        str(tmp_path),
        "--results",
        str(home / "results"),
        "--serial",
    ]
    assert dataset.main([str(home / "tiny.yaml"), *arguments]) == 2
    assert "is not empty" in capsys.readouterr().err
    assert [*tmp_path.iterdir()] == [tmp_path / "mine.txt"]
