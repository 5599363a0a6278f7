"""Dotted paths: setting one value changes that value and nothing else; ``--set`` reads YAML and
points to itself."""

from __future__ import annotations

import copy
from collections.abc import Iterable
from typing import Annotated, Any, Literal

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import Field

from harness.experiment.unfold import PathError, key_path, overridden, set_path
from harness.vocabulary.config import Config
from harness.vocabulary.declaration import shape
from harness.vocabulary.declaration.yaml_source import KeyPath, Source, parse_yaml


class Backing(Config):
    kind: Literal["plane"] = "plane"
    distance_mm: float = 20.0
    albedo: float = 0.5


class Wall(Config):
    kind: Literal["wall"]


class Target(Config):
    backing: Annotated[Backing | Wall, Field(discriminator="kind")] = Backing(albedo=0.7)
    nothing: Backing | None = None
    distances: tuple[float, ...] = (1.0,)


class Whole(Config):
    name: str = "a"
    frames: int = 1
    target: Target = Field(default_factory=Target)
    sweep: dict[str, tuple[Any, ...]] = Field(default_factory=dict)


def declared_of(data: Any) -> shape.Declared:
    return shape.Declared(Whole, data, {})


def override(text: str, *overrides: str) -> tuple[Source, list[str]]:
    source, problems = overridden(parse_yaml(text, "x.yaml"), overrides, declared_of)
    return source, [str(problem) for problem in problems]


keys = st.text("abcd_", min_size=1, max_size=3)
scalars = st.none() | st.integers(-9, 9) | st.floats(allow_nan=False) | st.text("xyz", max_size=2)
trees = st.recursive(
    scalars,
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(keys, inner, max_size=3),
    max_leaves=12,
)


def paths_in(data: Any, above: KeyPath = ()) -> list[KeyPath]:
    inner: Iterable[tuple[Any, Any]] = ()
    if isinstance(data, dict):
        inner = data.items()
    elif isinstance(data, list):
        inner = enumerate(data)
    paths = []
    for key, value in inner:
        path = (*above, key)
        paths.append(path)
        paths += paths_in(value, path)
    return paths


@settings(max_examples=30, deadline=None)
@given(data=st.dictionaries(keys, trees, min_size=1, max_size=4), value=trees, draw=st.data())
def test_set_then_get_and_nothing_else_changes(
    data: dict[str, Any], value: Any, draw: st.DataObject
) -> None:
    path = draw.draw(st.sampled_from(paths_in(data)))
    before = copy.deepcopy(data)
    old = shape.get(data, path)
    changed = set_path(data, path, value)
    assert shape.get(changed, path) == value
    assert data == before
    assert set_path(changed, path, old) == before
    remaining = [
        candidate
        for candidate in paths_in(data)
        if candidate[: len(path)] != path and path[: len(candidate)] != candidate
    ]
    assert all(
        shape.get(changed, candidate) is shape.get(data, candidate) for candidate in remaining
    )
    assert key_path(".".join(map(str, path))) == path


@settings(max_examples=30, deadline=None)
@given(data=st.dictionaries(keys, trees, max_size=3), key=keys, value=trees)
def test_a_new_key_is_added(data: dict[str, Any], key: str, value: Any) -> None:
    assert set_path(data, (key,), value) == {**data, key: value}


@pytest.mark.parametrize(
    ("text", "path"),
    [
        ("a", ("a",)),
        ("a.b.2.c", ("a", "b", 2, "c")),
        ("sweep.capture.frames", ("sweep", "capture.frames")),
        ("sweep", ("sweep",)),
        ("a..b", ("a", "", "b")),
    ],
)
def test_key_path(text: str, path: KeyPath) -> None:
    assert key_path(text) == path


@pytest.mark.parametrize(
    ("path", "message"),
    [
        (("a", "x", "y"), "there is no `x`"),
        (("l", 5), "the list has no item 5; it has 2, counted from 0"),
        (("l", "x"), "`l` is a list here, which has no `x`"),
        (("s", "x"), "`s` is 3 here, which has no `x`"),
        (("n", "x"), "`n` is null here, which has no `x`"),
    ],
)
def test_a_barred_way_is_refused(path: KeyPath, message: str) -> None:
    with pytest.raises(PathError) as caught:
        set_path({"a": {}, "l": [1, 2], "s": 3, "n": None}, path, 1)
    assert caught.value.message == message


def test_a_missing_mapping_is_filled_with_its_declared_default() -> None:
    changed = set_path({}, ("target", "backing", "distance_mm"), 50.0, declared_of({}))
    assert changed["target"]["backing"] == {"kind": "plane", "distance_mm": 50.0, "albedo": 0.7}


def test_override_values_are_yaml_and_have_their_place() -> None:
    source, problems = override(
        "name: b\nframes: 3\n",
        "frames=1_000",
        "target={distances: [1e-3, 2]}",
        "sweep.target.distances=[[1], [2]]",
        "name='5'",
    )
    assert problems == []
    assert source.data == {
        "name": "5",
        "frames": 1000,
        "target": {"distances": [0.001, 2]},
        "sweep": {"target.distances": [[1], [2]]},
    }
    position = source.place_of(("target", "distances", 1))
    assert (position.head, position.line_text, position.column) == (
        "--set",
        "target={distances: [1e-3, 2]}",
        27,
    )
    assert source.place_of(("name",)).head == "--set"


@pytest.mark.parametrize(
    ("option", "expected"),
    [
        (
            "frmes=3",
            (
                "--set: unknown path `frmes`: unknown key `frmes`\n      | frmes=3\n      | "
                "^~~~~\n  did you mean: frames"
            ),
        ),
        ("target.bakcing.albedo=1", "did you mean: target.backing.albedo"),
        (
            "target.backing.albdo=1",
            "did you mean: target.backing.albedo\n  legal: kind, distance_mm, albedo",
        ),
        ("target.backing.distance_mm=[1", "      | target.backing.distance_mm=[1\n"),
        ("target.distances.4=1", "the list has no item 4; it has 1, counted from 0"),
        ("target.nothing.albedo=1", "--set: `target.nothing` is null here, which has no `albedo`"),
        ("frames", "--set: not of the form path=value"),
        ("frames=", "to do: write null to state no value"),
        ("=3", "--set: not of the form path=value"),
        (
            "frames={a: 1, a: 2}",
            "--set: duplicate key `a`\n      | frames={a: 1, a: 2}\n      |               ^",
        ),
    ],
)
def test_a_bad_override_points_to_itself(option: str, expected: str) -> None:
    _, (problem,) = override("name: b", option)
    assert expected in problem


@pytest.mark.parametrize(
    ("text", "overrides"),
    [("sweep: {frames: [1, 2]}", ["frames=5"]), ("name: b", ["frames=5", "sweep.frames=[1, 2]"])],
)
def test_a_swept_key_cannot_be_overridden_in_vain(text: str, overrides: list[str]) -> None:
    _, (problem,) = override(text, *overrides)
    assert problem == (
        "--set: `frames` is an axis of the sweep, so this value would never be used\n"
        "      | frames=5\n"
        "      | ^~~~~~\n"
        "  to do: --set 'sweep.frames=[5]'"
    )


def test_all_bad_overrides_are_reported() -> None:
    _, problems = override("name: b", "x=1", "frames=2", "y=1")
    assert len(problems) == 2
