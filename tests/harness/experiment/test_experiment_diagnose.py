"""From pydantic's errors to messages: each kind with its line, column, caret, what is legal and
the nearest name."""

from __future__ import annotations

from pathlib import Path
from textwrap import dedent
from typing import Annotated, Any, Literal

import pytest
from pydantic import BaseModel, Field, model_validator

from detectors import load_detector
from detectors.views.mapping.settings import MappingConfig
from harness.vocabulary.config import Config
from harness.vocabulary.declaration import shape
from harness.vocabulary.declaration.diagnose import read_as, settings_of, validated
from harness.vocabulary.declaration.yaml_source import DeclarationError, parse_yaml, read_yaml
from harness.vocabulary.errors import UserError
from scenes.sensor.camera import read_camera
from scenes.target.thesis import TARGETS


class Hole(Config):
    kind: Literal["hole"]
    diameter_mm: float = Field(gt=0, le=100)
    centre_mm: tuple[float, float] = (0.0, 0.0)


class Dent(Config):
    kind: Literal["dent", "dimple"]
    depth_mm: float = Field(ge=0.1)


class Box(Config):
    width: int
    height: int = 1


class Ball(Config):
    radius: float = Field(gt=0, description="of the ball, mm")


class Board(Config):
    width_mm: float = Field(600.0, ge=10, le=2000)
    finish: Literal["matte", "glossy"] = "matte"
    damages: Annotated[
        tuple[Annotated[Hole | Dent, Field(discriminator="kind")], ...], Field(max_length=3)
    ] = ()
    first: Hole | Dent | None = Field(None, discriminator="kind")
    body: Box | Ball | None = None
    size: int | Literal["small", "large"] = 1
    loose: tuple[int, ...] | int = 0
    flag: bool = True
    table: dict[str, Annotated[float, Field(ge=0)]] = Field(default_factory=dict)
    code: Annotated[str, Field(pattern="^[a-z]+$", min_length=2)] = "ab"
    free: dict[str, Any] = Field(default_factory=dict)

    @model_validator(mode="after")
    def _fits(self) -> Board:
        if self.width_mm == 666:
            raise ValueError("no board is that wide")
        return self


class House(Config):
    name: str
    board: Board = Board()


class Settings(Config):
    scale: Literal["mad", "std"] = "mad"
    gain: float = Field(2.0, ge=1)


SPLICES: shape.Splices = {("board", "free"): Settings}


def messages(text: str, splices: shape.Splices | None = None) -> list[str]:
    source = parse_yaml(dedent(text), "x.yaml")
    config, problems = validated(House, source, splices or {})
    assert (config is None) == bool(problems)
    return [str(problem) for problem in problems]


def only(text: str, splices: shape.Splices | None = None) -> str:
    (message,) = messages(text, splices)
    return message


def test_a_valid_text_has_no_problem() -> None:
    assert (
        messages(
            "name: a\nboard: {damages: [{kind: dimple, depth_mm: 1}], body: {radius: 1}, "
            "loose: [1, 2]}"
        )
        == []
    )


def test_a_number_out_of_range_in_full() -> None:
    assert only("name: a\nboard:\n  width_mm: 0.25 # metres\n") == (
        "x.yaml:3:13: `board.width_mm` is 0.25: it should be greater than or equal to 10\n"
        "    3 |   width_mm: 0.25 # metres\n"
        "      |             ^~~~\n"
        "  legal: a number from 10.0 to 2000.0"
    ).replace("10.0", "10").replace("2000.0", "2000")


def test_an_unknown_key_in_full() -> None:
    assert only("name: a\nboard: {width: 3}\n") == (
        "x.yaml:2:9: unknown key `width` in `board`\n"
        "    2 | board: {width: 3}\n"
        "      |         ^~~~~\n"
        "  did you mean: width_mm\n"
        "  legal: width_mm, finish, damages, first, body, size, loose, flag, table, code, free"
    )


