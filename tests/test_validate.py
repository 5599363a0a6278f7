"""``python -m harness.validate``: the file of published figures, the judgement, the baseline, the program."""

from __future__ import annotations

import csv
import json
import subprocess
import sys
from functools import lru_cache
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError

from harness.evaluation.intervals import Interval
from harness.scorecard import program
from harness.scorecard.bench import NOTHING, Effort, Reading
from harness.scorecard.figures import (
    BASELINE_FILE,
    DRAWN,
    FIGURES_FILE,
    SCORES,
    Figure,
    Published,
    judged,
    measured,
    number,
    read_baseline,
    read_figures,
    write_baseline,
)
from harness.scorecard.quantities import QUANTITIES, in_words
from harness.validate import main
from harness.vocabulary.errors import UserError
from harness.vocabulary.provenance import GENERATOR, RESULTS_VERSION
from scenes.sensor.camera import camera_names

ROOT = Path(__file__).resolve().parents[1]

AZURE = "azure_kinect_nfov"
QUICK = Effort(noise_frames=20, few_frames=4, whole_frames=80, units=4)
BASELINE = '{"scorecard_version": 1, "figures": {%s}}'
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


# ---- the file of figures ---------------------------------------------------------------------------------------------


def test_the_projects_figures_are_legal_and_every_camera_has_blind_figures():
    figures = read_figures()
    assert len({figure.name for figure in figures}) == len(figures)
    blind = {figure.camera for figure in figures if figure.use == "blind"}
    assert blind == {figure.camera for figure in figures}
    # a variant whose edge filters alone differ has no figures of its own
    assert set(camera_names()) - blind == {"kinect_v2_libfreenect2"}
    assert {figure.camera for figure in figures if figure.calibration} >= set(DRAWN)


def test_defaults_fill_what_an_entry_leaves_out(tmp_path):
    _, neighbours = read_figures(written(tmp_path))
    assert neighbours.request[2].to_data() == {
        "distance_m": 1.5,
        "albedo": 0.8,
        "angle_deg": 0.0,
        "ambient_uw_cm2_nm": 0.04,
        "amplitude_units": None,
        "lag_x_px": 1,
        "lag_y_px": 0,
    }
    assert neighbours.what() == "noise correlation, 1.5 m, albedo 0.8, lag (1, 0) px"


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ("camera: azure_kinect_nfov", "camera: azure_kinect", ["figures.yaml:4:", "did you mean: azure_kinect_nfov"]),
        ("temporal_sigma_mm", "temporal_sigma", ["figures.yaml:5:", "did you mean: temporal_sigma_mm"]),
        ("albedo: 0.8", "albedo: 80", ["figures.yaml:6:", "less than or equal to 1"]),
        ("albedo: 0.8", "step_mm: 5", ["unknown key `step_mm`", "distance_m, albedo, angle_deg"]),
        (", tolerance: 0.06", "", ["a value needs a tolerance"]),
        ("{above: 0.5}", "{above: 0.5, below: 0.7}", ["exactly one of value, below, above and between"]),
        ("{above: 0.5}", "{}", ["exactly one of value, below, above and between"]),
        ("{above: 0.5}", "{between: [0.7, 0.5]}", ["the first bound must be below the second"]),
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
    assert "`figures.0.camera`" in str(caught.value) and "unknown key `under`" in str(caught.value)


@given(
    st.sampled_from(["value", "below", "above", "between"]),
    st.floats(-10, 10),
    st.floats(0, 3),
    st.floats(-20, 20),
)
@settings(max_examples=60, deadline=None)
def test_limits_are_the_bound_and_its_tolerance(kind, bound, tolerance, simulated):
    told = {kind: (bound, bound + 1) if kind == "between" else bound, "tolerance": tolerance}
    low, high = Published.from_data(told).limits()
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


# ---- the judgement and the baseline ----------------------------------------------------------------------------------


