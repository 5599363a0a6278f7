"""The jobs of which `jobs.py` measures the cost: experiments and programs, as a user runs them."""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from harness.vocabulary.files import write_text

ROOT = Path(__file__).resolve().parents[2]
TRAINED_ON = "training"
"""An experiment that `tofpod train` uses, and nobody sweeps."""
INSPECTIONS = 300
"""Number of inspections in the table that `tofpod pod` reads."""


@dataclass(frozen=True)
class Job:
    """A command that a user runs. In its words ``{out}`` is the folder of its results, and
    ``{inputs}`` the folder of recordings and tables that it reads."""

    name: str
    """Its name in the table."""
    words: tuple[str, ...]
    """The command, without ``tofpod``."""
    stored: str = ""
    """Folder of finished trials below ``{out}``, without which only renders are stored; empty for
    a job that stores nothing, and so is run once."""
    experiment: str = ""
    """The experiment's file, relative to a checkout; empty if it has none."""
    makes: str = ""
    """Pattern of a file below ``{out}`` without which the job had nothing to do, and so has no
    cost; empty for a job that always has."""

    def command(self, folders: Mapping[str, Path]) -> list[str]:
        """Return the words with these folders."""
        return [word.format_map(folders) for word in self.words]


@dataclass(frozen=True)
class Input:
    """A recording that programs read, made by a command that is not measured."""

    folder: str
    """Its folder below ``{inputs}``."""
    words: tuple[str, ...]
    """The command, without ``tofpod`` and the option ``--out``."""


EXPORT = ("export", "averaging", "--format", "tum", "--views", "1", "--frames", "20")
RENDERS = ("--results", "{inputs}/results")
INPUTS = (
    Input("damaged", (*EXPORT, *RENDERS)),
    Input("whole", (*EXPORT, "--hole-free", *RENDERS)),
)
"""One view of the drilled board of `averaging`, 20 frames, and the same without its holes."""
TUM = ("--unit", "5000/m", "--intrinsics")
"""What a sequence in TUM's layout does not say itself; the lens's file follows."""
PROGRAMS = (
    Job(
        name="tofpod check",
        words=("check", "experiments/regression.yaml", "--out", "{out}"),
        stored="regression",
        experiment="experiments/regression.yaml",
    ),
    Job(
        name="tofpod detect",
        words=(
            *("detect", "{inputs}/damaged/depth", *TUM, "{inputs}/damaged/rtabmap_calib.yaml"),
            *("--out", "{out}/detect"),
        ),
    ),
    Job(
        name="tofpod implant",
        words=(
            *("implant", "{inputs}/whole/depth", *TUM, "{inputs}/whole/rtabmap_calib.yaml"),
            *("--camera", "azure_kinect_nfov", "--damage", "through", "--diameters", "2:10"),
            *("--out", "{out}/implant"),
        ),
    ),
    Job(
        name="tofpod pod",
        words=(
            *("pod", "{inputs}/inspections.csv", "--hit", "found", "--size", "length"),
            *("--out", "{out}/pod"),
        ),
    ),
    Job(
        name="tofpod ask",
        words=("ask", "--damage", "hole", "--size", "7mm", "--distance", "1m"),
    ),
    Job(name="tofpod validate", words=("validate", "--out", "{out}/validate")),
    Job(
        name="tofpod atlas",
        words=("atlas", "--out", "{out}"),
        makes="atlas/*/provenance.json",  # nothing where the stored atlas is of this code
    ),
)
"""Programs beside `tofpod sweep`. The last takes as long as ten experiments."""


def experiments() -> list[Job]:
    """Return a job for each shipped experiment."""
    paths = sorted((ROOT / "experiments").glob("*.yaml"))
    return [sweep_of(path.stem) for path in paths if path.stem != TRAINED_ON]


def sweep_of(name: str) -> Job:
    """Return the job that runs an experiment."""
    file = f"experiments/{name}.yaml"
    words = ("sweep", file, "--out", "{out}")
    return Job(name=name, words=words, stored=name, experiment=file)


def jobs_named(names: list[str]) -> list[Job]:
    """Return the jobs with these names, all if there are none; ``detect`` names `tofpod detect`.
    Ends this program for an unknown name."""
    known = {job.name: job for job in (*experiments(), *PROGRAMS)}
    if not names:
        return list(known.values())
    chosen = []
    for name in names:
        full_name = name if name in known else f"tofpod {name}"
        if full_name not in known:
            raise SystemExit(f"{name!r} is no job; these are: {', '.join(known)}")
        chosen.append(known[full_name])
    return chosen


def write_inspections(path: Path) -> None:
    """Write a table of inspections: lengths of 1 to 9 mm, of which one of 4 mm is found in half of
    the cases."""
    rng = np.random.default_rng(1)
    lengths_mm = rng.uniform(1, 9, INSPECTIONS)
    shares_found = 1 / (1 + np.exp(-2 * (lengths_mm - 4)))
    found = rng.random(INSPECTIONS) < shares_found
    lines = ["length,found"]
    for length_mm, is_found in zip(lengths_mm, found, strict=True):
        lines.append(f"{length_mm:.3f},{int(is_found)}")
    write_text(path, "\n".join(lines) + "\n")


def keep_results(folder: Path, results: Path) -> None:
    """Move all files and links below a folder of results into another folder of results, in place
    of those with the same names. Then programs find their trials and renders there."""
    for path in sorted(folder.rglob("*")):
        if path.is_dir() and not path.is_symlink():
            continue
        kept = results / path.relative_to(folder)
        kept.parent.mkdir(parents=True, exist_ok=True)
        kept.unlink(missing_ok=True)
        shutil.move(path, kept)
    shutil.rmtree(folder)