def test_an_unknown_key_beside_the_right_one_is_not_called_that() -> None:
    assert "did you mean" not in only("name: a\nboard: {flag: true, flags: 3}\n")


def test_an_unknown_key_whose_value_is_null_has_its_place() -> None:
    assert "x.yaml:2:9: unknown key `wdth_mm` in `board`" in only(
        "name: a\nboard: {wdth_mm: null}\n"
    )


def test_a_missing_key() -> None:
    assert only("board: {}\n").startswith(
        "x.yaml:1:1: the file lacks the key `name`\n    1 | board: {}\n"
    )
    message = only("name: a\nboard:\n  body: {height: 2}\n")
    assert message.startswith("x.yaml:3:3: `board.body` lacks the key `width`\n")
    assert "legal: a whole number" in message


@pytest.mark.parametrize(
    ("board", "expected"),
    [
        ("flag: yes", ['2:15: `board.flag` is "yes"', "legal: true or false", "to do: write true"]),
        ("flag: 1", ["2:15: `board.flag` is 1:", "legal: true or false"]),
        ("width_mm: ten", ['2:19: `board.width_mm` is "ten": it should be a valid number', "^~~"]),
        ("width_mm: true", ["2:19: `board.width_mm` is true:"]),
        ("width_mm: .inf", ["2:19: `board.width_mm` is .inf:"]),
        ("width_mm: .nan", ["2:19: `board.width_mm` is .nan:"]),
        ("width_mm: null", ["2:19: `board.width_mm` is null:"]),
        ("width_mm: 3000", ["2:19:", "less than or equal to 2000"]),
        (
            "body: {width: 1e1}",
            ["2:23: `board.body.width` is 10.0:", "to do: write 10 without a decimal point"],
        ),
        ("body: {width: 1.5}", ["2:23: `board.body.width` is 1.5:", "legal: a whole number"]),
        (
            "finish: mate",
            [
                '2:17: `board.finish` is "mate"',
                "did you mean: matte",
                "legal: one of matte, glossy",
            ],
        ),
        ("finish: zzz", ["2:17:", "legal: one of matte, glossy"]),
        ("damages: 3", ["2:18: `board.damages` is 3:", "legal: a list (at most 3 items)"]),
        (
            "damages: [1]",
            ["2:19: `board.damages.0` is 1, not a mapping", "`kind`: one of hole, dent, dimple"],
        ),
        ("damages: [{kind: hol}]", ['2:26: `board.damages.0.kind` is "hol"', "did you mean: hole"]),
        (
            "damages: [{knd: hole}]",
            ["2:19: `board.damages.0` lacks the key `kind`", "rename `knd` to `kind`"],
        ),
        (
            "damages: [{kind: hole, diameter_mm: -1}]",
            ["2:45: `board.damages.0.diameter_mm` is -1:"],
        ),
        (
            "damages: [{kind: dimple, depth: 1, depth_mm: 2}]",
            ["2:34: unknown key `depth` in `board.damages.0`"],
        ),
        (
            "first: {kind: dent, depth_mm: 0}",
            ["2:39: `board.first.depth_mm` is 0:", "legal: a number at least 0.1"],
        ),
        (
            "first: {kind: hole, diameter_mm: 1, centre_mm: [1]}",
            ["2:56: `board.first.centre_mm` lacks item number 2"],
        ),
        ("table: {a: -1}", ["2:20: `board.table.a` is -1:", "legal: a number at least 0"]),
        ("code: A1", ['2:15: `board.code` is "A1":', "legal: text that matches ^[a-z]+$"]),
        (
            "body: {radius: 0}",
            ["2:24: `board.body.radius` is 0:", "legal: a number above 0 (of the ball, mm)"],
        ),
        (
            "body: {radius: 1, heigth: 1}",
            ["2:27: unknown key `heigth` in `board.body`", "legal: radius"],
        ),
        (
            "body: 7",
            [
                "2:15: `board.body` is 7, which matches none",
                "keys width, height or a mapping with the keys radius",
            ],
        ),
        (
            "size: medium",
            [
                '2:15: `board.size` is "medium", which matches none',
                "a whole number or one of small, large",
            ],
        ),
        ("loose: [1, x]", ['2:20: `board.loose.1` is "x":']),
        (
            "loose: x",
            [
                '2:16: `board.loose` is "x", which matches none',
                "a list, each a whole number or a whole number",
            ],
        ),
        ("width_mm: 666", ["2:8: `board`: no board is that wide"]),
    ],
)
def test_each_kind_of_message_has_its_place(board: str, expected: list[str]) -> None:
    message = only(f"name: a\nboard: {{{board}}}\n")
    for words in expected:
        assert words in message
    line, caret = message.splitlines()[1:3]
    column = int(message.split(":")[2])
    assert caret.index("^") - line.index("|") - 2 == column - 1