def scores_of(figures: tuple[Figure, ...], wall: Reading, baseline: dict[str, bool] | None = None):
    return judged(figures, {"wall": wall, "neighbours": Reading(0.7)}, baseline or {})


def test_verdicts(tmp_path):
    figures = read_figures(written(tmp_path))
    for simulated, before, verdict in (
        (Reading(1.11), None, "pass"),
        (Reading(1.12), None, "fail"),
        (Reading(1.12), False, "fail"),
        (Reading(1.12), True, "FAIL (passed before)"),
        (NOTHING, True, "FAIL (passed before)"),
    ):
        baseline = {} if before is None else {"wall": before}
        score, other = scores_of(figures, simulated, baseline)
        assert (score.verdict, other.verdict) == (verdict, "pass")
        assert score.regressed == verdict.startswith("FAIL")


def test_a_check_of_the_code_passes_within_its_tolerance_only_and_is_counted_apart(tmp_path):
    path = written(tmp_path, GOOD.replace("calibration: true", "calibration: false\n    kind: code", 1))
    check, reality = read_figures(path)
    assert check.limits == pytest.approx((0.83, 0.95)) and check.use == "code"
    value = GOOD.replace("{above: 0.5}", "{value: 0.5, tolerance: 0.2}", 1)
    _, wide = read_figures(written(tmp_path, value))
    assert wide.limits == pytest.approx((0.3, 0.7)) and wide.use == "blind"
    assert reality.limits == (0.5, float("inf")) and reality.published.ratio(0.4) == pytest.approx(0.8)
    answer = program._answer(judged((check, reality), {"wall": Reading(0.9), "neighbours": Reading(0.4)}, {}))
    assert answer.startswith("0 of 1 blind figures are within 25 %;") and answer.endswith("checks of the code 1 of 1.")


def test_a_baseline_comes_back_and_an_update_for_one_camera_keeps_the_rest(tmp_path):
    figures, path = read_figures(written(tmp_path)), tmp_path / "baseline.json"
    assert read_baseline(path) == {}
    write_baseline(path, scores_of(figures, Reading(0.6)), ["wall", "neighbours"])
    assert read_baseline(path) == {"wall": False, "neighbours": True}
    write_baseline(path, scores_of(figures, Reading(0.9))[:1], ["wall", "neighbours"])
    assert read_baseline(path) == {"wall": True, "neighbours": True}
    assert json.loads(path.read_text())["figures"]["wall"] == {"passes": True, "simulated": 0.9}
    # a figure that is no longer on file is dropped
    write_baseline(path, scores_of(figures, Reading(0.9))[:1], ["wall"])
    assert read_baseline(path) == {"wall": True}


@pytest.mark.parametrize(
    "text",
    [
        "",
        "[]",
        "3",
        "[" * 100_000,
        '{"figures": {}}',
        '{"scorecard_version": 1}',
        '{"scorecard_version": 1, "figures": []}',
        '{"scorecard_version": 1, "figures": {"a": {"passes": 1}}}',
        '{"scorecard_version": 1, "figures": 3}',
        '{"scorecard_version": 1, "figures": {"a": {"passes": true}, "a": {"passes": false}}}',
    ],
)
def test_what_is_no_baseline_is_refused(tmp_path, text):
    path = tmp_path / "baseline.json"
    path.write_text(text)
    with pytest.raises(UserError, match="is no baseline"):
        read_baseline(path)
    with pytest.raises(UserError, match="is no baseline"):
        write_baseline(path, (), ())
    assert path.read_text() == text


def test_the_committed_baseline_knows_exactly_the_figures_on_file():
    assert set(read_baseline(BASELINE_FILE)) == {figure.name for figure in read_figures(FIGURES_FILE)}


