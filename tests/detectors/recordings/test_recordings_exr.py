"""Depth in OpenEXR files: which channel is read, and what is refused."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest

from detectors.recordings import open_capture
from detectors.recordings.exr import load_exr
from harness.vocabulary.errors import UserError
from tests.support import recorded_plane as plane
from tests.support.exr_files import write_exr

DEPTH_M = plane.depth_mm().astype(np.float32) / 1e3
OTHER = np.full(DEPTH_M.shape, 7.0, np.float32)


@pytest.mark.parametrize(
    "channels",
    [
        {"Z": DEPTH_M},
        {"R": DEPTH_M},
        {"D": DEPTH_M},
        {"Y": DEPTH_M, "A": OTHER},
        {"R": DEPTH_M, "G": OTHER, "B": OTHER},
        {"R": OTHER, "G": OTHER, "B": OTHER, "A": OTHER, "Z": DEPTH_M},
        {"R": OTHER.astype(np.float16), "G": OTHER.astype(np.float16), "Z": DEPTH_M},
    ],
    ids=["Z", "R", "D", "YA", "RGB", "RGBAZ", "half colours"],
)
def test_the_depth_channel_is_read_exactly(tmp_path: Path, channels: dict[str, np.ndarray]):
    loaded = load_exr(write_exr(tmp_path / "a.exr", channels))
    assert np.array_equal(loaded[""], DEPTH_M)


def test_half_precision_is_read(tmp_path: Path):
    half = DEPTH_M.astype(np.float16)
    loaded = load_exr(write_exr(tmp_path / "a.exr", {"Z": half}))
    assert np.array_equal(loaded[""], half.astype(np.float32))


def test_a_folder_of_exr_is_a_capture_in_metres(tmp_path: Path):
    for number in range(3):
        write_exr(tmp_path / f"{number}.exr", {"Z": DEPTH_M})
    recording = open_capture([tmp_path], lens=plane.LENS)
    frames = list(recording.frames())
    assert len(frames) == 3 and recording.scale_m == 1.0
    valid = DEPTH_M > 0
    assert np.array_equal(frames[2].z_m[valid], DEPTH_M[valid])
    assert np.isnan(frames[2].z_m[plane.NO_RETURN])


@pytest.mark.parametrize(
    ("channels", "version", "why"),
    [
        ({"left": DEPTH_M, "right": DEPTH_M}, 2, "no channel Z, Y or R; its channels: LEFT, RIGHT"),
        ({"Z": DEPTH_M.astype(np.uint32)}, 2, "whole numbers of 32 bits"),
        ({"Z": DEPTH_M}, 2 | 0x800, "deep pixels"),
        ({"Z": DEPTH_M}, 2 | 0x1000, "several parts"),
    ],
)
def test_other_files_are_refused(
    tmp_path: Path, channels: dict[str, np.ndarray], version: int, why: str
):
    path = write_exr(tmp_path / "a.exr", channels, version)
    with pytest.raises(UserError, match=why):
        load_exr(path)


def test_a_file_that_states_a_huge_picture_is_not_decoded(tmp_path: Path):
    path = write_exr(tmp_path / "a.exr", {"Z": DEPTH_M})
    height, width = DEPTH_M.shape
    stated = struct.pack("<4i", 0, 0, width - 1, height - 1)
    huge = struct.pack("<4i", 0, 0, 99_999, 99_999)
    path.write_bytes(path.read_bytes().replace(stated, huge))
    with pytest.raises(UserError, match="100000 x 100000 pixels"):
        load_exr(path)


@pytest.mark.parametrize("length", [0, 3, 8, 40, 200, 400])
def test_cut_files_are_refused(tmp_path: Path, length: int):
    path = write_exr(tmp_path / "a.exr", {"Z": DEPTH_M})
    path.write_bytes(path.read_bytes()[:length])
    with pytest.raises(UserError, match="cannot be read as OpenEXR"):
        load_exr(path)