def test_board_that_is_no_mapping() -> None:
    assert "x.yaml:2:8: `board` is a list" in only("name: a\nboard: [1]\n")
    assert "x.yaml:2:8: `board` is 3" in only("name: a\nboard: 3\n")


def test_all_problems_at_once() -> None:
    result = messages(
        "nam: a\nboard: {width_mm: 1, damages: [{kind: hole}, {kind: dent, depth_mm: x}], "
        "flag: 2}\n"
    )
    assert len(result) == 6
    text = "\n".join(result)
    for words in (
        "unknown key `nam`",
        "lacks the key `name`",
        "`board.width_mm`",
        "`diameter_mm`",
        "depth_mm",
        "flag",
    ):
        assert words in text


def test_spliced_settings_are_checked_with_the_rest_and_completed() -> None:
    result = messages("board: {free: {scale: mat, gan: 2}}\n", SPLICES)
    text = "\n".join(result)
    assert len(result) == 3
    assert 'x.yaml:1:23: `board.free.scale` is "mat", which is none of the legal values' in text
    assert "did you mean: mad" in text
    assert "x.yaml:1:28: unknown key `gan` in `board.free`" in text
    assert "did you mean: gain" in text

    config, _ = validated(House, parse_yaml("name: a\nboard: {free: {gain: 3}}", "x"), SPLICES)
    assert config is not None
    assert config.board.free == {"scale": "mad", "gain": 3.0}


def test_shape_knows_what_is_declared_where() -> None:
    data = {"board": {"first": {"kind": "hole"}, "damages": [{"kind": "dent"}]}}
    declared = shape.Declared(House, data, SPLICES)
    legal = (
        ("board", "first", "diameter_mm"),
        ("board", "damages", 0, "depth_mm"),
        ("board", "free", "gain"),
        ("board", "table", "anything"),
    )
    assert [path for path in legal if declared.at(path) is None] == []
    wrong = (
        ("board", "first", "depth_mm"),
        ("board", "damages", 0, "diameter_mm"),
        ("board", "free", "x"),
        ("bord",),
    )
    assert [path for path in wrong if declared.at(path) is not None] == []
    assert ("board", "damages", 0, "depth_mm") in set(declared.paths())
    assert ("board", "free", "scale") in set(declared.paths())


def test_legal_words_of_annotations() -> None:
    class Sample(BaseModel):
        pair: tuple[int, str]
        few: Annotated[list[float], Field(min_length=1, max_length=2)]
        maybe: bool | None
        fixed: Literal[3]
        below: Annotated[float, Field(lt=5)]

    declared = shape.Declared(Sample, {}, {})
    words = {name: shape.legal_at(declared.at((name,))) for name in Sample.model_fields}
    assert words == {
        "pair": "a list of a whole number, text",
        "few": "a list (1 to 2 items), each a number",
        "maybe": "true or false or null",
        "fixed": "3",
        "below": "a number below 5",
    }


