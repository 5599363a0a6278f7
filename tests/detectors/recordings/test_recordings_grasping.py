"""Lenses as data sets for grasping store them: GraspNet's meta.mat and Berkeley's .intr."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import scipy.io

from detectors.recordings import open_capture
from detectors.recordings.intrinsics import read_lens
from harness.vocabulary.errors import UserError
from tests.support import recorded_plane as plane


def write_meta(path: Path, **more: object) -> Path:
    """GraspNet's file of a picture: the lens, the depth factor, and the objects' poses."""
    path.parent.mkdir(parents=True, exist_ok=True)
    facts = {
        "intrinsic_matrix": plane.LENS.matrix,
        "factor_depth": np.array([[1000]]),
        "cls_indexes": np.arange(9)[:, None],
        "poses": np.zeros((3, 4, 9)),
    }
    scipy.io.savemat(path, facts | more)
    return path


def write_intr(path: Path, **more: object) -> Path:
    lens = plane.LENS
    facts = {"_frame": "camera", "_fx": lens.fx, "_fy": lens.fy, "_cx": lens.cx, "_cy": lens.cy}
    size = {"_width": lens.width, "_height": lens.height}
    path.write_text(json.dumps(facts | size | {"_skew": 0.0, "_K": 0} | more))
    return path


def test_the_lens_of_meta_mat(tmp_path: Path):
    lens = plane.LENS
    assert read_lens(write_meta(tmp_path / "meta.mat"), lens.width, lens.height) == lens


def test_a_picture_beside_meta_mat_has_its_lens_and_unit(tmp_path: Path):
    """5000 stored numbers make a metre; without the statement they would be taken for millimetres."""
    write_meta(tmp_path / "meta.mat", factor_depth=np.array([[5000]]))
    cv2.imwrite(str(tmp_path / "depth.png"), 5 * plane.depth_mm())
    recording = open_capture([tmp_path])
    assert recording.lens == plane.LENS
    assert recording.scale_m == pytest.approx(1 / 5000)
    assert recording.unit_from == "meta.mat"


def test_a_scene_of_graspnet_has_the_lens_of_its_first_picture(tmp_path: Path):
    (tmp_path / "depth").mkdir()
    for number in range(2):
        write_meta(tmp_path / "meta" / f"{number:04d}.mat")
        depth_mm = plane.depth_mm(number, noise_mm=0.6)
        cv2.imwrite(str(tmp_path / "depth" / f"{number:04d}.png"), depth_mm)
    recording = open_capture([tmp_path])
    assert recording.lens == plane.LENS and recording.unit_from == "0000.mat"


def test_a_mat_without_a_lens_is_refused(tmp_path: Path):
    scipy.io.savemat(tmp_path / "meta.mat", {"poses": np.zeros((3, 4))})
    with pytest.raises(UserError, match="holds no lens"):
        read_lens(tmp_path / "meta.mat", 96, 72)
    (tmp_path / "meta.mat").write_bytes(b"no MATLAB file")
    with pytest.raises(UserError, match="cannot be read"):
        read_lens(tmp_path / "meta.mat", 96, 72)


def test_the_lens_of_intr(tmp_path: Path):
    lens = plane.LENS
    path = write_intr(tmp_path / "camera.intr")
    assert read_lens(path, lens.width, lens.height) == lens
    np.save(tmp_path / "depth_0.npy", plane.depth_mm()[..., None] / 1e3)
    assert open_capture([tmp_path / "depth_0.npy"]).lens == lens
    write_intr(tmp_path / "second.intr")
    with pytest.raises(UserError, match="lens of these depth images is unknown"):
        open_capture([tmp_path / "depth_0.npy"])


def test_skewed_pixels_are_refused(tmp_path: Path):
    with pytest.raises(UserError, match="skewed pixels are not modelled"):
        read_lens(write_intr(tmp_path / "camera.intr", _skew=0.5), 96, 72)
