"""``tofpod validate``: the file of published figures, the judgement, the baseline, the program."""

from __future__ import annotations

import csv
import json
import subprocess
import sys
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError

from harness.evaluation.intervals import Interval
from harness.programs.scorecard import power, program
from harness.programs.scorecard.bench import Effort
from harness.programs.scorecard.figures import (
    SCORES,
    Published,
    Request,
    Score,
    measured,
    number,
    read_figures,
)
from harness.programs.scorecard.quantities import QUANTITIES, in_words
from harness.programs.scorecard.standings import standings
from harness.programs.scorecard.validate import main
from harness.stills.statistics import NOTHING, Reading
from harness.vocabulary.errors import UserError
from harness.vocabulary.provenance import GENERATOR, RESULTS_VERSION
from scenes.sensor.camera import camera_names

ROOT = Path(__file__).resolve().parents[4]

AZURE = "azure_kinect_nfov"
QUICK = Effort(noise_frames=20, few_frames=4, whole_frames=80, units=4)
GOOD = """
figures:
  - name: wall
    camera: azure_kinect_nfov
    quantity: temporal_sigma_mm
    conditions: {distance_m: 1.5, albedo: 0.8}
    published: {value: 0.89, tolerance: 0.06}
    source: a wall
    tag: M
    calibration: true
  - name: neighbours
    camera: azure_kinect_nfov
    quantity: noise_correlation
    conditions: {lag_x_px: 1, lag_y_px: 0}
    published: {above: 0.5}
    source: a filter
    tag: D
    calibration: false
"""


def written(folder: Path, text: str = GOOD) -> Path:
    path = folder / "figures.yaml"
    path.write_text(text)
    return path


def refusal(folder: Path, old: str, new: str) -> str:
    assert old in GOOD
    with pytest.raises(UserError) as caught:
        read_figures(written(folder, GOOD.replace(old, new, 1)))
    return str(caught.value)


# ---- the file of figures
# ---------------------------------------------------------------------------------------------


def test_the_projects_figures_are_legal_and_every_camera_has_blind_figures():
    figures = read_figures().figures
    assert len({figure.name for figure in figures}) == len(figures)
    blind = {figure.camera for figure in figures if figure.use == "blind"}
    assert blind == {figure.camera for figure in figures}
    # a variant whose edge filters alone differ has no figures of its own
    assert set(camera_names()) - blind == {"kinect_v2_libfreenect2"}


def test_defaults_fill_what_an_entry_leaves_out(tmp_path):
    _, neighbours = read_figures(written(tmp_path)).figures
    assert neighbours.request.conditions.to_data() == {
        "distance_m": 1.5,
        "albedo": 0.8,
        "angle_deg": 0.0,
        "ambient_uw_cm2_nm": 0.04,
        "amplitude_units": None,
        "exposure": 1.0,
        "lag_x_px": 1,
        "lag_y_px": 0,
    }
    assert neighbours.what() == "noise correlation, 1.5 m, albedo 0.8, lag (1, 0) px"


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        (
            "camera: azure_kinect_nfov",
            "camera: azure_kinect",
            ["figures.yaml:4:", "did you mean: azure_kinect_nfov"],
        ),
        (
            "temporal_sigma_mm",
            "temporal_sigma",
            ["figures.yaml:5:", "did you mean: temporal_sigma_mm"],
        ),
        ("albedo: 0.8", "albedo: 80", ["figures.yaml:6:", "less than or equal to 1"]),
        ("albedo: 0.8", "step_mm: 5", ["unknown key `step_mm`", "distance_m, albedo, angle_deg"]),
        (", tolerance: 0.06", "", ["a value needs a tolerance"]),
        ("{above: 0.5}", "{above: 0.7, below: 0.5}", ["the bound `above` must be less"]),
        ("{above: 0.5}", "{}", ["give either `value`, or one or both"]),
        (
            "{above: 0.5}",
            "{value: 0.5, tolerance: 0.1, below: 0.7}",
            ["give either `value`, or one or both"],
        ),
        ("{above: 0.5}", "{above: .nan}", ["figures.yaml:15:", "a number"]),
        ("tag: M", "tag: X", ["figures.yaml:9:", "one of R, D, S, W, M"]),
        ("    calibration: true\n", "", ["lacks the key `calibration`"]),
        ("calibration: true", "calibration: yes", ["write true"]),
        ("name: neighbours", "name: wall", ["two figures have the name wall", "first used at"]),
        ("name: wall", "name: A wall", ["figures.yaml:3:", "[a-z0-9_]"]),
        ("source: a wall", "sauce: a wall", ["unknown key `sauce`", "did you mean: source"]),
    ],
)
def test_a_mistake_in_the_file_is_named_with_its_place(tmp_path, old, new, says):
    text = refusal(tmp_path, old, new)
    for words in says:
        assert words in text
    assert "Traceback" not in text


