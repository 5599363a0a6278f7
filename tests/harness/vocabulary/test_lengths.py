"""Lengths with units, in options and in YAML, are the numbers that a bare number would be."""

from __future__ import annotations

import argparse

import pytest

from harness.experiment.load import load_experiment
from harness.inspection.arguments import assign, crop_from_text
from harness.programs.coverage.coverage import _pose
from harness.vocabulary import lengths
from harness.vocabulary.declaration.yaml_source import DeclarationError, parse_yaml
from harness.vocabulary.errors import UserError
from harness.vocabulary.program import length, length_m, span


@pytest.mark.parametrize(
    ("text", "millimetres"),
    [
        ("7", 7.0),
        ("7mm", 7.0),
        (" 0.7 cm ", 7.0),
        ("1m", 1000.0),
        ("0.25in", 6.35),
        ("-2e-1 mm", -0.2),
        ("500um", 0.5),
    ],
)
def test_a_length_in_millimetres(text: str, millimetres: float) -> None:
    assert lengths.in_unit(text, "mm") == millimetres


@pytest.mark.parametrize(
    "text", ["", "mm", "five mm", "5 feet", "5mm 3", "nan", "inf mm", "1e9999"]
)
def test_what_is_no_length(text: str) -> None:
    assert lengths.in_unit(text, "mm") is None


def test_a_length_is_the_number_that_would_be_written() -> None:
    """Products of floats are not: 110 * 0.01 is 1.1 only nearly."""
    for hundredths in range(1, 1000):
        assert lengths.in_unit(f"{hundredths}cm", "m") == hundredths / 100


def test_lengths_of_options() -> None:
    assert length("mm")("0.25in") == 6.35
    assert span("mm")("2:10") == (2.0, 10.0)
    assert span("mm")("2:10mm") == (2.0, 10.0)
    assert span("mm")("2mm:1cm") == (2.0, 10.0)
    assert span("mm")("0.1:0.5in") == (2.54, 12.7), "a unit at the end is that of both"
    for text in ("0", "-1mm", "wide", "1e999"):
        with pytest.raises(argparse.ArgumentTypeError, match="is not a length"):
            length("mm")(text)
    for text in ("2", "2:", "2:10:3", "a:b"):
        with pytest.raises(argparse.ArgumentTypeError, match="is not FROM:TO"):
            span("mm")(text)
    assert length_m("--size", "5mm") == 0.005
    with pytest.raises(UserError, match="--size 5: is not a length with a unit"):
        length_m("--size", "5")


def test_lengths_in_yaml() -> None:
    text = """
    distance_m: 90cm
    sizes_mm: [1cm, 7, 0.25in]
    title: 5mm
    sweep: {source.target.distance_m: [0.7, 70 cm]}
    vary: [{path: board.width_mm, values: [1m, 5]}]
    unknowns: [{key: backing.distance_mm, range: [1cm, 0.5m]}, {key: a_mm, values: [1cm]}]
    """
    assert parse_yaml(text, "x.yaml").data == {
        "distance_m": 0.9,
        "sizes_mm": [10.0, 7, 6.35],
        "title": "5mm",
        "sweep": {"source.target.distance_m": [0.7, 0.7]},
        "vary": [{"path": "board.width_mm", "values": [1000.0, 5]}],
        "unknowns": [
            {"key": "backing.distance_mm", "range": [10.0, 500.0]},
            {"key": "a_mm", "values": [10.0]},
        ],
    }


def test_a_set_length_is_the_same_experiment() -> None:
    bare = load_experiment("smoke", ["source.target.distance_m=0.9", "matching.radius_mm=12.7"])
    experiment = load_experiment(
        "smoke", ["source.target.distance_m=90cm", "matching.radius_mm=0.5in"]
    )
    assert bare.digest == experiment.digest != load_experiment("smoke").digest


def test_a_wrong_unit_has_a_message_that_says_what_is_legal() -> None:
    with pytest.raises(DeclarationError) as caught:
        load_experiment("smoke", ["source.target.distance_m=3 feet"])
    assert "in m; or a length with a unit, such as 5mm, 0.5cm, 1m or 0.25in" in " ".join(
        str(caught.value).split()
    )


def test_lengths_of_an_inspection() -> None:
    settings: dict[str, object] = {}
    assign(settings, "mapping.merge.cell_mm=0.1cm")
    assert settings == {"mapping": {"merge": {"cell_mm": 1.0}}}
    assert crop_from_text("box:-20cm,200,-0.15m,150,400,900")["x_mm"] == [-200.0, 200.0]
    with pytest.raises(UserError, match="not all of its values are numbers"):
        crop_from_text("polygon:1mm,2,3,4,5,6")


def test_the_distance_of_a_pose() -> None:
    assert _pose("70cm,20,-10") == _pose("0.7,20,-10") == (0.7, 20.0, -10.0)
    for text in ("70,0,0", "wide,0,0", "0.7,0", "0.7,a,b"):
        with pytest.raises(argparse.ArgumentTypeError):
            _pose(text)
