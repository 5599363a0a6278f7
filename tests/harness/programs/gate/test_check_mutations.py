"""The gate against faults put into detector and camera: each must fail it, another draw of the
noise must not.

The program and its rule are those of CI; the study is `experiments/regression.yaml` with fewer
boards, sizes about the limit, one frame and no reflected light, since five faults and two honest
runs of it must fit into a test. Renders are shared: they depend on neither detector, nor the
sensor's noise, nor its seed.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass
from io import StringIO
from pathlib import Path

import pytest

from harness.programs.gate import check
from tests.support.mutated_detectors import write_mutants

pytestmark = pytest.mark.slow  # a study of twenty boards for each fault

ROOT = Path(__file__).resolve().parents[4]
SMALLER = (
    "study.boards=20",
    # about the limit: the same holes say more of its changes
    "source.target.damage.diameter_mm=[2.5, 6.5]",
    "study.hole_free_boards=16",
    "threshold.calibrate.boards=20",
    "source.render.bounces=0",
    "sweep={capture.frames: [1]}",
)
DOUBLED_NOISE = (
    # a quarter of the light doubles the noise of photons, which is all but a few per cent of a
    # frame's
    "source.camera.numbers={photons.signal_electrons: 292.0}",
    "source.camera.fixed_pattern_scale=2.0",
)


@dataclass(frozen=True)
class Checked:
    """What one run of the program gave."""

    code: int
    said: str
    data: dict


class Gate:
    """The program with a baseline, results and renders of its own; its trials run in this process,
    which saves the start of four for each check."""

    def __init__(self, home: Path) -> None:
        self.home = home

    def check(self, *changed: str, update: bool = False) -> Checked:
        arguments = [
            str(ROOT / "experiments" / "regression.yaml"),
            "--baseline",
            str(self.home / "baseline.json"),
        ]
        arguments += [
            "--out",
            str(self.home / "results"),
            "--serial",
            *(["--update"] if update else []),
        ]
        for mutation in (*SMALLER, *changed):
            arguments += ["--set", mutation]
        with redirect_stdout(StringIO()) as out, redirect_stderr(StringIO()) as errors:
            code = check.main(arguments)
        lines = out.getvalue().splitlines()
        written = [line.split(": ", 1)[1] for line in lines if line.startswith("comparison with")]
        data = json.loads(Path(written[0]).with_name("compare.json").read_text()) if written else {}
        return Checked(code, out.getvalue() + errors.getvalue(), data)


@pytest.fixture(scope="module")
def gate(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Gate]:
    home = tmp_path_factory.mktemp("gate")
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(write_mutants(home / "plug_ins")))
        gate = Gate(home)
        first = gate.check(update=True)
        assert first.code == 0, first.said
        yield gate


@pytest.mark.parametrize(
    ("changed", "why"),
    [
        pytest.param(("detector.name=halved",), "a90", id="halved sensitivity"),
        pytest.param(DOUBLED_NOISE, "signals", id="doubled sensor noise"),
        pytest.param(("detector.name=shifted",), "a90", id="threshold too high"),
        pytest.param(("detector.name=lowered",), "false calls", id="threshold too low"),
        pytest.param(("detector.name=cropped",), "a90", id="broken crop"),
    ],
)
def test_a_fault_fails_the_gate(gate, changed, why):
    checked = gate.check(*changed)
    assert checked.code == 1, checked.said
    (row,) = checked.data["set_ups"]
    assert row["mark"] in ("worse", "newly failing") and row["why"].startswith((why, "no limit")), (
        row
    )
    assert "the check fails" in checked.said


def test_another_draw_of_the_noise_passes(gate):
    checked = gate.check("seed=7")
    assert checked.code == 0, checked.said
    (row,) = checked.data["set_ups"]
    assert row["changed"] == ["other frames of the same boards"] and row["a90_change"]["paired"]
    assert row["hits"]["only_first"] + row["hits"]["only_second"] > 0, (
        "the noise was not drawn again"
    )