def test_all_mistakes_are_told_at_once(tmp_path):
    text = GOOD.replace("azure_kinect_nfov", "azur", 1).replace("above: 0.5", "under: 0.5")
    with pytest.raises(UserError) as caught:
        read_figures(written(tmp_path, text))
    assert "`figures.0.camera`" in str(caught.value)
    assert "unknown key `under`" in str(caught.value)


@given(
    st.sampled_from(["value", "below", "above", "between"]),
    st.floats(-10, 10),
    st.floats(0, 3),
    st.floats(-20, 20),
)
@settings(max_examples=60, deadline=None)
def test_limits_are_the_bound_and_its_tolerance(kind, bound, tolerance, simulated):
    bounds = {"above": bound, "below": bound + 1} if kind == "between" else {kind: bound}
    low, high = Published.from_data({**bounds, "tolerance": tolerance}).limits(0.0, tolerance)
    expected = {
        "value": abs(simulated - bound) <= tolerance,
        "below": simulated <= bound + tolerance,
        "above": simulated >= bound - tolerance,
        "between": bound - tolerance <= simulated <= bound + 1 + tolerance,
    }[kind]
    edge = min(abs(simulated - low), abs(simulated - high)) < 1e-9
    assert edge or (low <= simulated <= high) == expected


def test_a_negative_tolerance_is_refused():
    with pytest.raises(ValidationError):
        Published.from_data({"value": 1.0, "tolerance": -0.1})


# ---- the judgement
# ------------------------------------------------------------------------------------------------


def test_verdicts(tmp_path):
    wall, neighbours = read_figures(written(tmp_path)).figures
    failing = wall.model_copy(update={"fails": "the wall is not known"})
    for figure, simulated, verdict in (
        (wall, Reading(1.11), "pass"),
        (wall, Reading(1.12), "FAIL (new)"),
        (failing, Reading(1.12), "fail"),
        (failing, NOTHING, "fail"),
        (neighbours, Reading(0.7), "pass"),
    ):
        score = Score(figure, simulated)
        assert score.verdict == verdict
        assert score.fell_behind == verdict.startswith("FAIL")


def test_a_check_of_the_code_passes_within_its_tolerance_only_and_is_counted_apart(tmp_path):
    path = written(
        tmp_path, GOOD.replace("calibration: true", "calibration: false\n    kind: code", 1)
    )
    check, reality = read_figures(path).figures
    assert check.limits == pytest.approx((0.83, 0.95))
    assert check.use == "code"
    value = GOOD.replace("{above: 0.5}", "{value: 0.5, tolerance: 0.2}", 1)
    _, wide = read_figures(written(tmp_path, value)).figures
    assert wide.limits == pytest.approx((0.3, 0.7))
    assert wide.use == "blind"
    assert reality.limits == (0.5, float("inf"))
    assert Score(reality, Reading(0.4)).ratio == pytest.approx(0.8)
    score = Score(wide, Reading(0.35))
    assert score.verdict == "pass (tolerance)"
    assert "0 of 1 values within 25 %, 1 by a wider tolerance of the source" in program._answer(
        [score]
    )
    answer = program._answer([Score(check, Reading(0.9)), Score(reality, Reading(0.4))])
    assert answer.startswith("0 of 1 blind figures pass; ")
    assert "1 of 1 checks of the code pass. Failures without a stated reason: neighbours." in answer