def test_the_table_tells_value_interval_published_and_source(tmp_path):
    figures = read_figures(written(tmp_path))
    lines = SCORES.grid(scores_of(figures, Reading(0.9, Interval(0.88, 0.92)))).lines()
    assert len(lines) == 3
    for words in ("azure_kinect_nfov", "1.5 m, albedo 0.8", "0.900", "0.880 to 0.920", "±0.06", "calibration", "[M] a"):
        assert words in lines[1]
    assert "above 0.5" in lines[2] and "1.40" in lines[2] and "blind" in lines[2]


@pytest.mark.parametrize(
    ("value", "text"),
    [(0.0, "0"), (1.0, "1.00"), (12.345, "12.3"), (1234.5, "1.23e+03"), (0.0123, "0.012"), (float("nan"), "none")],
)
def test_numbers_have_three_digits(value, text):
    assert number(value) == text


# ---- measuring -------------------------------------------------------------------------------------------------------


def test_every_quantity_has_a_unit_in_its_name_and_is_drawn_or_on_file():
    used = {point.quantity.name for point in program.curves_of([AZURE])}
    used |= {figure.quantity for figure in read_figures()}
    assert used == set(QUANTITIES)
    for name, quantity in QUANTITIES.items():
        assert not quantity.unit or name.endswith(f"_{quantity.unit}")
        assert in_words(quantity.conditions())


def test_full_curves_span_what_a_scorecard_must():
    panels = {(panel.quantity, panel.key): panel for each in program.pictures().values() for panel in each.panels}

    def span(quantity: str, key: str) -> list[list[float]]:
        panel = panels[quantity, key]
        return [[point.to_data()[key] for point in panel.points(line)] for line in panel.lines]

    (distances,), (albedos,), (angles,) = (
        span("temporal_sigma_mm", key) for key in ("distance_m", "albedo", "angle_deg")
    )
    assert (distances[0], distances[-1]) == (0.5, 4.0)
    assert (albedos[0], albedos[-1]) == (0.05, 0.95)
    assert (angles[0], angles[-1]) == (0, 70)
    assert span("edge_gap_px", "step_mm") == [[5, 10, 20, 50, 100, 200, 500]] * 2
    room = panels["board_bias_mm", "distance_m"]
    assert {line: room.points(line)[0].to_data()["multipath"] for line in room.lines} == {
        **{"multipath on": True, "multipath off": False}
    }


def test_numbers_do_not_depend_on_processes_or_order(tmp_path):
    figures = read_figures(written(tmp_path))
    panel = program.pictures()["noise"].panels[1]
    requests = [(AZURE, panel.quantity, point) for point in panel.points("")[1::5]]
    requests += [figure.request for figure in figures]
    one = measured(requests, QUICK, tmp_path, jobs=1)
    two = measured(tuple(reversed(requests)), QUICK, tmp_path, jobs=2)
    assert set(one) == set(two) == set(requests)
    for request in requests:
        assert repr(one[request]) == repr(two[request]), request


@pytest.mark.slow
def test_the_room_bends_the_board_only_with_multipath(tmp_path):
    """Light from the table reaches the board late: a bias of millimetres; without it only rounding is left."""
    quantity = QUANTITIES["board_bias_mm"]
    requests = [(AZURE, quantity.name, quantity.conditions(distance_m=0.7, multipath=on)) for on in (False, True)]
    off, on = measured(requests, QUICK, tmp_path, jobs=1).values()
    assert abs(off.value) < 0.05
    assert on.value > 2.0 and on.interval.above(1.0)


# ---- the program -----------------------------------------------------------------------------------------------------


