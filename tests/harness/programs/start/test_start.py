"""``tofpod start`` as a person types it, and by options: the experiment is valid, and the commands
are understood."""

from __future__ import annotations

import importlib
import io
import shlex
from pathlib import Path

import pytest

from harness.__main__ import MODULES, main
from harness.experiment.load import load_experiment
from harness.programs.start.plan import IMPLANTED, KINDS, Inquiry, commands, experiment_text
from harness.programs.start.start import NEEDED
from harness.vocabulary.words import damage_kind

STATED = {
    "--camera": "azure_kinect_nfov",
    "--part": "board",
    "--damage": "hole",
    "--size": "5mm",
}


def words_of(stated: dict[str, str]) -> list[str]:
    return [word for option in stated.items() for word in option]


@pytest.fixture
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


def type_lines(monkeypatch: pytest.MonkeyPatch, text: str) -> None:
    monkeypatch.setattr("sys.stdin", io.StringIO(text))


def proposed(printed: str) -> list[str]:
    """Return the commands that were printed, each of which its program understands."""
    commands = []
    for line in printed.splitlines():
        if line.startswith("  tofpod "):
            _, name, *arguments = shlex.split(line, comments=True)
            importlib.import_module(MODULES[name]).main.parser().parse_args(arguments)
            commands.append(line.partition("#")[0].strip())
    return commands


def test_answers_by_options_ask_nothing(home: Path, monkeypatch, capsys) -> None:
    monkeypatch.setattr("sys.stdin", None)
    assert main(["start", *words_of(STATED)]) == 0
    assert proposed(capsys.readouterr().out) == [
        "tofpod sweep board_through.yaml --dry-run",
        "tofpod sweep board_through.yaml --quick",
        "tofpod sweep board_through.yaml",
    ]
    assert main(["sweep", "board_through.yaml", "--dry-run"]) == 0
    experiment = load_experiment(home / "board_through.yaml")
    damage = experiment.config.simulated.target.damage
    assert damage.kind == "through"
    assert damage.size_mm == (1.67, 10.0), "a third to twice the tolerance"
    assert {point.config.capture.frames for point in experiment.points} == {1, 50}


def test_questions_are_asked_again_after_a_mistake(home: Path, monkeypatch, capsys) -> None:
    (home / "captures").mkdir()
    (home / "mine.yaml").touch()
    answers = [
        *("azure_kinect", "?", "", "azure_kinect_nfov"),
        *("capturs", "captures"),
        *("shet", "sheet"),
        *("hol", "pressed_dent"),
        *("5", "-3mm", "0.5in"),
        *("deep", "1mm"),
        *("", "mine", "mine.yaml", "ours.yaml"),
    ]
    type_lines(monkeypatch, "\n".join(answers) + "\n")
    assert main(["start"]) == 0
    printed = capsys.readouterr().out
    for mistake in (
        "there is no camera 'azure_kinect'; did you mean 'azure_kinect_nfov",
        "legal: adi_adtf3175_512, ",
        "--recording capturs: no such file",
        "--part shet: no such part; did you mean 'sheet'?",
        "--damage hol: no such damage here; did you mean 'hole'?",
        "--size 5: is not a length with a unit",
        "--size -3mm: is not a length",
        "--depth deep: is not a length",
        "--out mine: is no name",
        "--out mine.yaml: there is such a file",
    ):
        assert mistake in printed
    detect, implant, sweep = proposed(printed)
    assert detect == "tofpod detect captures --tolerance width=12.7mm --out findings"
    assert implant == (
        "tofpod implant captures --camera azure_kinect_nfov --damage pressed_dent"
        " --diameters 4.23:25.4 --depths 1:1 --out implanted"
    )
    assert sweep == "tofpod sweep ours.yaml"
    experiment = load_experiment(home / "ours.yaml")
    assert experiment.config.simulated.target.distance_m == 0.7
    assert (home / "mine.yaml").read_text() == ""


def test_only_what_is_not_stated_is_asked(home: Path, monkeypatch, capsys) -> None:
    type_lines(monkeypatch, "hole\n")
    words = words_of({**STATED, "--recording": "none", "--distance": "1m", "--out": "a.yaml"})
    del words[4:6]
    assert "--damage" not in words
    assert main(["start", *words]) == 0
    assert "Which damage?" in capsys.readouterr().out
    assert load_experiment(home / "a.yaml").config.simulated.target.distance_m == 1.0


@pytest.mark.parametrize("lines", ["", "azure_kinect_nfov\n", "azure_kinect_nfov\n\nboard\nhole"])
def test_an_input_that_ends_writes_nothing(lines: str, home: Path, monkeypatch, capsys) -> None:
    type_lines(monkeypatch, lines)
    assert main(["start"]) == 2
    message = capsys.readouterr().err
    assert message.startswith("error: the input ended before --")
    assert not list(home.iterdir())


