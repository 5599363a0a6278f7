"""The inputs: a program, its arguments, and which file or argument gets a fault."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tests.fuzz.mutations import spoiled

ODD_WORDS = (
    "",
    "nan",
    "inf",
    "-1",
    "0",
    "1e999",
    "1e-999",
    "x",
    "2:1",
    "nan:1",
    "5mm",
    "1e9m",
    "../..",
    "/dev/null",
    "/proc/self/mem",
    "a=b",
    "[]",
    "9" * 30,
    "<b>",
    "é",
    "--",
    "0:0,1,2",
)


@dataclass(frozen=True)
class Case:
    """A command line on valid inputs."""

    program: str
    """Name of the program."""
    words: str
    """Its arguments, separated by blanks."""
    folders: Sequence[str]
    """Folders of the valid inputs that it needs."""
    files: Sequence[str] = ()
    """Patterns of the files that may get a fault; all files of the folders if empty."""
    weight: int = 1
    """How often it is drawn, compared with others."""


@dataclass(frozen=True)
class Input:
    """A malformed input, written and ready."""

    number: int
    program: str
    words: tuple[str, ...]
    folder: Path
    """The working folder, which holds all files."""


LOCAL = "--detector local"
CAPTURES = (
    Case("detect", f"pngs {LOCAL}", ["pngs"], weight=3),
    Case("detect", f"depth/depth.npy {LOCAL}", ["depth"], weight=3),
    Case("detect", f"depth/depth.npy {LOCAL} --out found", ["depth"]),
    Case("detect", f"npz/depth.npz {LOCAL}", ["npz"], weight=3),
    Case("detect", f"npz/depth.npz {LOCAL} --array depth:0", ["npz"]),
    Case("detect", f"mat/depth.mat {LOCAL}", ["mat"], weight=2),
    Case("detect", f"tiff/depth.tiff {LOCAL}", ["tiff"], weight=2),
    Case("detect", f"pfm/depth.pfm {LOCAL}", ["pfm"]),
    Case("detect", f"exr/depth.exr {LOCAL}", ["exr"], weight=3),
    Case("detect", f"raw/depth.bin --raw 96x72:u2 {LOCAL}", ["raw"]),
    Case("detect", f"height/height.npy --pitch 1mm {LOCAL}", ["height"], weight=2),
    Case("detect", f"stray {LOCAL}", ["stray"], weight=2),
    Case("detect", f"r3d/a.r3d {LOCAL}", ["r3d"], weight=3),
    Case("detect", f"mkv/a.mkv {LOCAL}", ["mkv"], weight=3),
    Case("detect", f"ply/a.ply {LOCAL}", ["ply"], weight=3),
    Case("detect", f"pcd/a.pcd {LOCAL}", ["pcd"], weight=3),
    Case("detect", f"pcd_text/a.pcd {LOCAL}", ["pcd_text"], weight=4),
    Case("detect", f"xyz/a.xyz {LOCAL}", ["xyz"], weight=4),
    Case("detect", f"csv/a.csv {LOCAL}", ["csv"], weight=4),
    Case("detect", f"bag_clouds {LOCAL}", ["bag_clouds"], weight=4),
    Case("detect", f"bag_images {LOCAL}", ["bag_images"], weight=4),
    Case("detect", f"bag_packed {LOCAL}", ["bag_packed"], weight=3),
    Case("detect", f"ros1/a.bag {LOCAL}", ["ros1"], weight=4),
    Case("detect", "pngs --detector matched", ["pngs"]),
    Case("detect", "depth/depth.npy --detector thesis", ["depth"]),
    Case("detect", "pngs --max-frames 2", ["pngs"]),
)
REFERENCES = tuple(
    Case(
        "detect",
        f"pngs {LOCAL} --reference parts/{name} --set reference.unit=mm",
        ["pngs", "parts"],
        [f"parts/{name}"],
        weight=4,
    )
    for name in ("part.stl", "text.stl", "part.ply", "part.obj", "part.glb")
)
EARLIER = tuple(
    Case(
        "detect",
        f"pngs {LOCAL} --reference {name} --tolerance depth=1mm",
        ["pngs", name.split("/")[0]],
        [name],
        weight=2,
    )
    for name in ("npz/depth.npz", "ply/a.ply")
)
LENSES = tuple(
    Case(
        "detect",
        f"depth/depth.npy {LOCAL} --intrinsics parts/{name}",
        ["depth", "parts"],
        [f"parts/{name}"],
        weight=2,
    )
    for name in ("calibration.json", "camera.intr", "meta.mat", "lens.yaml")
)
VIEWS = tuple(
    Case(
        "detect",
        f"pngs depth/depth.npy {LOCAL} --register nominal --poses parts/{name}",
        ["pngs", "depth", "parts"],
        [f"parts/{name}"],
        weight=2,
    )
    for name in ("poses.json", "groundtruth.txt")
)
CAMERAS = tuple(
    Case(
        "export_noise",
        f"parts/{name}.yaml --out noise",
        ["parts"],
        [f"parts/{name}.yaml"],
        weight=4,
    )
    for name in ("azure_kinect_nfov", "realsense_l515", "kinect_v2")
)
EXPERIMENTS = tuple(
    Case(
        "sweep",
        f"parts/{name}.yaml --dry-run --out out",
        ["parts"],
        [f"parts/{name}.yaml"],
        weight=6,
    )
    for name in ("study", "views", "family", "sweep")
)
OTHERS = (
    Case(
        "detect",
        f"pngs {LOCAL} --flat-field made/unit.npz",
        ["pngs", "made"],
        ["made/unit.npz"],
        weight=5,
    ),
    Case("detect", f"depth/depth.npy {LOCAL} --quiet-capture wall/depth.npy", ["depth", "wall"]),
    Case("flatfield", "wall/depth.npy far/depth.npy --out unit.npz", ["wall", "far"], weight=4),
    Case("flatfield", "wall/depth.npy far/depth.npy --poses parts/poses.json --out unit.npz", ["wall", "far", "parts"],
         ["parts/poses.json"]),
    Case("characterise", "wall/depth.npy far/depth.npy --out mine", ["wall", "far"], weight=3),
    Case("characterise", "binned/depth.npy --like parts/binned.yaml --intrinsics azure_kinect_nfov_binned"
         " --out mine", ["binned", "parts"], ["parts/binned.yaml"]),
    Case("implant", "binned/depth.npy --camera parts/binned.yaml --damage through --diameters 4:12 --targets 4"
         " --intrinsics azure_kinect_nfov_binned --frames 2 --detector local --out implanted",
         ["binned", "parts"], ["parts/binned.yaml", "binned/*"], weight=3),
    Case("validate", "--capture binned/depth.npy --intrinsics azure_kinect_nfov_binned --out validated",
         ["binned"], weight=2),
    Case("validate", "--camera azure_kinect_nfov --figures parts/figures.yaml --out validated"
         " --jobs 1", ["parts"], ["parts/figures.yaml"], weight=2),
    Case("target", "parts/target.yaml --out board.ply --truth truth.json", ["parts"],
         ["parts/target.yaml"], weight=6),
    Case("target", "parts/boards.yaml --board 1", ["parts"], ["parts/boards.yaml"], weight=4),
    Case("target", "parts/mesh.yaml --out board.glb", ["parts"],
         ["parts/mesh.yaml", "parts/part.stl"], weight=6),
    Case("dataset", "parts/family.yaml --boards 10 --out boards --serial", ["parts"],
         ["parts/family.yaml"], weight=2),
    Case("dataset", "data/tiny.yaml --boards 10 --out data/boards --results data/results --serial",
         ["data"], ["data/boards/dataset.json", "data/boards/experiment.yaml"], weight=2),
    Case("export", "parts/sweep.yaml --format tum --out views --frames 1", ["parts"],
         ["parts/sweep.yaml"], weight=2),
    Case("coverage", "runs/tiny.yaml --set sweep={} --out covered --results runs/out --serial", ["runs"],
         ["runs/tiny.yaml"], weight=1),
    Case("check", "runs/tiny.yaml --baseline tables/regression.json --out runs/out --serial",
         ["runs", "tables"], ["tables/regression.json", "runs/tiny.yaml"], weight=3),
    Case("compare", "tables/a tables/b --out compared", ["tables"], ["tables/?/study.json"],
         weight=8),
    Case("design", "--study tables/a --studies 20 --targets 30", ["tables"],
         ["tables/a/study.json"], weight=4),
    Case("design", "--a50 4 --a90 6 --sizes 1:12 --studies 20 --targets 30", []),
    Case("gauge", "--diameters 2:12 --study tables/a --out made", ["tables"],
         ["tables/a/study.json"], weight=3),
    Case("gauge", "read pngs --gauge made/gauge/gauge.json", ["pngs", "made"],
         ["made/gauge/gauge.json"], weight=4),
    Case("pod", "tables/inspections.csv --size size --hit found --out fitted", ["tables"],
         ["tables/inspections.csv"], weight=6),
    Case("pod", "tables/inspections.csv --size size --ahat signal --decision 3 --out fitted",
         ["tables"], ["tables/inspections.csv"], weight=4),
    Case("pod", "tables/inspections.csv --size size --hit found --target target --prior tables/a"
         " --out fitted", ["tables"], ["tables/inspections.csv", "tables/a/study.json"], weight=3),
    Case("ask", "--size 5mm --distance 1m --atlas tables/atlas.json", ["tables"],
         ["tables/atlas.json"], weight=20),
    Case("ask", "--distance 1m --out atlas --atlas tables/atlas.json", ["tables"],
         ["tables/atlas.json"], weight=4),
    Case("score", "data/maps --dataset data/boards --out scored", ["data"],
         ["data/boards/dataset.json", "data/boards/boards/*/*/*/*/truth.json",
          "data/boards/boards/*/*/*/*/cloud.npz", "data/maps/*/*/*/*.npy"], weight=16),
    Case("efficiency", "runs/out/tiny/latest --serial", ["runs"], ["runs/out/tiny/[0-9a-f]*/*"],
         weight=4),
    Case("sweep", "runs/tiny.yaml --out runs/out --serial", ["runs"],
         ["runs/out/tiny/[0-9a-f]*/*", "runs/out/tiny/[0-9a-f]*/journal/*",
          "runs/out/.cache/renders/*.npz"], weight=3),
    Case("merge", "runs/out/tiny/latest --into merged", ["runs"],
         ["runs/out/tiny/[0-9a-f]*/*", "runs/out/tiny/[0-9a-f]*/journal/*"], weight=5),
    Case("ls", "results --results runs/out", ["runs"], ["runs/out/tiny/[0-9a-f]*/*"], weight=4),
    Case("ls", "cache --results runs/out", ["runs"], ["runs/out/.cache/renders/*.npz"]),
    Case("ls", "parts/kinect_v2.yaml", ["parts"], ["parts/kinect_v2.yaml"]),
    Case("clean", "results tiny --results runs/out --dry-run", ["runs"],
         ["runs/out/tiny/[0-9a-f]*/*"], weight=2),
    Case("clean", "results --keep 0GB --results runs/out --dry-run", ["runs"],
         ["runs/out/tiny/[0-9a-f]*/*"]),
    Case("record", "--from pngs --out recorded", ["pngs"], weight=2),
    Case("record", "--from mkv/a.mkv --out recorded --frames 2", ["mkv"], weight=2),
    Case("record", "--from bag_packed --out recorded", ["bag_packed"], weight=2),
    Case("record", "--from npz/depth.npz", ["npz"], weight=2),
    Case("clean", "cache --all --results runs/out --dry-run", ["runs"], ["runs/out/.cache/renders/*"]),
)  # fmt: skip
CASES = (*CAPTURES, *REFERENCES, *EARLIER, *LENSES, *VIEWS, *CAMERAS, *EXPERIMENTS, *OTHERS)
ODD_ARGUMENT = 0.08
"""Share of the inputs whose fault is an argument instead of a file."""


def prepared(base: Path, number: int, seed: int, only: str = "") -> Input:
    """Write an input into a folder of its own: valid files with one fault, or rarely two."""
    rng = np.random.default_rng([seed, number])
    cases = [case for case in CASES if only in ("", case.program)]
    weights = np.array([case.weight for case in cases], float)
    case = cases[int(rng.choice(len(cases), p=weights / weights.sum()))]
    folder = base.parent / "inputs" / str(number)
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    for name in case.folders:
        shutil.copytree(base / name, folder / name, symlinks=True)
    words = case.words.split()
    if not case.folders or rng.random() < ODD_ARGUMENT:
        _spoil_words(words, rng)
    else:
        files = _files(folder, case)
        for _ in range(int(rng.choice([1, 1, 1, 2]))):
            spoiled(files[int(rng.integers(len(files)))], rng)
    return Input(number, case.program, tuple(words), folder)


def _files(folder: Path, case: Case) -> list[Path]:
    """Return the files of a case that may get a fault."""
    patterns = case.files or [f"{name}/**/*" for name in case.folders]
    files: list[Path] = []
    for pattern in patterns:
        files += sorted(path for path in folder.glob(pattern) if path.is_file())
    assert files, case
    return files


def _spoil_words(words: list[str], rng: np.random.Generator) -> None:
    """Replace an argument by an odd one."""
    index = int(rng.integers(len(words)))
    words[index] = ODD_WORDS[rng.integers(len(ODD_WORDS))]