def test_the_program_from_beginning_to_end(tmp_path, capsys, monkeypatch):
    """Two figures, few frames: files and exit 0; a baseline that the simulation falls behind: exit 1, naming it."""
    few = {
        name: picture.model_copy(
            update={"panels": tuple(p.model_copy(update={"values": p.values[1:2]}) for p in picture.panels)}
        )
        for name, picture in program.pictures().items()
        if name in ("correlation", "edges")
    }
    monkeypatch.setattr(program, "pictures", lambda: few)
    monkeypatch.setattr(program, "FULL", QUICK)
    known = lru_cache(lambda wanted, *more: measured(wanted, *more))
    monkeypatch.setattr(program.scoring, "measured", lambda wanted, *more: known(tuple(wanted), *more))
    figures, baseline, out = written(tmp_path), tmp_path / "baseline.json", tmp_path / "out"
    options = ["--jobs", "1", "--camera", AZURE]
    options += ["--figures", str(figures), "--out", str(out)]
    assert main(options) == 0
    told = capsys.readouterr()
    assert "temporal deviation, 1.5 m, albedo 0.8" in told.out
    # on a slow machine progress is told meanwhile
    assert all(line.startswith("measured ") for line in told.err.splitlines())
    page = (out / "scorecard.html").read_text()
    assert f'<meta name="generator" content="{GENERATOR}">' in page
    assert page.count("<svg") == 2 and "http" not in page.replace("http://www.w3.org", "")
    scores = list(csv.DictReader((out / "scorecard.csv").open()))
    assert [row["name"] for row in scores] == ["wall", "neighbours"]
    assert float(scores[0]["low"]) < float(scores[0]["simulated"]) < float(scores[0]["high"])
    curves = list(csv.DictReader((out / "curves.csv").open()))
    assert len(curves) == len(program.curves_of([AZURE])) == 8
    assert {row["results_version"] for row in scores + curves} == {str(RESULTS_VERSION)}
    assert {row["lag_x_px"] for row in curves} == {"", "0", "2"}
    assert {row["shadow"] for row in curves} == {"", "True", "False"}
    provenance = json.loads((out / "provenance.json").read_text())
    assert provenance["command"].startswith("python -m harness.validate --jobs 1")
    assert provenance["results_version"] == RESULTS_VERSION

    baseline.write_text(BASELINE % '"wall": {"passes": true}, "neighbours": {"passes": true}')
    options += ["--baseline", str(baseline)]
    figures.write_text(GOOD.replace("{value: 0.89, tolerance: 0.06}", "{value: 2.0, tolerance: 0.06}"))
    assert main(options) == 1
    told = capsys.readouterr()
    assert "passed in the baseline and fails now: wall" in told.err and "neighbours (" not in told.err

    baseline.write_text(BASELINE % '"gone": {"passes": true}, "missed": {"passes": false}')
    assert main(options) == 1
    told = capsys.readouterr()
    assert "passed in the baseline and is no longer among the figures: gone" in told.err and "missed" not in told.err


@pytest.mark.parametrize(
    ("options", "says"),
    [
        (["--camera", "azure"], "there is no camera 'azure'"),
        (["--figures", "absent.yaml"], "absent.yaml"),
        (["--mask", "m.png"], "--mask belongs to a capture"),
        (["--capture", "x", "--update-baseline"], "--update-baseline belongs to the scorecard"),
        (["--baseline", "absent.json"], "--baseline absent.json: no such file"),
        (["--figures", "own.yaml", "--update-baseline"], "name a --baseline of their own"),
        (["--capture", "absent"], "absent: no such file or folder"),
        (["--capture", "x", "--camera", "a", "--camera", "b"], "one camera took it"),
        (["--capture", "x", "--albedo", "0"], "--albedo 0"),
    ],
)
def test_a_mistake_of_the_user_is_one_message_and_exit_code_2(options, says, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(options) == 2
    assert says in capsys.readouterr().err


def test_help_is_instant():
    code = (
        "import sys; sys.argv = ['x', '--help']\n"
        "import harness.validate as program\n"
        "try: program.main()\n"
        "except SystemExit as end: assert end.code == 0\n"
        "heavy = {'mitsuba', 'drjit', 'open3d', 'matplotlib', 'pandas', 'scipy', 'numba', 'av', 'cv2', 'numpy'}\n"
        "assert not heavy & set(sys.modules), heavy & set(sys.modules)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert "usage: python -m harness.validate" in done.stdout
