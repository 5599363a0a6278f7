"""Every command and every block of Python in README and docs runs, in its document's order, on
small inputs."""

from __future__ import annotations

import glob
import importlib
import itertools
import json
import os
import re
import shlex
import shutil
import sys
import textwrap
import tomllib
import types
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pandas as pd
import pytest
import trimesh

import tofpod
from detectors import detector_type
from detectors.methods.learned import SHIPPED
from detectors.methods.network import read_network
from harness.__main__ import MODULES, PROGRAMS, main
from harness.experiment.load import load_experiment
from harness.vocabulary.geometry import MM, Cloud, Lens
from tests.detectors.surfaces.test_drawing import casting
from tests.detectors.surfaces.test_drawing import seen as casting_seen
from tests.detectors.views.marks.test_marks_coded import PLACES, tags
from tests.support import marked_board, tiny_dataset
from tests.support.marked_boards import LENS, board_pose, marked_cloud, strips
from tests.support.plug_in_packages import offer
from tests.support.recorded_plane import calibration, write_mkv
from tests.support.tiny_sweep import STUDY

ROOT = Path(__file__).resolve().parents[1]
MADE = {"index.md", "reference.md", "contributing.md"}  # by make docs
TEXTS = [
    ROOT / "README.md",
    *(path for path in sorted((ROOT / "docs").glob("*.md")) if path.name not in MADE),
]
COMMANDS = re.compile(
    r"(?:^ {4,}|`)(?:tofpod |python -m harness\.)([a-z_]+ [^`#\n]*)", re.MULTILINE
)
ONLY_PARSED = {
    "coverage pipe": "takes minutes; test_coverage runs the program on a smaller part",
    "--set-up": "needs a study with a curve; test_gauge and test_mapod run the chain",
    "--gauge": "needs a capture of a gauge; test_gauge and test_gauge_reading run it",
    "--spheres": "needs a capture of spheres; test_spheres_program runs it",
    "--scheduler": "needs a cluster; test_engine_cluster runs sweeps on one",
    "check experiments/regression.yaml": "takes minutes; .ci/run runs it as it stands",
    "--camera ./blaze101.yaml": "needs captures by that camera; test_validate and test_validate_capture run these",
    "validate --board plate": "takes minutes; test_validate_board runs --board on a smaller plate",
    "compare A B": "stands for two folders; test_compare runs the program",
    "artefacts --": "makes answers of the checkout again; test_making runs it elsewhere",
    "mvtec_3d_anomaly_detection": "is another's data set; test_mvtec scores one in its layout",
    "score detector": "needs a finished data set; test_leaderboard runs it",
    "score rank": "likewise",
    "--filter acme_smooth": "needs the reader's package; test_streams offers such filters",
    "yours.yaml": "stands for the reader's own file",
    "captures/part --reference": "needs captures of parts that are alike; test_references runs it",
    "atlas pmd_flexx2": "takes hours; test_making makes shards of small experiments",
}


def commands_in(path: Path) -> Iterator[list[str]]:
    """Yield the programs' commands in a document, each once, as words."""
    for command in dict.fromkeys(COMMANDS.findall(path.read_text().replace("\\\n", " "))):
        words = shlex.split(command)
        if words[0] in MODULES and words[1:] and "..." not in command:
            yield words


@pytest.mark.parametrize("path", TEXTS, ids=lambda path: path.name)
def test_every_command_is_understood(path: Path):
    for name, *arguments in commands_in(path):
        program, words = importlib.import_module(MODULES[name]).main.chosen_by(arguments)
        assert program.parser().parse_args(words), arguments


def block_of(document: str, first_line: str) -> str:
    """Return the indented block of a document that begins with a line."""
    text = (ROOT / document).read_text()
    lines = text[text.index(f"    {first_line}\n") :].splitlines()
    inside = itertools.takewhile(lambda line: line.startswith("    ") or not line, lines)
    return textwrap.dedent("\n".join(inside))


