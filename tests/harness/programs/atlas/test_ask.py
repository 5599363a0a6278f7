"""The atlas of limits: surfaces through set-ups of a known law, questions, refusals, and the
page's data."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from detectors import detector_type
from harness import __version__
from harness.experiment.digests import simulation_digests
from harness.programs.atlas.ask import main
from harness.programs.atlas.limits import Outside, surfaces_of
from tests.support.browser import opened

THROUGH = {"kind": "through", "per_board": 6, "diameter_mm": [2.0, 40.0]}
BLIND = [
    {"kind": "blind", "per_board": 6, "diameter_mm": [2.0, 40.0], "depth_mm": [depth, depth]}
    for depth in (3.0, 6.0)
]
SCATTER = 0.05


def law_mm(distance_m: float, frames: float, depth_mm: float | None = None) -> float:
    """a90 of the made-up camera: no polynomial, but smooth."""
    noise = np.sqrt(0.3 + distance_m**2 / frames)
    return float(
        5.0 * distance_m * noise ** (0.5 if depth_mm is None else 0.5 * (3.0 / depth_mm) ** 0.2)
    )


def limits(seed: int = 1, lost: float = 40.0) -> pd.DataFrame:
    stream = np.random.default_rng(seed)
    rows = []
    for damage in (THROUGH, *BLIND):
        for distance_m in (0.5, 0.75, 1.0, 1.5):
            for frames in (1, 10, 50):
                truth = law_mm(distance_m, frames, damage.get("depth_mm", [None])[0])
                a90_mm = truth * np.exp(stream.normal(0, SCATTER))
                rows.append(
                    {
                        "source.camera.name": "azure_kinect_nfov",
                        "source.target.damage": json.dumps(damage),
                        "source.target.distance_m": distance_m,
                        "frames": frames,
                        "detector": "matched",
                        "a90_mm": a90_mm if a90_mm < lost else np.nan,
                        "a90_low_mm": a90_mm * np.exp(-1.96 * SCATTER),
                        "a90_high_mm": a90_mm * np.exp(1.96 * SCATTER),
                        "largest_mm": 40.0,
                        "is_at_most": False,
                        "hits": 0 if a90_mm >= lost else 50,
                    }
                )
    return pd.DataFrame(rows)


def test_intervals_of_the_surface_hold_the_law():
    covered = []
    widths = []
    for seed in range(100):
        surface = surfaces_of(limits(seed))[0]
        for setting in ({"distance_m": 0.6, "frames": 1}, {"distance_m": 1.2, "frames": 25}):
            answer = surface.at(**setting)
            covered.append(answer.low_mm <= law_mm(**setting) <= answer.high_mm)
            widths.append(answer.high_mm / answer.low_mm)
    assert np.mean(covered) > 0.95 and np.median(widths) < 1.5


def test_a_wrong_surface_states_its_error():
    smooth = limits()
    rough = limits()
    rough.loc[rough["frames"] == 10, "a90_mm"] *= np.where(
        np.arange((rough["frames"] == 10).sum()) % 2, 1.5, 0.7
    )
    first = surfaces_of(smooth)[0]
    second = surfaces_of(rough)[0]
    assert second.error > 3 * first.error
    node = {"distance_m": 0.75, "frames": 10}
    width = [
        np.log(surface.at(**node).high_mm / surface.at(**node).low_mm)
        for surface in (first, second)
    ]
    assert width[1] > 3 * width[0]


def test_depth_is_an_axis():
    surface = next(surface for surface in surfaces_of(limits()) if surface.kind == "blind")
    assert surface.grid["depth_mm"] == (3.0, 6.0)
    setting = {"distance_m": 1.0, "frames": 10, "depth_mm": 4.5}
    answer = surface.at(**setting)
    assert answer.low_mm < law_mm(**setting) < answer.high_mm


@pytest.mark.parametrize(
    "setting", [{"distance_m": 1.6, "frames": 1}, {"distance_m": 1.0, "frames": 100}]
)
def test_nothing_is_extrapolated(setting: dict[str, float]):
    with pytest.raises(Outside, match="the atlas has"):
        surfaces_of(limits())[0].at(**setting)


def test_beside_a_set_up_without_a_limit_none_is_stated():
    surface = surfaces_of(limits(lost=law_mm(1.3, 1)))[0]
    for distance_m, verdict in (
        (1.1, "undecided"),
        (1.5, "no"),
    ):  # some of the set-ups around have a limit, or none has
        answer = surface.at(distance_m=distance_m, frames=1)
        assert (
            np.isnan(answer.a90_mm)
            and answer.verdict(39.0) == verdict
            and answer.verdict(41.0) == "undecided"
        )
    assert surface.at(distance_m=1.0, frames=1).a90_mm == pytest.approx(law_mm(1.0, 1), rel=0.2)


def test_a_limit_below_all_sizes_is_no_limit_above_them():
    """Where the least damage was found too, the set-up has no a90, and larger damage is not called
    missed."""
    rows = limits()
    rows.loc[rows["frames"] == 50, "is_at_most"] = True
    answer = surfaces_of(rows)[0].at(distance_m=1.0, frames=50)
    assert (
        np.isnan(answer.a90_mm)
        and np.isnan(answer.largest_mm)
        and answer.verdict(30.0) == "undecided"
    )


def about_today() -> dict[str, Any]:
    """What a study of today stores beside its limits."""
    digests = simulation_digests(["matched"], ["azure_kinect_nfov"])
    return {
        "digests": {**digests, "experiment atlas": "any"},
        "versions": {"tofpod": __version__},
    }


@pytest.fixture
def stored(tmp_path: Path) -> Path:
    written_atlas(tmp_path / "limits.parquet", limits(), json.dumps(about_today()).encode())
    return tmp_path


def first_line(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> str:
    assert main(arguments) == 0
    return capsys.readouterr().out.splitlines()[0]


def test_an_atlas_of_todays_code_is_not_called_older(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    about = json.dumps(about_today()).encode()
    asked = written_atlas(tmp_path / "atlas.parquet", limits(), about)
    assert first_line(asked, capsys).startswith("Through-holes of 5 mm")


@pytest.mark.parametrize("part", ["detectors/methods", "scenes/render", "camera azure_kinect_nfov"])
def test_the_first_line_says_that_the_atlas_is_older_than_a_part_of_the_code(
    part: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    about = about_today()
    about["digests"][part] = "0123456789ab"
    table = limits().assign(detector_version=7)
    asked = written_atlas(tmp_path / "atlas.parquet", table, json.dumps(about).encode())
    now = detector_type("matched").version
    assert first_line(asked, capsys) == (
        f"Older than the code: this atlas was computed by tofpod {__version__} with version 7 of"
        f" matched (now {now}); today's limits may differ."
    )
    assert main([*asked, "--out", str(tmp_path / "out")]) == 0
    assert "Older than the code" in (tmp_path / "out" / "atlas.html").read_text()


@pytest.mark.parametrize(
    ("part", "named"),
    [
        ("detectors/methods", "detectors"),
        ("camera azure_kinect_nfov", "cameras"),
    ],
)
def test_where_the_versions_are_todays_the_changed_code_is_named(
    part: str, named: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    about = about_today()
    about["digests"][part] = "0123456789ab"
    table = limits().assign(detector_version=detector_type("matched").version)
    asked = written_atlas(tmp_path / "atlas.parquet", table, json.dumps(about).encode())
    assert first_line(asked, capsys) == (
        f"Older than the code: this atlas was computed by tofpod {__version__} with earlier code of"
        f" {named}; today's limits may differ."
    )


def test_an_atlas_that_states_no_code_is_called_older(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    asked = written_atlas(tmp_path / "atlas.parquet", limits())
    assert first_line(asked, capsys).startswith(
        "Older than the code: this atlas was computed by an unknown version of tofpod with"
        " an unknown version of matched (now "
    )


def test_answer_page_and_data_say_the_same(stored: Path, capsys: pytest.CaptureFixture[str]):
    out = stored / "out"
    asked = [
        "--damage",
        "hole",
        "--size",
        "0.3in",
        "--distance",
        "75cm",
        "--atlas",
        str(stored),
        "--out",
        str(out),
    ]
    assert main(asked) == 0
    output = capsys.readouterr().out
    assert output.startswith(
        "Through-holes of 7.62 mm at 0.75 m are found nine times out of ten in 2 of 2 set-ups."
    )
    data = pd.read_csv(out / "atlas.csv")
    page = (out / "atlas.html").read_text()
    curves = json.loads(re.search(r"const .* = (\{.*\});", page)[1])["curves"]  # type: ignore[index]
    assert len(data) == sum(len(curve["distance_m"]) for curve in curves) == 3 * 3 * 25
    chosen = next(
        curve for curve in curves if curve["damage"] == "through-hole" and curve["frames"] == 10
    )
    beside = data[(data["damage"] == "through-hole") & (data["frames"] == 10)]
    assert np.allclose(chosen["a90"], beside["a90_mm"], rtol=1e-3) and len(page) < 2e6
    assert "http" not in re.sub(r"http://www.w3.org/2000/svg", "", page)


SLIDE = """<script>
const inputs = [...document.querySelectorAll("select, input[type=range]")];
const controls = inputs.filter(one => one.offsetParent);
const focused = one => (one.focus(), document.activeElement === one);
const reached = controls.filter(one => focused(one) && one.closest("label"));
const said = [`${reached.length} of ${controls.length}`];
for (const value of [200, 0]) {
  at("size").value = value;
  at("size").dispatchEvent(new Event("input"));
  said.push(document.querySelector(".answer").textContent, at("rows").textContent);
}
const fits = document.documentElement.scrollWidth <= innerWidth;
said.push(document.querySelectorAll("#chart polyline").length, fits);
document.body.dataset.said = said.join("|");
</script></body>"""


def test_a_browser_answers_as_the_sliders_move(stored: Path):
    """Every control has a label and takes the keyboard's focus; the page fits its window."""
    assert (
        main(
            [
                "--size",
                "7mm",
                "--distance",
                "1m",
                "--atlas",
                str(stored),
                "--out",
                str(stored / "out"),
            ]
        )
        == 0
    )
    page = stored / "out" / "moved.html"
    page.write_text((stored / "out" / "atlas.html").read_text().replace("</body>", SLIDE))
    answers = re.search(r'data-said="([^"]+)"', opened(page, page.parent, "--window-size=900,600"))
    assert answers is not None
    reached, large, large_row, small, small_row, lines, fits = answers[1].split("|")
    assert reached == "5 of 5"  # of one albedo there is no choice
    assert large.startswith("Through-hole, 40 mm") and large.endswith(
        "by Azure Kinect DK, NFOV unbinned."
    )
    assert small.endswith("by no camera of the atlas.")
    assert "yes" in large_row and "no" in small_row and (lines, fits) == ("3", "true")