@pytest.mark.parametrize("number", [0, 2, 6])
def test_ctrl_c_writes_nothing(number: int, home: Path, monkeypatch, capsys) -> None:
    lines = iter("azure_kinect_nfov\n\nboard\nhole\n5mm\n\n\n".splitlines(keepends=True)[:number])

    class Typing:
        def readline(self) -> str:
            for line in lines:
                return line
            raise KeyboardInterrupt

    monkeypatch.setattr("sys.stdin", Typing())
    assert main(["start"]) == 130
    assert capsys.readouterr().err == "interrupted\n"
    assert not list(home.iterdir())


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"--camera": "kinect_v3"}, "did you mean 'kinect_v2'?"),
        ({"--camera": "./none.yaml"}, "none.yaml"),
        ({"--part": "bord"}, "did you mean 'board'?"),
        ({"--damage": "cauliflower"}, "--damage cauliflower: no such damage here"),
        ({"--size": "5 feet"}, "--size 5 feet: is not a length"),
        ({"--depth": "1mm"}, "--depth: a hole goes through the part"),
        ({"--distance": "far"}, "--distance far: is not a length"),
        ({"--distance": "90m"}, "the answers do not fit together"),
        ({"--size": "9m"}, "the answers do not fit together"),
        ({"--recording": "nowhere"}, "--recording nowhere: no such file"),
        ({"--out": "a/b.yaml"}, "--out a/b.yaml: there is no folder a"),
        ({"--out": "b.txt"}, "--out b.txt: is no name"),
    ],
)
def test_a_wrong_option_is_one_message_and_writes_nothing(
    changed: dict[str, str], message: str, home: Path, monkeypatch, capsys
) -> None:
    monkeypatch.setattr("sys.stdin", None)
    assert main(["start", *words_of({**STATED, **changed})]) == 2
    printed = capsys.readouterr().err
    assert printed.startswith("error: ") and message in printed
    assert "Traceback" not in printed
    assert not list(home.iterdir())


REFUSED = {
    **{(kind, "wall"): "need a smooth face" for kind in ("through", "blind", "dent")},
    **{("dent", part): "on this face can be" for part in ("sheet", "pipe")},
}
"""What cannot be: drilled holes in rough concrete, and balls pressed into bent faces so flatly."""


@pytest.mark.parametrize(("kind", "part"), REFUSED)
def test_damage_that_a_part_cannot_have_is_refused(kind, part, home: Path, capsys) -> None:
    changed = {"--damage": kind, "--part": part, "--size": "30mm"}
    changed |= {} if kind == "through" else {"--depth": "0.5mm"}
    assert main(["start", *words_of({**STATED, **changed})]) == 2
    message = capsys.readouterr().err
    assert "the answers do not fit together" in message and REFUSED[kind, part] in message
    assert len(message.splitlines()) == 3
    assert not list(home.iterdir())


@pytest.mark.parametrize(
    ("kind", "part"),
    [*((kind, "board") for kind in KINDS), ("slot", "wall"), ("gouge", "pipe"), ("slot", "sheet")],
)
def test_every_part_and_damage_is_an_experiment(kind: str, part: str, home: Path) -> None:
    is_dent = kind in ("dent", "pressed_dent", "pressed_bump")
    depth_mm = None if kind == "through" else 0.5
    inquiry = Inquiry(
        camera="kinect_v2",
        recording=home,
        part=part,
        kind=kind,
        tolerance_mm=30.0 if is_dent or kind == "gouge" else 6.0,
        depth_mm=depth_mm,
        distance_m=0.8,
    )
    file = home / "x.yaml"
    file.write_text(experiment_text(inquiry, "x"))
    drawn = load_experiment(file).config.simulated.target
    low_mm, high_mm = drawn.damage.size_mm
    assert low_mm < inquiry.tolerance_mm < high_mm
    assert drawn.damage.depths_mm == (None if depth_mm is None else (0.5, 0.5))
    drawn.drawn("damaged", 0)
    detect, second, sweep = commands(inquiry, file)
    assert ("implant" in second[0]) == (kind in IMPLANTED)
    assert len(proposed("\n".join(f"  {words}" for words, _ in (detect, second, sweep)))) == 3


@pytest.mark.parametrize(
    ("tolerance_mm", "per_board"), [(20.0, 8), (30.0, 4), (40.0, 2), (60.0, 1)]
)
def test_as_much_damage_as_leaves_room_is_on_a_board(
    tolerance_mm: float, per_board: int, home: Path
) -> None:
    """Holes of up to twice the tolerance, 10 mm apart: their circles fill at most three tenths of a
    board of 304.8 x 203.2 mm, and there are at most eight."""
    inquiry = Inquiry(
        camera="kinect_v2",
        recording=None,
        part="board",
        kind="through",
        tolerance_mm=tolerance_mm,
        depth_mm=None,
        distance_m=0.8,
    )
    file = home / "x.yaml"
    file.write_text(experiment_text(inquiry, "x"))
    assert load_experiment(file).config.simulated.target.damage.per_board == per_board


def test_questions_name_damage_that_is_known() -> None:
    from harness.programs.implant.implant import DAMAGES

    assert IMPLANTED == DAMAGES
    for word in ("hole", "blind-hole", "dent", "crack", "scratch", "bump"):
        assert damage_kind("--damage", word, KINDS) in KINDS
    parser = importlib.import_module(MODULES["start"]).main.parser()
    assert {*NEEDED} <= {action.dest for action in parser._actions}