def test_the_readme_is_short():
    text = (ROOT / "README.md").read_text()
    of_ages = r"<!--.*?-->|\*?Older than the code.*"  # come and go with the code
    assert len(re.sub(of_ages, "", text).split()) <= 700


QUOTED = re.compile(r"<!-- artefact: (\w+) -->\n.*?<!-- end: \1 -->", re.DOTALL)
LINK = re.compile(r"\]\(([^)#\s]*)(?:#([^)\s]*))?\)")


def words_to_read(text: str) -> list[str]:
    """The words of a document outside of markers and code blocks, with those of tables by hand.
    Bars and dashes are none."""
    lines = QUOTED.sub("", text).splitlines()
    prose = [line for line in lines if not line.startswith("    ")]
    return [word for word in " ".join(prose).split() if re.search(r"\w", word)]


def test_the_documents_are_short():
    texts = [*TEXTS, ROOT / "CONTRIBUTING.md"]
    counts = {path.name: len(words_to_read(path.read_text())) for path in texts}
    assert sum(counts.values()) <= 18_000, counts


def anchors_of(text: str) -> set[str]:
    """The anchors of a document's headings, as the site and the forge form them."""
    headings = re.findall(r"^#+ (.+)$", text, re.MULTILINE)
    plain = [re.sub(r"[^\w\s-]", "", heading).strip().lower() for heading in headings]
    return {re.sub(r"\s+", "-", heading) for heading in plain}


@pytest.mark.parametrize("path", [*TEXTS, ROOT / "CONTRIBUTING.md"], ids=lambda path: path.name)
def test_every_link_leads_somewhere(path: Path):
    text = path.read_text()
    for file, anchor in LINK.findall(text):
        if file.startswith("http") or Path(file).name in MADE:
            continue
        target = path.parent / file if file else path
        assert target.exists(), file
        assert not anchor or anchor in anchors_of(target.read_text()), f"{file}#{anchor}"


def test_pages_are_named_by_their_task():
    """A page's title is its entry in the menu of the site."""
    menu = dict(re.findall(r"^ +- (.+): (\w+\.md)$", (ROOT / "mkdocs.yml").read_text(), re.M))
    by_page = {page: entry for entry, page in menu.items() if page not in MADE}
    titles = {
        path.name: path.read_text().splitlines()[0].removeprefix("# ")
        for path in TEXTS
        if path.parent == ROOT / "docs"
    }
    assert by_page == titles


def test_twenty_questions_have_one_command_or_page_each():
    text = (ROOT / "docs/tasks.md").read_text()
    rows = re.findall(r"^\| .+[.?] \| (.+) \| (seconds|minutes|a page) \|$", text, re.MULTILINE)
    assert len(rows) == 20
    for answer, takes in rows:
        page = re.fullmatch(r"\[.+\]\((\w+\.md)\)", answer)
        assert (page is not None) == (takes == "a page")
        if page is not None:
            assert (ROOT / "docs" / page[1]).is_file()
            continue
        program_name, name, *arguments = shlex.split(answer.strip("`"))
        program, words = importlib.import_module(MODULES[name]).main.chosen_by(arguments)
        assert program_name == "tofpod" and program.parser().parse_args(words)


