"""Reading YAML: YAML 1.2's types, the place of everything, and one clear message for every bad
text."""

from __future__ import annotations

import math
import pickle
from itertools import pairwise
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from harness.vocabulary.declaration.yaml_source import (
    MAX_BYTES,
    MAX_DEPTH,
    DeclarationError,
    parse_yaml,
    read_yaml,
    to_yaml,
)


def refused(text: str) -> str:
    with pytest.raises(DeclarationError) as caught:
        parse_yaml(text, "x.yaml")
    return str(caught.value)


def refused_file(path: Path) -> str:
    with pytest.raises(DeclarationError) as caught:
        read_yaml(path)
    return str(caught.value)


@pytest.mark.parametrize(
    ("written", "value"),
    [
        ("1e-3", 0.001),
        ("+2.5E3", 2500.0),
        ("1.", 1.0),
        ("12", 12),
        ("012", 12),
        ("0o14", 12),
        ("0x1F", 31),
        ("-1", -1),
        ("true", True),
        ("False", False),
        ("yes", "yes"),
        ("off", "off"),
        ("2024-01-01", "2024-01-01"),
        ("12:30:45", "12:30:45"),
        ("'5'", "5"),
        ("null", None),
        ("~", None),
        ("", None),
        (".inf", math.inf),
        ("-.INF", -math.inf),
        ("[1, {a: b}]", [1, {"a": "b"}]),
        ("!!str 5", "5"),
        ("!!float 5", 5.0),
    ],
)
def test_values_are_those_of_yaml_1_2(written: str, value: object) -> None:
    read = parse_yaml(f"key: {written}\n", "x.yaml").data["key"]
    assert read == value
    assert type(read) is type(value)


def test_nan_is_read_as_a_number() -> None:
    assert math.isnan(parse_yaml("a: .nan", "x").data["a"])


def test_places_of_keys_and_values() -> None:
    source = parse_yaml("a:\n  b: [10, {c: 'x'}]\n  é: 3\n", "x.yaml")
    positions = {
        path: (value.line, value.column, value.width) for path, value in source.values.items()
    }
    assert positions[("a", "b", 0)] == (2, 7, 2)
    assert positions[("a", "b", 1, "c")] == (2, 15, 3)
    assert positions[("a", "é")] == (3, 6, 1)
    assert (source.keys[("a", "b", 1, "c")].line, source.keys[("a", "b", 1, "c")].column) == (2, 12)
    assert source.key_place_of(("a", "é")).head == "x.yaml:3:3"


def test_a_default_has_the_place_of_what_encloses_it() -> None:
    source = parse_yaml("a:\n  b: 1\n", "x.yaml")
    assert source.place_of(("a", "missing", "deep")) == source.place_of(("a",))
    assert source.place_of(("nothing",)).head == "x.yaml:1:1"


def test_windows_line_ends_and_byte_order_mark(tmp_path: Path) -> None:
    path = tmp_path / "x.yaml"
    path.write_bytes(b"\xef\xbb\xbfa: 1\r\nb: 2\r\n")
    source = read_yaml(path)
    assert source.data == {"a": 1, "b": 2}
    assert (source.place_of(("b",)).line, source.place_of(("b",)).column) == (2, 4)


def test_all_duplicate_keys_with_both_places() -> None:
    message = refused("a: 1\nb: {c: 1, c: 2}\na: 3\n")
    assert "x.yaml: 2 problems; nothing was run" in message
    assert (
        "x.yaml:2:11: duplicate key `c`\n"
        "    2 | b: {c: 1, c: 2}\n"
        "      |           ^\n"
        "  already written at x.yaml:2:5\n"
        "    2 | b: {c: 1, c: 2}\n"
        "      |     ^\n"
        "  to do: keep one"
    ) in message
    assert "x.yaml:3:1: duplicate key `a`" in message
    assert "already written at x.yaml:1:1" in message


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("a: [1,\nb: 2", "x.yaml:2:5: not valid YAML"),
        ("a: [1,\nb: 2", "which began at x.yaml:1:4"),
        ("a: 1\n  b: 2", "x.yaml:2:4: not valid YAML: mapping values are not allowed here"),
        ("a:\n\tb: 1", "x.yaml:2:1: not valid YAML"),
        ("a: 1\n---\nb: 2", "x.yaml:2:1: not valid YAML: expected a single document"),
        ("a: 1\nb: *no", "x.yaml:2:4: not valid YAML: found undefined alias 'no'"),
        ("a: 1\nb: \x00", "x.yaml:2:4: character U+0000 is not allowed in YAML"),
        (
            "a: !!python/object:os.system ls",
            "x.yaml:1:4: the tag !!python/object:os.system is not supported",
        ),
        ("a: !mine {b: 1}", "x.yaml:1:4: the tag !mine is not supported"),
        ("a: !!set {b}", "x.yaml:1:4: the tag !!set is not supported"),
        ("a: !!int zz", "x.yaml:1:4: 'zz' cannot be read as int"),
        ("a: !!bool maybe", "x.yaml:1:4: 'maybe' cannot be read as bool"),
        ('a: "\\ud800"', "x.yaml:1:4:"),
        ("ok: 1\n1: 2", "x.yaml:2:1: a key must be text"),
        ("? [a]\n: 1", "x.yaml:1:3: a key must be text"),
        ("a: &a {q: 1}\nb:\n  <<: *a", "x.yaml:3:3: merge keys (`<<`) are not part of YAML 1.2"),
        ("a: &x [*x]", "x.yaml:1:4: an alias refers to a value that contains it"),
        ("%YAML 1.1\n---\na: yes", "x.yaml:1:1: only YAML 1.2 is supported"),
        ("a: " + "[" * 60 + "]" * 60, f"x.yaml:1:{3 + MAX_DEPTH}: nested too deeply"),
        ("a: " + "[" * 300_000, f"x.yaml:1:{3 + MAX_DEPTH}: nested too deeply"),
    ],
)
def test_bad_text_is_one_message_with_its_place(text: str, expected: str) -> None:
    message = refused(text)
    assert expected in message
    assert "1 problem;" in message


