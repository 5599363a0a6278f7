"""Questions to an atlas: the words that people use, the answer, its page, and refusals."""

from __future__ import annotations

import json
import re
import shlex
from dataclasses import replace
from pathlib import Path

import pandas as pd
import pytest

from harness.programs.atlas.ask import _warnings, main
from harness.programs.atlas.limits import Conditions
from harness.programs.atlas.stored import read_atlas
from tests.support.browser import opened
from tests.support.made_up_atlas import law_mm, shard, written


@pytest.fixture(scope="module")
def atlas(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return written(tmp_path_factory.mktemp("atlas") / "atlas.json")


def said(question: str, atlas: Path, capsys: pytest.CaptureFixture[str]) -> str:
    assert main([*shlex.split(question), "--atlas", str(atlas)]) == 0
    return capsys.readouterr().out


def table_of(output: str) -> dict[str, list[float]]:
    """The limits by camera, in the order of the table."""
    limits: dict[str, list[float]] = {}
    for line in output.splitlines():
        row = re.match(r"(Sharp One, short mode|Twin Two|Dim 2) .*?([\d.]+) \(", line)
        if row:
            limits.setdefault(row[1], []).append(float(row[2]))
    return limits


@pytest.mark.parametrize("size", ["7mm", "0.7cm", "0.2755906in", "0.007m"])
def test_the_answer_is_that_of_the_law(size: str, atlas: Path, capsys: pytest.CaptureFixture[str]):
    question = f"--damage crack --size {size} --depth 6mm --distance 100cm --albedo 0.4"
    output = said(question, atlas, capsys)
    assert output.startswith("Crack or slots of 7 mm, 6 mm deep, at 1 m are found nine times out")
    limits = table_of(output)
    for camera, title in (("sharp", "Sharp One, short mode"), ("dim", "Dim 2")):
        for frames, limit_mm in zip((1, 50), limits[title], strict=True):
            truth_mm = law_mm(camera, "slot", Conditions(1.0, 0.4, frames, 6.0))
            assert limit_mm == pytest.approx(truth_mm, rel=0.2), (camera, frames)


def test_without_a_size_the_smallest_found_is_the_answer(
    atlas: Path, capsys: pytest.CaptureFixture[str]
):
    output = said("--damage dents --depth 1.5mm --distance 1m", atlas, capsys)
    assert output.startswith("At 1 m, Sharp One, short mode finds the smallest dents, 1.5 mm deep,")
    assert "with 50 frames" in output.splitlines()[0] and "found?" not in output
    assert "Next: Dim 2, " in output and "order of the two is" in output
    assert "The same numbers: Twin Two as Sharp One, short mode." in output


def test_where_no_size_is_found_the_depth_that_is(atlas: Path, capsys: pytest.CaptureFixture[str]):
    question = "--damage dent --depth 0.5mm --distance 2m --frames 1 --camera sharp"
    output = said(question, atlas, capsys)
    assert output.startswith("At 2 m, dents, 0.5 mm deep, of no size inspected are found")
    depth_mm = float(re.search(r"from a depth of about ([\d.]+) mm on: Sharp One", output)[1])  # type: ignore[index]
    found = [law_mm("sharp", "dent", Conditions(2.0, 0.6, 1, depth_mm * by)) for by in (0.7, 1.4)]
    assert found[0] > 80 > found[1]  # the widest dents there are 80 mm wide


@pytest.mark.parametrize(
    ("word", "titles"),
    [
        ("twin", ["Twin Two"]),
        ("TWO", ["Twin Two"]),
        ("sharp one", ["Sharp One, short mode"]),
        ("dim", ["Dim 2"]),
    ],
)
def test_a_camera_goes_by_its_everyday_name(
    word: str, titles: list[str], atlas: Path, capsys: pytest.CaptureFixture[str]
):
    output = said(f"--size 7mm --distance 1m --camera '{word}'", atlas, capsys)
    assert list(table_of(output)) == titles


def test_words_for_damage(atlas: Path, capsys: pytest.CaptureFixture[str]):
    for word in ("crack", "slot", "scratch"):
        output = said(f"--damage {word} --size 3mm --depth 4mm --distance 1m", atlas, capsys)
        assert output.startswith("Crack or slots of 3 mm, 4 mm deep, at 1 m")
    assert "A scratch (gouge) is answered as a slot" in output


def test_page_and_table_say_the_same_and_open_at_the_question(
    atlas: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    said(f"--size 0.3in --distance 0.77m --out {tmp_path}", atlas, capsys)
    page = (tmp_path / "atlas.html").read_text()
    data = json.loads(re.search(r"const .* = (\{.*\});", page)[1])  # type: ignore[index]
    opens = {"size_mm": 7.62, "distance_m": 0.77, "frames": 1, "albedo": 0.6}
    assert data["opens"] == pytest.approx(opens)
    table = pd.read_csv(tmp_path / "atlas.csv")
    assert len(table) == sum(len(curve["a90"]) for curve in data["curves"])
    one = next(c for c in data["curves"] if c["camera"] == "Dim 2" and c["frames"] == 50)
    beside = table[(table["camera"] == "Dim 2") & (table["frames"] == 50)]
    pairs = list(zip(one["a90"], beside["a90_mm"], strict=True))
    inside = [(on_page, in_table) for on_page, in_table in pairs if on_page is not None]
    assert len(inside) > 5
    for on_page, in_table in inside:
        assert on_page == pytest.approx(in_table, rel=1e-3)
    assert "http" not in page.replace("http://www.w3.org/2000/svg", "")


SLIDE = """<script>
const said = [at("size_text").textContent, at("distance_text").textContent, at("rows").textContent];
for (const value of [400, 0]) {
  at("size").value = value;
  at("size").dispatchEvent(new Event("input"));
  said.push([...at("rows").rows].map(row => row.cells[1].textContent).join(" "));
}
const inputs = [...document.querySelectorAll("select, input[type=range]")];
said.push(inputs.every(input => (input.focus(), document.activeElement === input && input.closest("label"))));
document.body.dataset.said = said.join("|");
</script></body>"""


def test_a_browser_opens_at_the_question_and_answers_as_the_sliders_move(
    atlas: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    question = "--damage slot --depth 2mm --size 7mm --distance 0.5m --frames 50 --camera twin"
    output = said(f"{question} --camera dim --out {tmp_path}", atlas, capsys)
    limits = table_of(output)
    page = (tmp_path / "atlas.html").read_text().replace("</body>", SLIDE)
    (tmp_path / "moved.html").write_text(page)
    answers = re.search(r'data-said="([^"]+)"', opened(tmp_path / "moved.html", tmp_path))
    assert answers is not None
    size, distance, rows, large, small, focus = answers[1].split("|")
    assert (size, distance) == ("7 mm", "0.5 m")
    for title, (limit_mm,) in limits.items():
        assert f"{title}yes{limit_mm:.1f} (" in rows or f"{title}no{limit_mm:.1f} (" in rows
    assert (large, small, focus) == ("yes yes", "no no", "true")


def test_the_exact_command_is_a_valid_experiment(atlas: Path, tmp_path: Path, capsys):  # type: ignore[no-untyped-def]
    from harness.__main__ import main as tofpod

    question = "--damage blind --depth 4mm --size 9mm --distance 0.8m --frames 5"
    command = said(question, atlas, capsys).split("exactly: ")[1].strip()
    command = command.replace('"sharp"', '"kinect_v2"')
    assert tofpod([*shlex.split(command)[1:], "--dry-run", "--out", str(tmp_path)]) == 0
    assert "1 point" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("question", "message"),
    [
        ("--size 5mm", "--distance is missing"),
        ("--size 5 --distance 1m", "--size 5: is not a length with a unit"),
        ("--size 5mm --distance 9m", "the atlas does not cover this: distance 9 m"),
        ("--size 5mm --distance 1m --camera shrap", "did you mean 'sharp'?"),
        ("--size 5mm --distance 1m --camera zzz", "legal: dim, sharp, twin"),
        ("--size 5mm --distance 1m --damage dnet", "did you mean 'dent'?"),
        ("--size 1mm --distance 1m --damage dent", "--depth is missing: how deep is the dent?"),
        ("--size 5mm --distance 1m --depth 2mm", "--depth: a hole through the part has none"),
        ("--size 5mm --distance 1m --damage dent --depth 1mm --backing 9mm", "--backing: is seen"),
        ("--size 5mm --distance 1m --backing 3m", "backing 3000 mm: the atlas has 15 to 60 mm"),
        ("--size 5mm --distance 1m --albedo 2", "--albedo 2: must lie between 0 and 1"),
        ("--size 5mm --distance 1m --frames 0", "--frames 0: must be 1 or more"),
    ],
)
def test_a_question_without_an_answer_is_refused(
    question: str, message: str, atlas: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    out = tmp_path / "none"
    assert main([*shlex.split(question), "--atlas", str(atlas), "--out", str(out)]) == 2
    assert message in capsys.readouterr().err and not out.exists()


def test_a_refusal_states_the_sweep_that_answers(atlas: Path, capsys: pytest.CaptureFixture[str]):
    assert main(["--distance", "2.9m", "--camera", "dim", "--atlas", str(atlas)]) == 2
    error = capsys.readouterr().err
    assert "compute it: tofpod sweep atlas" in error and "source.target.distance_m=2.9" in error


def test_guessed_precisions_of_many_cameras_are_one_warning(atlas: Path):
    """With the least and the greatest factor, and every camera's title."""
    ends = (("0.5", "2"), ("0.71", "1.4"), ("0.6", "3"))
    dim, sharp = read_atlas(atlas)
    guessed = []
    for known, (least, greatest) in zip((dim, sharp, dim), ends, strict=True):
        title = known.titles[known.camera]
        guess = f"its noise is a guess, which may be {least} to {greatest} times as much"
        guessed.append(
            replace(known, warning=f"the precision of {title} is not published: {guess}")
        )
    (together,) = _warnings(guessed)
    assert "3 cameras" in together and "may be 0.5 to 3 times as much" in together
    assert all(camera.titles[camera.camera] in together for camera in guessed)
    assert _warnings(guessed[1:]) == [camera.warning for camera in guessed[1:]]


def test_an_own_camera_is_answered_by_the_camera_of_its_numbers(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    """The file of a Femto Bolt, copied, has the numbers of the stored Azure Kinect; with another
    gain it has not."""
    own_file = tmp_path / "mine.yaml"
    own_file.write_text("like: azure_kinect_nfov\nname: mine\ntitle: Mine\n")
    question = ["--distance", "1m", "--camera", str(own_file)]
    assert main(question) == 0
    assert "Azure Kinect DK, NFOV unbinned" in capsys.readouterr().out
    gain = "photons:\n  signal_electrons: {value: 99.0, tag: U, source: mine}\n"
    own_file.write_text(own_file.read_text() + gain)
    own_file = own_file.rename(tmp_path / "other.yaml")
    own_file.write_text(own_file.read_text().replace("name: mine", "name: other"))
    assert main(["--distance", "1m", "--camera", str(own_file)]) == 2
    assert f"compute its limits: tofpod atlas {own_file}" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('"version": 2', '"version": 1', "its version is 1"),
        ('"degrees": ', '"degrees": -', "degrees holds"),
        ('"coefficients": [', '"coefficients": [1.0, ', "coefficients has another shape"),
        ('"coefficients": [', f'"coefficients": [1{"0" * 400}, ', "too large to convert"),
        ('"scatter": ', '"scatter": -', "scatter holds -"),
        ('"focal_px": 500.0', '"focal_px": "x"', "focal_px holds 'x'"),
        ("[0.3, 0.6", "[0.9, 0.6", "do not ascend"),
        ('"columns"', '"heads"', "KeyError"),
    ],
)
def test_an_odd_atlas_is_refused(
    old: str, new: str, message: str, atlas: Path, tmp_path: Path, capsys
):  # type: ignore[no-untyped-def]
    odd = tmp_path / "odd.json"
    text = atlas.read_text()
    assert old in text
    odd.write_text(text.replace(old, new))
    assert main(["--distance", "1m", "--atlas", str(odd)]) == 2
    assert message in capsys.readouterr().err


def test_an_atlas_is_read_as_it_was_written(atlas: Path):
    first, second = read_atlas(atlas)
    assert (first.camera, second.camera) == ("dim", "sharp")
    assert second.titles["twin"] == "Twin Two"
    made = shard("sharp")
    for kind, limits in second.kinds.items():
        conditions = Conditions(1.0, 0.5, 20, 15.0 if kind == "through" else 4.0)
        before = made.surfaces(kind)[0].at(conditions)
        after = second.surfaces(kind)[0].at(conditions)
        assert after.middle == pytest.approx(before.middle, abs=2e-3)
        assert after.half == pytest.approx(before.half, rel=2e-3)
        assert limits.set_ups[0].distance_m == 0.3 and limits.set_ups[0].sites == 24


def test_an_atlas_of_other_sources_is_compared_by_its_digests(
    atlas: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    assert not said("--distance 1m", atlas, capsys).startswith("Older than the code")
    older = tmp_path / "older.json"
    older.write_text(re.sub(r'"sources": "\w+"', '"sources": "0"', atlas.read_text()))
    output = said("--distance 1m", older, capsys)
    assert output.startswith("Older than the code: this atlas was computed by tofpod")
    assert "earlier code of detectors" in output.splitlines()[0]