@pytest.fixture
def acme_package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The package that the pages on detectors and on the gate write together, installed."""
    for document in ("docs/extending.md", "docs/ci_gate.md"):
        for name in re.findall(r"^    # ([\w/]+\.\w+)$", (ROOT / document).read_text(), re.M):
            path = tmp_path / name
            path.parent.mkdir(exist_ok=True)
            path.write_text(block_of(document, f"# {name}"))
    project = tomllib.loads((tmp_path / "pyproject.toml").read_text())["project"]
    entries = project["entry-points"]["tofpod.detectors"]
    offer(monkeypatch, tmp_path, project["name"], "tofpod.detectors", entries)
    monkeypatch.delitem(sys.modules, "acme_inspection.detector", raising=False)
    monkeypatch.delitem(sys.modules, "acme_inspection", raising=False)
    return tmp_path


def test_the_documented_package_keeps_the_contract(acme_package, monkeypatch):
    tests: dict[str, Any] = {}
    exec((acme_package / "tests/test_contract.py").read_text(), tests)
    tests["test_contract"]()

    # the same test fails where the detector finds nothing
    detector = importlib.import_module("acme_inspection.detector")
    monkeypatch.setattr(detector.MeanDetector, "find", lambda *_: ())
    with pytest.raises(AssertionError):
        tests["test_contract"]()


def test_the_documented_gate_runs_the_documented_detector(acme_package):
    experiment = load_experiment(acme_package / "tests/limit.yaml")
    assert experiment.config.study is not None and experiment.config.name == "acme_limit"
    (point,) = experiment.points
    assert point.config.detector.name == "acme_mean"
    assert detector_type("acme_mean").__module__ == "acme_inspection.detector"
    compile((acme_package / "tests/test_limit.py").read_text(), "test_limit.py", "exec")


def test_the_documented_network_is_a_detector(monkeypatch, tmp_path):
    casting = types.ModuleType("acme_inspection.casting")
    casting.__file__ = str(tmp_path / "casting.py")
    shutil.copy(SHIPPED, tmp_path / "casting.npz")
    monkeypatch.setitem(sys.modules, "acme_inspection.casting", casting)
    exec(block_of("docs/extending.md", "# acme_inspection/casting.py"), casting.__dict__)
    detector = casting.CastingDetector(casting.CastingConfig.from_data({}))
    assert detector.settings.network == str(tmp_path / "casting.npz")
    assert detector.network.facts == read_network(SHIPPED).facts


# ---- small experiments
# -----------------------------------------------------------------------------------------------

BOARD = "source.target.board={width_mm: 190, height_mm: 130, thickness_mm: 12.7}"
SMALL_STUDY = (
    *(
        "study.boards=4",
        "study.hole_free_boards=2",
        "threshold.calibrate={boards: 4, false_calls_per_m2: 20}",
    ),
    *(BOARD, "source.render={bounces: 0}", "sweep={capture.frames: [1, 50]}"),
)
SMALL_REPEATS = (
    "repeats=2",
    "threshold.calibrate.repeats=2",
    "source.render={bounces: 0}",
    "sensitivity=null",
)
SMALL = {
    "detection_limit": (
        *SMALL_STUDY,
        "source.target.damage={kind: through, per_board: 4, diameter_mm: [2, 12]}",
    ),
    "detectors": (*SMALL_STUDY, "sweep={detector.name: [thesis, matched]}"),
    "today": (
        *SMALL_STUDY[:3],
        "source.render={bounces: 0}",
        "sweep={source.camera.name: [azure_kinect_nfov, pmd_flexx2]}",
    ),
    "pipe": (*SMALL_STUDY[:3], "source.render={bounces: 0}"),
    "panel": (*SMALL_STUDY[:3], "source.render={bounces: 0}"),
    "frames": (*SMALL_STUDY, "sweep={capture.frames: [1, 5]}"),
    "training": (
        "study.units=2",
        "source.render={bounces: 0}",
        "sweep={capture.frames: [1]}",
    ),
    "filters": (
        *SMALL_STUDY[:-1],
        "sweep={capture.filter: [null, {name: median}], capture.frames: [1]}",
    ),
    "averaging": (*SMALL_REPEATS, "sweep={capture.frames: [1, 5]}"),
    "cameras": (*SMALL_REPEATS, "sweep={source.camera.name: [azure_kinect_nfov, kinect_v2]}"),
    "anatomy": (
        "repeats=2",
        "threshold.calibrate.repeats=2",
        "sweep={capture.frames: [1]}",
    ),
    "perspectives": (*SMALL_REPEATS, "capture.frames=5", "sweep={mapping.views: [1, 2]}"),
}
IN_RESULTS = ("sweep", "efficiency", "filters", "coverage", "ask", "design", "ls")
MORE = {
    "audit": ("--studies", "2"),
    "implant": ("--targets", "8", "--hit-radius", "6", "--apart", "32"),
    "design": ("--studies", "20"),
    "dataset": ("--serial", "--boards", "10"),
    "sweep": ("--serial",),
    "train": ("--serial", "--set", "study.boards=2", "--passes", "1", "--channels", "2"),
    "efficiency": ("--serial",),
    "filters": ("--serial",),
}


def shrunk(name: str, given: list[str]) -> list[str]:
    """Return a command's arguments with those that make it small; what the document states comes
    later and counts."""
    small = (
        SMALL.get(Path(given[0]).stem, ())
        if name in ("sweep", "export", "dataset", "coverage", "train", "filters")
        else ()
    )
    settings = [word for change in small for word in ("--set", change)]
    return [given[0], *settings, *given[1:], *MORE.get(name, ())]


# ---- small recordings
# ------------------------------------------------------------------------------------------------


def write_capture(
    folder: Path, depth_m: list[np.ndarray], lens: Lens, rgb: np.ndarray | None = None
) -> None:
    """Depth pictures in millimetres, colour where there is some, and the lens, as Open3D's
    recorder stores them."""
    pictures = [("depth", [np.rint(np.nan_to_num(z_m) / MM).astype(np.uint16) for z_m in depth_m])]
    pictures += (
        [] if rgb is None else [("color", len(depth_m) * [np.ascontiguousarray(rgb[..., ::-1])])]
    )
    for name, images in pictures:
        (folder / name).mkdir(parents=True)
        for number, image in enumerate(images):
            assert cv2.imwrite(str(folder / name / f"{number:05d}.png"), image)
    sizes = {
        "width": lens.width,
        "height": lens.height,
        "intrinsic_matrix": lens.matrix.T.ravel().tolist(),
    }
    (folder / "intrinsic.json").write_text(json.dumps(sizes))


def simulated(
    home: Path, place: str, distance_m: float, offset_mm: float, hole_mm: float = 0.0
) -> None:
    """50 frames of an Azure Kinect before a small board; one with a hole stands before a wall."""
    holes = [{"id": 1, "diameter_mm": hole_mm, "centre_mm": [10, 5]}] if hole_mm else []
    board = {"width_mm": 190, "height_mm": 150, "thickness_mm": 12.7}
    pose = {"distance_m": distance_m, "tilt_x_deg": 4, "tilt_y_deg": 3, "offset_x_mm": offset_mm}
    target = tofpod.target({"name": "custom", "board": board, "holes": holes, "pose": pose})
    unit = tofpod.render(
        target, "azure_kinect_nfov", bounces=0, cache=home / "results" / ".cache" / "renders"
    )
    lens = unit.camera.nominal_lens
    cut = unit.region.within(lens.whole)
    rng = np.random.default_rng(len(place))
    complete = []
    for frame in tofpod.frames(unit, 50, seed=int(rng.integers(99))).frames():
        z_m = rng.normal(1.3, 2 * MM, lens.whole.shape) * bool(holes)
        z_m[cut] = np.where(np.isfinite(frame.z_m), frame.z_m, z_m[cut])
        complete.append(z_m)
    write_capture(home / place, complete, lens)


def seen_at(cloud: Cloud, count: int = 5) -> list[np.ndarray]:
    """Frames (h, w) of z with noise."""
    rng = np.random.default_rng(1)
    return [
        cloud.points_m[..., 2] + rng.normal(0, 0.5 * MM, cloud.valid.shape) for _ in range(count)
    ]


WALLS = [
    "near1",
    "near2",
    "near3",
    "far1",
    "far2",
    "far3",
    *(f"captures/{n}" for n in ("near", "shifted", "far", "wall")),
]


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with what the documents' commands read."""
    home = tmp_path_factory.mktemp("documents")
    (home / "experiments").symlink_to(ROOT / "experiments")
    (home / "study.yaml").write_text(STUDY.replace("name: tiny", "name: study"))
    for number, position in enumerate(WALLS):
        simulated(home, position, 0.8 if "far" in position else 0.5, 15.0 * (number % 3))
    shutil.copytree(home / "captures" / "wall", home / "captures" / "part")
    simulated(home, "captures/board", 0.5, 0.0, hole_mm=16.0)

    flat = casting(home / "flat.stl")
    T = np.diag([1.0, -1.0, -1.0, 1.0])
    T[2, 3] = 0.5
    cloud = casting_seen(flat, T, 0.0, dent_mm=3.0)
    write_capture(home / "captures" / "casting", seen_at(cloud), cloud.lens)
    turned = trimesh.load(flat)  # its front towards -y, as the document has it
    turned.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, [1, 0, 0])).export(
        home / "casting.stl"
    )

    codes = tags({key: (x, y + 0.02) for key, (x, y) in PLACES.items()})
    tapes = strips(marked_board.STRIPS_M)

    def paint(xy: np.ndarray) -> np.ndarray:
        over = codes(xy)
        under = tapes(xy)
        return np.where((over == codes(np.full_like(xy, 9.0))), under, over)

    wide = replace(LENS, width=480, height=260, cx=239.5, cy=129.5)
    for name, turn_deg in (("left", -8.0), ("right", 9.0)):
        view = marked_cloud(board_pose(3.0, turn_deg), paint, samples=2, lens=wide)
        write_capture(home / name, seen_at(view), wide, view.rgb)
    for name, turn_deg in (("A", 3.0), ("B", 18.0), ("C", -15.0)):
        marked_board.write_view(home / name, marked_board.T_camera_board(turn_deg), seed=1)

    wall_mm = (np.random.default_rng(number).normal(700, 2, (576, 640)) for number in range(6))
    pictures = [
        {"DEPTH": mm.astype(np.uint16), "IR": np.full(mm.shape, 900, np.uint16)} for mm in wall_mm
    ]
    write_mkv(home / "recording.mkv", pictures, attached=calibration())

    rng = np.random.default_rng(4)
    size = rng.uniform(1, 9, 80)
    result = rng.random(80) < 1 / (1 + np.exp(-2 * (size - 4)))
    table = pd.DataFrame(
        {"length": size, "length_mm": size, "diameter_mm": size, "hit": result.astype(int)}
    )
    table = table.assign(found=table["hit"], inspector_A=table["hit"], inspector_B=table["hit"])
    table = table.assign(hole=range(80), board=[f"b{n // 20}" for n in range(80)])
    table = table.assign(depth=0.2 * size + rng.normal(0, 0.1, 80))
    for name in ("inspections.csv", "holes.csv"):
        table.to_csv(home / name, index=False)
    table.to_excel(home / "inspections.xlsx", index=False)
    return home