def test_an_alias_of_a_value_is_read_and_keeps_the_place_of_the_anchor() -> None:
    source = parse_yaml("a: &s {x: 1}\nb: *s\n", "x")
    assert source.data == {"a": {"x": 1}, "b": {"x": 1}}
    assert source.place_of(("b", "x")).head == "x:1:11"


def test_an_alias_bomb_is_stopped() -> None:
    names = "abcdefghij"
    text = "a: &a [x,x,x,x,x,x,x,x,x,x]\n"
    text += "".join(
        f"{new}: &{new} [{','.join([f'*{old}'] * 10)}]\n" for old, new in pairwise(names)
    )
    assert "too many values" in refused(text)


def test_missing_file_names_those_beside_it(tmp_path: Path) -> None:
    (tmp_path / "averaging.yaml").write_text("a: 1")
    message = refused_file(tmp_path / "avergaing.yaml")
    assert "there is no such file" in message
    assert str(tmp_path / "averaging.yaml") in message


def test_a_folder_is_no_file(tmp_path: Path) -> None:
    assert "this is a folder, not a YAML file" in refused_file(tmp_path)


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        (b"", ":1:1: the file is empty"),
        (b"# only a comment\n", ":1:1: the file is empty"),
        (b"- 1\n- 2\n", ":1:1: the file does not hold a mapping at its top level"),
        (b"a: 1\nb: \xff\n", ":2:4: byte 0xff is not UTF-8"),
    ],
)
def test_bad_files(tmp_path: Path, content: bytes, expected: str) -> None:
    path = tmp_path / "x.yaml"
    path.write_bytes(content)
    assert f"{path}{expected}" in refused_file(path)


def test_a_file_that_is_too_large_is_not_parsed(tmp_path: Path) -> None:
    path = tmp_path / "x.yaml"
    path.write_bytes(b"a: 1\n" * (MAX_BYTES // 5 + 1))
    assert "the file is too large for a declaration\n  legal: at most 500000 bytes" in refused_file(
        path
    )


def test_an_experiment_error_survives_pickling() -> None:
    with pytest.raises(DeclarationError) as caught:
        parse_yaml("a: 1\na: 2", "x.yaml")
    copied = pickle.loads(pickle.dumps(caught.value))
    assert isinstance(copied, DeclarationError)
    assert (str(copied), copied.problems) == (str(caught.value), caught.value.problems)


def test_a_long_line_is_cut_around_the_caret() -> None:
    message = refused("a: '" + "x" * 500 + "', a: !no 1")
    lines = message.splitlines()
    caret = next(line for line in lines if "^" in line)
    assert max(map(len, lines[3:])) < 130
    assert caret.index("^") < 130


def test_control_characters_never_reach_the_terminal() -> None:
    message = refused("a: '\x85'\nb: \x1b[31m")
    assert "\x1b" not in message
    assert "U+001B" in message


plain = st.recursive(
    st.none()
    | st.booleans()
    | st.integers(-(10**12), 10**12)
    | st.floats(allow_nan=False)
    | st.text(st.characters(codec="utf-8", exclude_categories=["Cc", "Cs"]), max_size=12)
    | st.sampled_from(
        [
            "yes",
            "1e-3",
            "1e3",
            "null",
            "~",
            "0x1F",
            "1_000",
            "2024-01-01",
            "a: b # c",
            "<<",
            "- x",
            " ",
        ]
    ),
    lambda inner: (
        st.lists(inner, max_size=3)
        | st.dictionaries(st.from_regex(r"\A[a-z_][a-z0-9_.]{0,8}\Z"), inner, max_size=3)
    ),
    max_leaves=8,
)


@settings(max_examples=30, deadline=None)
@given(data=st.dictionaries(st.from_regex(r"\A[a-z_]{1,6}\Z"), plain, min_size=1, max_size=4))
def test_what_is_written_is_read_back(data: dict[str, object]) -> None:
    read = parse_yaml(to_yaml(data), "x").data
    assert read == data
    assert repr(read) == repr(data)  # 1 is not 1.0 is not True