def test_the_table_tells_value_interval_published_and_source(tmp_path):
    figures = read_figures(written(tmp_path)).figures
    readings = Reading(0.9, Interval(0.88, 0.92)), Reading(0.7)
    lines = SCORES.grid(list(map(Score, figures, readings))).lines()
    assert len(lines) == 3
    for words in (
        "Azure Kinect DK NFOV unbinned",
        "1.5 m, albedo 0.8",
        "0.900",
        "0.880 to 0.920",
        "0.89 ± 0.06",
        "calibration",
        "[M] a",
    ):
        assert words in lines[1]
    assert "above 0.5" in lines[2]
    assert "1.40" in lines[2]
    assert "blind" in lines[2]


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (0.0, "0"),
        (1.0, "1.00"),
        (12.345, "12.3"),
        (1234.5, "1.23e+03"),
        (0.0123, "0.012"),
        (float("nan"), "none"),
    ],
)
def test_numbers_have_three_digits(value, text):
    assert number(value) == text


# ---- measuring
# ------------------------------------------------------------------------------------------------


def test_every_quantity_has_a_unit_in_its_name_and_is_on_file():
    assert {figure.quantity for figure in read_figures().figures} == set(QUANTITIES)
    for name, quantity in QUANTITIES.items():
        assert not quantity.unit or name.endswith(f"_{quantity.unit}")
        assert in_words(quantity.conditions())


@pytest.mark.slow  # processes of their own; the engine's tests compare them too
def test_numbers_do_not_depend_on_processes_or_order(tmp_path):
    quantity = QUANTITIES["temporal_sigma_mm"]
    requests = [
        Request(AZURE, quantity.name, quantity.conditions(albedo=albedo)) for albedo in (0.1, 0.3)
    ]
    requests += [figure.request for figure in read_figures(written(tmp_path)).figures]
    in_one_process = measured(requests, QUICK, jobs=1)
    two = measured(tuple(reversed(requests)), QUICK, jobs=2)
    assert set(in_one_process) == set(two) == set(requests)
    for request in requests:
        assert repr(in_one_process[request]) == repr(two[request]), request


# ---- the program
# ------------------------------------------------------------------------------------------------


