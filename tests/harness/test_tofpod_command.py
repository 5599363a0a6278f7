"""The command `tofpod`: its programs, their names as words, completion; experiments by name; the
wheel's contents."""

from __future__ import annotations

import importlib
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

from harness.__main__ import MODULES, PROGRAMS, TASKS, main
from harness.experiment.load import load_experiment

ROOT = Path(__file__).resolve().parents[2]


def test_every_program_is_in_the_documents(capsys):
    text = (ROOT / "docs" / "programs.md").read_text()
    names = [program.name for program in PROGRAMS]
    assert {name for name in names if f"tofpod {name} " not in text} == set()
    assert main([]) == 0
    shown = capsys.readouterr().out
    assert all(command in shown for _, command in TASKS) and all(name in shown for name in names)
    for _, command in TASKS:
        _, name, *remainder = command.split()
        importlib.import_module(MODULES[name]).main.parser().parse_args(remainder)


def test_a_program_runs_with_its_own_arguments_and_exit_code(tmp_path, capsys):
    assert main(["sweep", "smoke", "--dry-run", "--out", str(tmp_path)]) == 0
    assert "smoke: valid" in capsys.readouterr().out
    assert main(["sweep", "smok", "--out", str(tmp_path)]) == 2
    assert "there is no such file or experiment; did you mean 'smoke'?" in capsys.readouterr().err
    assert main(["swep"]) == 2
    assert "did you mean sweep?" in capsys.readouterr().err
    assert main(["completion", "fish"]) == 2
    assert not list(tmp_path.iterdir())


def test_an_experiment_is_named_by_path_or_name(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    by_name = load_experiment(Path("averaging"))
    assert by_name.digest == load_experiment(ROOT / "experiments" / "averaging.yaml").digest
    (tmp_path / "detectors").mkdir()
    assert load_experiment(Path("detectors")).config.name == "detectors", (
        "though a folder has this name"
    )
    # a file of this name in the current folder counts first
    (tmp_path / "averaging.yaml").write_text((ROOT / "experiments" / "smoke.yaml").read_text())
    assert load_experiment(Path("averaging.yaml")).config.name == "smoke"


def test_completion_is_a_script_that_knows_programs_and_options(capsys):
    assert main(["completion", "bash"]) == 0
    script = capsys.readouterr().out
    ask = 'COMP_WORDS=(tofpod {}); COMP_CWORD={}; _tofpod; echo "${{COMPREPLY[@]}}"'
    for words, position, wanted in (
        ("sw", 1, "sweep"),
        ("sweep --ca", 2, "--calibration --cache-limit"),
        ("sweep aver", 2, "averaging"),
        ("ask --camera kinect_v2_", 3, "kinect_v2_libfreenect2"),
    ):
        ran = subprocess.run(
            ["bash", "-c", script + ask.format(words, position)],
            capture_output=True,
            text=True,
            check=True,
        )
        assert ran.stdout.strip() == wanted


@pytest.mark.slow
def test_the_wheel_holds_experiments_baselines_cameras_and_the_command(tmp_path):
    pip = [
        sys.executable,
        "-m",
        "pip",
        "wheel",
        "-q",
        "--no-deps",
        "--no-build-isolation",
        "-w",
        str(tmp_path),
    ]
    subprocess.run([*pip, str(ROOT)], check=True, capture_output=True, timeout=900)
    names = zipfile.ZipFile(next(tmp_path.glob("*.whl"))).namelist()
    for folder, pattern in (
        ("experiments", "*.yaml"),
        ("results/baselines", "*.json"),
        ("scenes/cameras", "*.yaml"),
    ):
        for path in (ROOT / folder).glob(pattern):
            assert any(name.endswith(f"{Path(folder).name}/{path.name}") for name in names), path
    top = {name.split("/")[0] for name in names}
    assert {name for name in top if "." not in name} == {"harness", "scenes", "detectors"}