@pytest.fixture
def home(inputs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The current folder: a copy of the inputs, which shares the results with all others."""
    home = tmp_path / "home"
    shutil.copytree(
        inputs, home, symlinks=True, copy_function=os.link, ignore=lambda *_: ["results"]
    )
    (inputs / "results").mkdir(exist_ok=True)
    (home / "results").symlink_to(inputs / "results")
    monkeypatch.chdir(home)
    return home


@pytest.fixture(scope="module")
def already_run() -> set[str]:
    """Commands that write into the results that all documents share: the next document need not
    run them again."""
    return set()


# ---- the commands
# ----------------------------------------------------------------------------------------------------


def filled(words: list[str], home: Path) -> list[str]:
    """Return words as a shell and a reader would fill them in: patterns of names, and the digests
    of results."""
    complete = []
    for word in words:
        pattern = re.sub(r"<\w+>|\bDIGEST\b", "*", word)
        names = sorted(
            name for name in glob.glob(pattern, root_dir=home) if not name.endswith("/latest")
        )
        if "<another>" in word:
            names = names[1:]
        if pattern == word and "*" not in word:
            complete.append(word)
        elif names:
            complete += names if "_0*" in word or "part*" in word else names[:1]
        else:  # a folder that the command makes, named as the one before it
            complete.append(str(Path(word).parent / Path(complete[-2]).name))
    return [{"NAME": "azure_kinect_nfov"}.get(word, word) for word in complete]


def sweep_once(name: str, home: Path) -> None:
    """Make the small results of an experiment, if there are none."""
    if not (home / "results" / name / "latest").exists():
        small = [word for change in SMALL[name] for word in ("--set", change)]
        assert main(["sweep", f"experiments/{name}.yaml", *small, "--serial"]) == 0


def prepare(command: str, home: Path) -> None:
    """Make what a person makes between two commands."""
    if command.startswith("efficiency results/frames"):
        sweep_once("frames", home)
    if command.startswith("clean results averaging"):
        sweep_once("averaging", home)
    if command.startswith("score maps"):
        if not (home / "boards").exists():
            assert tiny_dataset.write(home, "boards") == 0
        for name in tiny_dataset.names_in(home / "boards"):
            damage = tiny_dataset.arrays_of(home / "boards", name)["damage"]
            path = home / "maps" / f"{name}.npy"
            path.parent.mkdir(parents=True, exist_ok=True)
            if "/train/" not in name:
                np.save(
                    path, np.random.default_rng(1).normal(size=damage.shape) + 6.0 * (damage > 0)
                )
    if command.startswith("compare scores_a"):
        for name in ("scores_a", "scores_b"):
            shutil.copytree(home / "scores", home / name)
    if command == "compare A B":
        for name, run in zip(
            "AB", sorted(home.glob("results/detection_limit/*[!t]")), strict=False
        ):
            shutil.rmtree(home / name)
            (home / name).symlink_to(run)


@pytest.mark.slow
@pytest.mark.parametrize(
    "path", [path for path in TEXTS if any(commands_in(path))], ids=lambda path: path.name
)
def test_every_command_runs(path: Path, home: Path, already_run: set[str], capfd):
    for name, text in re.findall(r"\n    # (\w+\.yaml)\n((?:    .*\n)+)", path.read_text()):
        (home / name).write_text(textwrap.dedent(text))
    run_all(commands_in(path), home, already_run, capfd)


def run_all(commands, home: Path, already_run: set[str], capfd) -> None:
    """Run commands on small inputs, but those of `ONLY_PARSED`."""
    for name, *arguments in commands:
        command = shlex.join([name, *arguments])
        reference = re.sub(r"experiments/(\w+)\.yaml", r"\1", command)
        if reference not in already_run and not any(part in command for part in ONLY_PARSED):
            already_run.update({reference} if name in IN_RESULTS else ())
            prepare(command, home)
            code = main([name, *shrunk(name, filled(arguments, home))])
            assert code == 0, f"{command}\n{''.join(capfd.readouterr())}"


def examples_of(module: str) -> list[list[str]]:
    """Return the examples of a program's help that no document shows, as words."""
    documented = [words for path in TEXTS for words in commands_in(path)]
    examples = []
    for example in importlib.import_module(module).main.examples:
        words = shlex.split(example)[1:]
        if words not in documented and "DIGEST" not in example:
            examples.append(words)
    return examples


@pytest.mark.slow
@pytest.mark.parametrize(
    "module", [entry.module for entry in PROGRAMS if examples_of(entry.module)]
)
def test_every_example_of_a_help_runs(module: str, home: Path, already_run: set[str], capfd):
    run_all(examples_of(module), home, already_run, capfd)


@pytest.mark.slow
def test_the_python_of_the_documents_runs(inputs: Path, tmp_path: Path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "results").symlink_to(inputs / "results")
    run = tofpod.sweep
    monkeypatch.setattr(
        tofpod, "sweep", lambda name, *changes: run(name, *changes, *SMALL["detection_limit"])
    )
    exec(block_of("docs/python.md", "import tofpod"), {})
    assert {path.name for path in tmp_path.iterdir()} == {"results", "found.png", "pod.png"}


def test_what_is_only_parsed_is_in_a_document_or_a_help():
    commands = {shlex.join(words) for path in TEXTS for words in commands_in(path)}
    commands |= {shlex.join(words) for entry in PROGRAMS for words in examples_of(entry.module)}
    assert [part for part in ONLY_PARSED if not any(part in command for command in commands)] == []