def test_both_ends_of_the_albedo_are_answered_unless_one_is_asked_for(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    dark = limits().assign(**{"source.target.material.albedo_850": 0.2})
    bright = limits().assign(**{"source.target.material.albedo_850": 0.6})
    sizes = ["a90_mm", "a90_low_mm", "a90_high_mm"]
    dark[sizes] *= 2.0
    about = json.dumps(about_today()).encode()
    written_atlas(tmp_path / "limits.parquet", pd.concat([dark, bright]), about)
    question = ["--size", "7mm", "--distance", "1m", "--atlas", str(tmp_path)]
    assert main([*question, "--out", str(tmp_path / "out")]) == 0
    output = capsys.readouterr().out
    assert output.startswith(
        "Through-holes of 7 mm at 1 m are found nine times out of ten in 2 of 4 set-ups"
        " (no for 1, undecided for 1)."
    )
    assert re.search(r"distance \(m\) +frames +albedo +a90", output)
    assert main([*question, "--albedo", "0.6"]) == 0
    output = capsys.readouterr().out
    assert "in 2 of 2 set-ups" in output and "albedo  " not in output
    page = (tmp_path / "out" / "atlas.html").read_text()
    curves = json.loads(re.search(r"const .* = (\{.*\});", page)[1])["curves"]  # type: ignore[index]
    assert {curve["albedo"] for curve in curves} == {0.2, 0.6}


def test_the_exact_command_is_a_valid_experiment(stored: Path, capsys: pytest.CaptureFixture[str]):
    import shlex

    from harness.__main__ import main as tofpod

    asked = [
        "--damage",
        "blind",
        "--depth",
        "4mm",
        "--size",
        "9mm",
        "--distance",
        "0.8m",
        "--frames",
        "5",
    ]
    assert main([*asked, "--atlas", str(stored)]) == 0
    command = capsys.readouterr().out.split("exactly: ")[1].strip()
    assert tofpod([*shlex.split(command)[1:], "--dry-run", "--out", str(stored / "dry")]) == 0
    assert "1 point" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("asked", "message"),
    [
        (["--size", "5mm"], "--size and --distance are needed"),
        (["--size", "5", "--distance", "1m"], "--size 5: is not a length with a unit"),
        (
            ["--size", "5mm", "--distance", "9m"],
            "not cover this: distance 9 m: the atlas has 0.5 to 1.5 m\n",
        ),
        (
            ["--size", "5mm", "--distance", "1m", "--camera", "kinect"],
            "--camera kinect: not in the atlas",
        ),
        (
            ["--size", "5mm", "--distance", "1m", "--damage", "crack"],
            "--damage crack: not in the atlas\n  legal: hole",
        ),
        (["--size", "5mm", "--distance", "1m", "--damage", "crak"], "did you mean 'crack'?"),
        (["--size", "5mm", "--distance", "1m", "--damage", "blind"], "--depth is missing"),
        (
            ["--size", "5mm", "--distance", "1m", "--depth", "2mm"],
            "--depth: the atlas has no values for through-holes",
        ),
    ],
)
def test_a_question_without_an_answer_is_refused(
    asked: list[str], message: str, stored: Path, capsys: pytest.CaptureFixture[str]
):
    assert main([*asked, "--atlas", str(stored), "--out", str(stored / "none")]) == 2
    assert message in capsys.readouterr().err and not (stored / "none").exists()