@pytest.mark.parametrize("value", ["[a]", "{a: 1}", "3", "true"])
def test_a_kind_or_name_that_is_no_text_is_refused_with_its_place(
    tmp_path: Path, value: str
) -> None:
    target = tmp_path / "target.yaml"
    camera = tmp_path / "camera.yaml"
    target.write_text(f"name: {value}\n")
    camera.write_text(f"kind: {value}\n")
    with pytest.raises(
        DeclarationError, match=r"target\.yaml:1:7: `name` is .*none of the legal values"
    ):
        read_as(TARGETS, "name", read_yaml(target))
    with pytest.raises(
        DeclarationError, match=r"camera\.yaml:1:7: `kind` is .*none of the legal values"
    ):
        read_camera(camera)
    camera.write_text("name: a\n")
    with pytest.raises(DeclarationError, match="lacks the key `kind`"):
        read_camera(camera)


@pytest.mark.parametrize(
    ("settings", "expected"),
    [
        ({"surfce": {"degree": 3}}, ["unknown key `surfce`", "did you mean: surface"]),
        (
            {"surface": {"degree": 99}},
            ["`surface.degree` is 99: it should be less than or equal to"],
        ),
        (
            {"surface": {"degree": "x"}, "extra": 1},
            ['`surface.degree` is "x"', "unknown key `extra`"],
        ),
        ({"crop": {"kind": "bax"}}, ['`crop.kind` is "bax"', "did you mean: box"]),
    ],
)
def test_settings_from_options_are_refused_in_the_same_words(
    settings: dict[str, Any], expected: list[str]
) -> None:
    with pytest.raises(UserError) as caught:
        load_detector("thesis", settings)
    message = str(caught.value)
    assert message.startswith("settings of detector 'thesis':\n")
    for words in expected:
        assert words in message
    for raw in ("Input should be", "Extra inputs", "pydantic"):
        assert raw not in message


def test_settings_below_a_key_are_told_with_their_whole_path() -> None:
    data = {"merge": {"kind": "fusion", "step_mm": 1}, "registration": {"method": "ipc"}}
    with pytest.raises(UserError) as caught:
        settings_of(MappingConfig, data, "settings of the mapping", "mapping")
    assert "unknown key `step_mm` in `mapping.merge`" in str(caught.value)
    assert '`mapping.registration.method` is "ipc"' in str(
        caught.value
    ) and "did you mean: icp" in str(caught.value)


@pytest.mark.parametrize(
    ("text", "fix"),
    [
        ("name: a\nfinish: matte\n", "indent `finish` as the keys of `board`, where it belongs"),
        ("board: {name: a}\n", "indent `name` as the keys at the left margin, where it belongs"),
        ("name: a\nboard: {}\nnothing: 3\n", None),
    ],
)
def test_a_key_that_is_indented_wrongly(text: str, fix: str | None) -> None:
    unknown = [message for message in messages(text) if "unknown key" in message]
    assert len(unknown) == 1
    assert unknown[0].partition("to do: ")[2] == (fix or "")


@pytest.mark.parametrize(
    ("text", "fix"),
    [
        ("board:\n  flag: true\n code: ab\n", "begin in the same column"),
        ("board:\n\tflag: true\n", "indent with spaces, not with tabs"),
        ("board: flag: true\n", "on lines of their own, indented further"),
        ("board: [1\n", None),
    ],
)
def test_yaml_whose_indentation_is_wrong(text: str, fix: str | None) -> None:
    with pytest.raises(DeclarationError) as caught:
        parse_yaml(text, "x.yaml")
    (problem,) = caught.value.problems
    assert (problem.fix is None) == (fix is None)
    assert (fix or "") in (problem.fix or "")


def test_a_file_that_is_not_there_has_the_nearest_name(tmp_path: Path) -> None:
    (tmp_path / "panels.yaml").write_text("name: a\n")
    with pytest.raises(DeclarationError, match=r"did you mean: .*panels\.yaml"):
        read_yaml(tmp_path / "panel.yaml")
