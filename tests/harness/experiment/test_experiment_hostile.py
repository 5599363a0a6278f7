"""Whatever stands in place of a value of an experiment: one message of plain words, or a valid
experiment."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from harness.experiment.load import load_experiment
from harness.experiment.unfold import set_path
from harness.vocabulary.declaration.yaml_source import parse_yaml, to_yaml
from harness.vocabulary.errors import UserError
from tests.harness.experiment.test_experiment_paths import paths_in

FOLDER = Path(__file__).resolve().parents[3] / "experiments"
WRITTEN = {
    name: parse_yaml((FOLDER / f"{name}.yaml").read_text(), name).data
    for name in ("crack", "detectors", "smoke")
}
ODD: tuple[Any, ...] = (
    None, True, 0, -1, 10**400, -(10**30), 1e308, 1e-320, float("inf"), float("nan"), "", "x", "\u202e", "a" * 5000,
    "/dev/zero", "1e5", [], {}, [[]], [{}], [None], [1] * 200, {"kind": 1}, {"kind": "none"}, {"name": [1]},
    {"name": "thesis"}, {"1": 2}, {"a": {"b": [{}]}}, {"kind": "cylinder"},
)  # fmt: skip
AXES = (
    "capture.frames", "capture", "source", "source.target", "source.target.damage", "source.target.damage.0",
    "source.target.board.shape", "source.camera.name", "source.camera.numbers", "detector.settings",
    "detector.settings.surface", "matching.radius_mm", "threshold", "study", "sweep", "sweep.x", "", "..", "a.b",
)  # fmt: skip
odd = st.sampled_from(ODD)


def told(path: Path, *overrides: str) -> str:
    """Return what is said of a file; nothing of a valid one."""
    try:
        load_experiment(path, overrides)
    except UserError as mistake:
        return str(mistake)
    return ""


def in_plain_words(said: str) -> bool:
    return not any(
        word in said
        for word in ("Traceback", "pydantic", "Input should", "For further information")
    )


@settings(
    max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(name=st.sampled_from(sorted(WRITTEN)), value=odd, draw=st.data())
def test_an_odd_value_anywhere(tmp_path: Path, name: str, value: Any, draw: st.DataObject) -> None:
    path = draw.draw(st.sampled_from(paths_in(WRITTEN[name])))
    (tmp_path / "x.yaml").write_text(to_yaml(set_path(WRITTEN[name], path, value)))
    printed = told(tmp_path / "x.yaml")
    assert in_plain_words(printed) and (not printed or "x.yaml" in printed)


@settings(
    max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(axis=st.sampled_from(AXES), values=odd | st.lists(odd, min_size=1, max_size=3))
def test_an_odd_axis(tmp_path: Path, axis: str, values: Any) -> None:
    (tmp_path / "x.yaml").write_text(to_yaml({**WRITTEN["smoke"], "sweep": {axis: values}}))
    assert in_plain_words(told(tmp_path / "x.yaml"))


@pytest.mark.parametrize(
    "vary",
    ["{path: seed, values: [1]}", "[{path: 1, values: 2}, [], null]", "[{label: [], set: 3}]"],
)
@pytest.mark.parametrize("frames", ["[]", "1", "[x]", "{a: 1}", f"[{10**30}]"])
def test_odd_variations(tmp_path: Path, vary: str, frames: str) -> None:
    text = (
        to_yaml(WRITTEN["smoke"])
        + f"\nsensitivity: {{repeats: 1, frames: {frames}, vary: {vary}}}\n"
    )
    (tmp_path / "x.yaml").write_text(text)
    printed = told(tmp_path / "x.yaml")
    assert "`sensitivity" in printed and in_plain_words(printed)


@pytest.mark.parametrize(
    "written", ["[", "{a: 1}", "[1, 2]", "1e400", "!!int x", "*a", "&a [*a]", "9" * 500, "\x00"]
)
@pytest.mark.parametrize(
    "path", ["capture.frames", "source.target", "sweep", "seed", "..", "detector.settings"]
)
def test_an_odd_override(path: str, written: str) -> None:
    printed = told(FOLDER / "smoke.yaml", f"{path}={written}")
    assert "--set" in printed and in_plain_words(printed)
