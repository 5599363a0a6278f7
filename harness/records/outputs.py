"""Declares the files that programs write into a results folder, for `tofpod clean` and
`results/README.md`."""

import os
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

FolderKind = Literal["results", "capture"]


@dataclass(frozen=True)
class Output:
    """A file, or several, that programs write."""

    name: str
    """Its name; * and ? stand for any characters."""
    note: str
    """Its content."""
    place: FolderKind = "results"
    """Folder that holds it: a results folder, or a real capture's folder in it."""
    of: str = ""
    """Kind of experiment or program that writes it; empty for every sweep."""


REPORT = Output("report.html", "the report: a single file that can be read offline")
EXPERIMENT = Output("experiment.yaml", "the experiment with every default written out")
PROVENANCE = Output("provenance.json", "command, commit, versions, seed, machine, failures")
WRITTEN = Output(
    "written.json",
    "digests of the other files, by which the same command sees that all are written",
)
STUDY = Output(
    "study.json", "every inspection of every set-up: what `tofpod compare` reads", of="study"
)
LEARNED = Output(
    "learning-*.npz", "what a detector has learned from separate hole-free boards: arrays by name"
)
MAPS = Output("map-*.html", "a map that can be turned in the browser", of="views")
CAPTURES = Output("summary.csv", "one row per point: threshold, frames, findings", of="capture")
COMPARISON = Output("compare.json", "the comparison with another study, for programs", of="check")
COMPARISON_PAGE = Output("compare.html", "the comparison as a page", of="check")
EFFICIENCY_PAGE = Output(
    "efficiency.html", "detectors compared with the ideal observer", of="efficiency"
)
FILTERS_PAGE = Output(
    "filters.html", "what filters cost: changes of limits, false calls and sizes", of="filters"
)
COVERAGE_PAGE = Output(
    "coverage.html", "the part in 3-D, coloured by the size of damage that is found", of="coverage"
)
ATLAS_PAGE = Output(
    "atlas.html", "the atlas of limits: choose damage, size and distance", of="atlas"
)
ATLAS_PICTURE = Output("atlas.png", "the atlas as a picture", of="atlas")
FINDINGS = Output("findings.csv", "one row per finding", "capture", "capture")
FINDINGS_DATA = Output(
    "findings.json", "findings by both measures, target, settings, origin", "capture", "capture"
)
INSPECTION_PAGE = Output(
    REPORT.name,
    "the verdict, the findings in picture and cloud, and the table",
    "capture",
    "capture",
)
ANNOTATED = Output("annotated.png", "the findings drawn on the depth image", "capture", "capture")
TARGETS = Output(
    "targets.png", "the targets that were found, with the chosen target", "capture", "capture"
)
BLIND = Output("blind.png", "the pixels without a return", "capture", "capture")
GAUGE_ROWS = Output("gauge.csv", "hits and misses of a gauge board's holes", "capture", "capture")
DECISION = Output(
    "decision.html", "the decision on the tolerances, to print and sign", "capture", "capture"
)
DECISION_DATA = Output("decision.json", "the same for programs", "capture", "capture")
CHANGE = Output(
    "change.csv",
    "distances from the earlier capture, with their level of detection",
    "capture",
    "capture",
)
CLOUD = Output("cloud.ply", "the cloud, with findings in magenta", "capture", "capture")
FILES = (
    REPORT,
    EXPERIMENT,
    PROVENANCE,
    WRITTEN,
    STUDY,
    LEARNED,
    MAPS,
    CAPTURES,
    COMPARISON,
    COMPARISON_PAGE,
    EFFICIENCY_PAGE,
    FILTERS_PAGE,
    COVERAGE_PAGE,
    ATLAS_PAGE,
    ATLAS_PICTURE,
    FINDINGS,
    FINDINGS_DATA,
    INSPECTION_PAGE,
    ANNOTATED,
    TARGETS,
    BLIND,
    GAUGE_ROWS,
    CHANGE,
    DECISION,
    DECISION_DATA,
    CLOUD,
)
JOURNAL = "journal"
LATEST = "latest"
"""A link to the newest run; a text file with its name where the system has no links."""
RUN_NAME = re.compile(r"[0-9a-f]{16}")
LOCK_NAME = re.compile(r"\.lock(-[0-9]+-of-[0-9]+)?")


def run_named_by(latest: Path) -> str | None:
    """Return the name of the run that the link or text file ``latest`` points to; None if it is
    neither, or not tofpod's."""
    try:
        name = os.readlink(latest) if latest.is_symlink() else latest.read_text(encoding="utf-8")
    except (OSError, ValueError):
        return None
    return name if RUN_NAME.fullmatch(name) else None


def run_at(path: Path) -> Path:
    """Return a path, with a text file ``latest`` replaced by the folder that it names."""
    if path.name == LATEST and path.is_file():
        return path.with_name(run_named_by(path) or LATEST)
    return path
