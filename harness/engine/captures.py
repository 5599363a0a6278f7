"""An experiment whose frames are a real capture: the same averages and detectors, without a truth to judge by."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import pandas as pd

from detectors import load_detector
from detectors.average import prefix_averages
from harness.experiment.load import resolved_yaml
from harness.experiment.points import Experiment, Point, recording_of
from harness.experiment.schema import CaptureSource
from harness.inspection.judging import judged as judged_cloud
from harness.inspection.told import choice_by, choice_facts, pictures, print_warnings
from harness.listing.latest import point_to
from harness.report.findings import Judged, write_findings
from harness.tables.outputs import CAPTURES, EXPERIMENT
from harness.vocabulary.capture import Cloud
from harness.vocabulary.files import write_text
from harness.vocabulary.provenance import record
from harness.vocabulary.units import MM
from harness.vocabulary.versions import RESULTS_VERSION

if TYPE_CHECKING:
    from detectors.target import Choice


def judge_captures(experiment: Experiment, out: Path, command: str, *, dry_run: bool) -> int:
    """Judge every point's capture once and write its findings to ``<folder>/<number>/``, and a table of all points.

    A capture has no repeats and no truth, so rates, sizes against the truth and claims are not given. Returns 0.
    """
    folder = experiment.folder(out)
    if dry_run:
        print(f"{experiment.config.name}: valid; {len(experiment.points)} points of a real capture; results: {folder}")
        return 0
    write_text(folder / EXPERIMENT.name, resolved_yaml(experiment))
    rows = []
    for number, point in enumerate(experiment.points):
        judged, threshold, choice = _judged(point)
        name = f"point-{number:03d}"
        about = {"target": choice_facts(choice), **_about(point, judged.cloud, threshold, command)}
        write_findings(folder / name, judged, about, point.label or name, beside=pictures(choice))
        mm = threshold * judged.evidence.scale_m / MM
        rows.append(
            {
                "point": name,
                "variant": point.variant,
                "what": point.label,
                "frames_used": judged.cloud.n_frames,
                "frames_left_out": len(judged.cloud.left_out),
                "threshold_k": threshold,
                "threshold_mm": round(mm, 4),
                "findings": len(judged.findings),
            }
        )
        print_warnings(
            f"{name}: {warning}" for warning in (*(choice.warnings if choice else ()), *judged.evidence.warnings)
        )
        print(f"{name} {point.label}: {len(judged.findings)} findings beyond {mm:.2f} mm")
        for left in judged.cloud.left_out:
            print(f"  left out: {left.name}: {left.why}")
    table = pd.DataFrame(rows).assign(results_version=RESULTS_VERSION)
    write_text(folder / CAPTURES.name, table.to_csv(index=False))
    point_to(folder)
    print(f"findings: {folder}")
    return 0


def _judged(point: Point) -> tuple[Judged, float, Choice | None]:
    config = point.config
    assert isinstance(config.source, CaptureSource)
    frames = config.capture.frames
    cloud = prefix_averages(recording_of(config.source), [frames], config.capture.average)[frames]
    detector = load_detector(config.detector.name, dict(config.detector.settings))
    choice = choice_by(getattr(detector, "settings", None), cloud)
    evidence = detector.analyse(cloud)
    threshold = config.threshold.k
    assert threshold is not None  # a capture cannot be calibrated on; the experiment's checks say so
    return judged_cloud(detector, cloud, evidence, threshold), threshold, choice


def _about(point: Point, cloud: Cloud, threshold: float, command: str) -> dict[str, object]:
    """Facts that stand beside the findings in their JSON."""
    return {
        "capture": {
            "frames_used": cloud.n_frames,
            "frames_left_out": [{"name": left.name, "why": left.why} for left in cloud.left_out],
        },
        "threshold": {"k": threshold, "from": "given"},
        "settings": point.config.to_data(),
        "provenance": record(command),
    }
