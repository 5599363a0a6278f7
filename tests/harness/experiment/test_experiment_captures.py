"""A real capture as the source of an experiment: known by its content, and each mistake with its
place."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from harness.experiment.load import load_experiment
from harness.experiment.schema import Experiment
from harness.vocabulary.declaration.yaml_source import DeclarationError


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return tmp_path


def loaded(folder: Path, text: str, *overrides: str) -> Experiment:
    path = folder / "x.yaml"
    path.write_text(text)
    return load_experiment(path, overrides)


def refused(folder: Path, text: str) -> str:
    with pytest.raises(DeclarationError) as caught:
        loaded(folder, text)
    return str(caught.value).replace(f"{folder}/", "")


def depth_folder(folder: Path, value_mm: int = 700) -> Path:
    frames = folder / "frames"
    frames.mkdir(exist_ok=True)
    for index in range(2):
        cv2.imwrite(str(frames / f"{index}.png"), np.full((576, 640), value_mm + index, np.uint16))
    return frames


CAPTURE = """\
name: real
source: {kind: capture, paths: [frames], intrinsics: azure_kinect_nfov}
capture: {frames: 2}
detector: {name: thesis}
threshold: {k: 3.5}
"""


def test_a_capture_is_known_by_its_content(
    folder: Path, tmp_path_factory: pytest.TempPathFactory
) -> None:
    depth_folder(folder)
    (point,) = loaded(folder, CAPTURE).points
    elsewhere = tmp_path_factory.mktemp("elsewhere")
    depth_folder(elsewhere)
    (moved,) = loaded(elsewhere, CAPTURE).points
    assert (moved.digest, moved.frames_key) == (point.digest, point.frames_key)
    second_folder = tmp_path_factory.mktemp("other")
    depth_folder(second_folder, 701)
    (changed,) = loaded(second_folder, CAPTURE).points
    assert changed.digest != point.digest
    (unit,) = loaded(folder, CAPTURE, "source.unit=4000/m").points
    assert unit.frames_key != point.frames_key


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        (
            "[frames]",
            "[frmes]",
            ["2:33:", "frmes: there is no such file or folder", "did you mean: frames"],
        ),
        ("frames], ", "frames], unit: feet, ", ["2:32:", "feet: no such unit"]),
        (
            "intrinsics: azure_kinect_nfov",
            "intrinsics: nothing.json",
            ["2:54:", "neither a file nor a camera"],
        ),
        (
            ", intrinsics: azure_kinect_nfov",
            "",
            ["2:32:", "the lens of these depth images is unknown"],
        ),
        (
            "{k: 3.5}",
            "{calibrate: {repeats: 5}}",
            ["5:24: a threshold can be calibrated only on hole-free repeats"],
        ),
    ],
)
def test_mistakes_of_a_capture(folder: Path, old: str, new: str, expected: list[str]) -> None:
    depth_folder(folder)
    message = refused(folder, CAPTURE.replace(old, new))
    for words in expected:
        assert words in message


def test_paths_count_from_the_file_and_on_the_command_line_from_the_current_folder(
    folder: Path, tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch
) -> None:
    frames = depth_folder(folder)
    current = tmp_path_factory.mktemp("current")
    monkeypatch.chdir(current)
    assert loaded(folder, CAPTURE).data["source"]["paths"] == [str(frames)]
    second_folder = depth_folder(current)
    assert loaded(folder, CAPTURE, "source.paths=[frames]").data["source"]["paths"] == [
        str(second_folder)
    ]


def test_a_changed_file_is_another_experiment(folder: Path) -> None:
    frames = depth_folder(folder)
    (before,) = loaded(folder, CAPTURE).points
    cv2.imwrite(str(frames / "1.png"), np.full((576, 640), 705, np.uint16))
    (after,) = loaded(folder, CAPTURE).points
    assert after.digest != before.digest