def test_the_program_from_beginning_to_end(tmp_path, capsys, monkeypatch):
    """Two figures, few frames: files and exit 0; a figure that fails without a reason: exit 1,
    naming it."""
    monkeypatch.setattr(program, "FULL", QUICK)
    figures = written(tmp_path)
    out = tmp_path / "out"
    options = ["--jobs", "1", "--camera", AZURE]
    options += ["--figures", str(figures), "--out", str(out)]
    assert main(options) == 0
    printed = capsys.readouterr()
    assert "temporal deviation, 1.5 m, albedo 0.8" in printed.out
    # on a slow machine progress is told meanwhile
    assert all(line.startswith("measured ") for line in printed.err.splitlines())
    page = (out / "scorecard.html").read_text()
    assert f'<meta name="generator" content="{GENERATOR}">' in page
    assert page.count("<svg") == 1
    assert "http" not in page.replace("http://www.w3.org", "")
    scores = list(csv.DictReader((out / "scorecard.csv").open()))
    assert [row["name"] for row in scores] == ["wall", "neighbours"]
    assert float(scores[0]["low"]) < float(scores[0]["simulated"]) < float(scores[0]["high"])
    assert {row["results_version"] for row in scores} == {str(RESULTS_VERSION)}
    provenance = json.loads((out / "provenance.json").read_text())
    assert provenance["command"].startswith("tofpod validate --jobs 1")
    assert provenance["results_version"] == RESULTS_VERSION

    figures.write_text(
        GOOD.replace("{value: 0.89, tolerance: 0.06}", "{value: 2.0, tolerance: 0.06}")
    )
    assert main(options) == 1
    printed = capsys.readouterr()
    assert "wall (temporal deviation" in printed.err
    assert "neighbours (" not in printed.err

    figures.write_text(GOOD.replace("source: a filter", "source: a filter\n    fails: it did once"))
    assert main(options) == 0
    assert "neighbours passes now: remove `fails` from its entry" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("options", "says"),
    [
        (["--camera", "azure"], "there is no camera 'azure'"),
        (["--figures", "absent.yaml"], "absent.yaml"),
        (["--mask", "m.png"], "--mask belongs to a capture"),
        (["--capture", "x", "--figures", "own.yaml"], "--figures belongs to the scorecard"),
        (["--capture", "x", "--power"], "--power belongs to the scorecard"),
        (["--capture", "absent"], "absent: no such file or folder"),
        (
            ["--capture", "x", "--camera", "a", "--camera", "b"],
            "a capture comes from a single camera",
        ),
        (["--capture", "x", "--albedo", "0"], "--albedo 0"),
    ],
)
def test_a_mistake_of_the_user_is_one_message_and_exit_code_2(
    options, says, tmp_path, capsys, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    assert main(options) == 2
    assert says in capsys.readouterr().err


def test_help_is_instant():
    code = (
        "import sys; sys.argv = ['x', '--help']\nimport harness.programs.scorecard.validate as "
        "program\ntry: program.main()\nexcept SystemExit as end: assert end.code == 0\nheavy = "
        "{'mitsuba', 'drjit', 'open3d', 'matplotlib', 'pandas', 'scipy', 'numba', 'av', 'cv2', "
        "'numpy'}\nassert not heavy & set(sys.modules), heavy & set(sys.modules)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert "usage: tofpod validate" in done.stdout


# ---- strict values
# -----------------------------------------------------------------------------------------------


def test_strict_is_within_25_percent_whatever_the_tolerance(tmp_path):
    value = GOOD.replace("{above: 0.5}", "{value: 0.5, tolerance: 0.2}", 1)
    _, wide = read_figures(written(tmp_path, value)).figures
    _, bound = read_figures(written(tmp_path)).figures
    assert [Score(wide, Reading(x)).strict for x in (0.374, 0.376, 0.624, 0.626)] == [
        False,
        True,
        True,
        False,
    ]
    assert Score(bound, Reading(0.7)).strict is None
    assert [Score(wide, Reading(x)).grade for x in (0.4, 0.31, 0.29)] == [3, 2, 0]
    narrow = GOOD.replace("{above: 0.5}", "{value: 0.5, tolerance: 0.05}", 1)
    _, narrow_figure = read_figures(written(tmp_path, narrow)).figures
    assert [Score(narrow_figure, Reading(x)).grade for x in (0.54, 0.56, 0.63)] == [3, 2, 0]
    assert [Score(bound, Reading(x)).grade for x in (0.7, 0.3)] == [1, 0]
    (standing,) = standings([Score(wide, Reading(0.35)), Score(bound, Reading(0.7))])
    assert (standing.values, standing.strict, standing.by_tolerance) == (1, 0, 1)
    assert (standing.bounds, standing.bounds_hold) == (1, 1)


def test_power_compares_the_untested_constants_with_those_on_file(tmp_path, capsys, monkeypatch):
    """Constants of one camera, readings that nothing changes: all are untested."""
    stored = tmp_path / "untested.yaml"
    stored.write_text("{}\n")
    monkeypatch.setattr(power, "UNTESTED_FILE", stored)
    monkeypatch.setattr(program, "FULL", QUICK)
    monkeypatch.setattr(program.scoring, "FIGURES_FILE", written(tmp_path))
    same = {"value": 0.89, "interval": Interval(0.88, 0.9)}
    monkeypatch.setattr(
        power, "measured", lambda requests, *_: dict.fromkeys(requests, Reading(**same))
    )
    out = tmp_path / "out"
    options = ["--jobs", "1", "--power", "--out", str(out)]
    assert main(options) == 1
    printed = capsys.readouterr()
    assert (
        f"{AZURE}: photons.read_noise_electrons is untested (it changes: none) now" in printed.err
    )
    assert "0 of " in printed.out
    stored.write_text((out / "untested.yaml").read_text())
    assert main(options) == 0
    page = (out / "scorecard.html").read_text()
    assert "Untested constants" in page
    rows = list(csv.DictReader((out / "power.csv").open()))
    assert {row["verdict"] for row in rows} == {"untested", "not moved"}
    assert {row["camera"] for row in rows} == {AZURE}