def test_other_tables_are_refused(stored: Path, capsys: pytest.CaptureFixture[str]):
    (stored / "text.parquet").write_text("no table")
    limits().drop(columns="source.target.damage").to_parquet(stored / "lacking.parquet")
    question = ["--size", "5mm", "--distance", "1m"]
    for name, message in (
        ("text", "cannot be read"),
        ("lacking", "lacks the columns source.target.damage"),
        ("no", "there is no such"),
    ):
        assert main([*question, "--atlas", str(stored / f"{name}.parquet")]) == 2
        assert message in capsys.readouterr().err


def written_atlas(path: Path, table: pd.DataFrame, about: bytes = b"{}") -> list[str]:
    """The arguments that ask a table of limits."""
    stored = pa.Table.from_pandas(table, preserve_index=False)
    pq.write_table(stored.replace_schema_metadata({b"tofpod": about}), path)
    return ["--size", "5mm", "--distance", "1m", "--atlas", str(path)]


DAMAGE = "source.target.damage"


@pytest.mark.parametrize(
    ("column", "value", "message"),
    [
        ("a90_mm", "x", "a90_mm holds a value that is no number"),
        ("a90_mm", 0.0, "a90_mm holds a size that is not above 0"),
        ("hits", True, "hits holds a value that is no number"),
        ("detector_version", 7.5, "detector_version holds a value that is no whole number"),
        ("source.target.distance_m", -1.0, "distance_m holds a number that is not above 0"),
        ("source.target.distance_m", np.nan, "distance_m lacks a number"),
        ("frames", 0, "frames holds a number that is not above 0"),
        ("source.camera.name", 3.0, "source.camera.name holds a value that is no text"),
        ("detector", None, "detector holds a value that is no text"),
        ("is_at_most", 0.5, "is_at_most holds a value that is not true or false"),
        (DAMAGE, "{", "which declares no damage"),
        (DAMAGE, "[]", "it states no kind"),
        (DAMAGE, '{"kind": 3}', "it states no kind"),
        (DAMAGE, '{"kind": "blind", "depth_mm": ["a"]}', "its depth_mm is no number between"),
        (DAMAGE, '{"kind": "blind", "depth_mm": 3}', "its depth_mm is not a list"),
    ],
)
def test_an_odd_atlas_is_refused(
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    column: str,
    value: object,
    message: str,
):
    table = limits()
    table[column] = [value] * len(table)
    assert main(written_atlas(tmp_path / "odd.parquet", table)) == 2
    assert message in capsys.readouterr().err


@pytest.mark.parametrize("about", [b"{", b"[]", b'{"experiment": 3}'])
def test_odd_data_beside_an_atlas_are_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], about: bytes
):
    assert main(written_atlas(tmp_path / "odd.parquet", limits(), about)) == 2
    assert "the data beside the table cannot be read" in capsys.readouterr().err


@pytest.mark.parametrize("column", ["a90_high_mm", "hits", "is_at_most", "largest_mm", "frames"])
def test_an_atlas_without_a_column_or_row_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], column: str
):
    assert main(written_atlas(tmp_path / "odd.parquet", limits().drop(columns=column))) == 2
    assert f"lacks the columns {column}" in capsys.readouterr().err
    assert main(written_atlas(tmp_path / "odd.parquet", limits()[:0])) == 2
    assert "has no row" in capsys.readouterr().err
