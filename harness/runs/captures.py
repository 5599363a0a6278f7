"""An experiment on a real capture: each point judges it once, by the steps of `tofpod detect`."""

from pathlib import Path

from detectors import load_detector
from detectors.filters.stream import averages_through
from harness.experiment.load import resolved_yaml
from harness.experiment.schema import CaptureSource, Experiment, recording_of
from harness.inspection.judging import judged
from harness.inspection.output import (
    capture_facts,
    choice_by,
    choice_facts,
    pictures,
    print_warnings,
)
from harness.records.outputs import EXPERIMENT, PROVENANCE
from harness.records.schema import write_table
from harness.records.trials import POINTS_OF_CAPTURES
from harness.report.findings import write_findings
from harness.runs.results_folder import point_to
from harness.vocabulary.files import write_json, write_text
from harness.vocabulary.geometry import MM
from harness.vocabulary.provenance import RESULTS_VERSION, record


def judge_captures(experiment: Experiment, out: Path, command: str) -> int:
    """Judge every point's capture, write its findings to ``<folder>/<number>/``, and a table of
    all. Returns 0."""
    folder = experiment.folder(out)
    write_text(folder / EXPERIMENT.name, resolved_yaml(experiment))
    rows = []
    for number, point in enumerate(experiment.points):
        config = point.config
        name = f"point-{number:03d}"
        k = point.config.threshold.k
        assert isinstance(config.source, CaptureSource)
        assert k is not None  # the checks of experiments refuse to calibrate on a capture
        recording = recording_of(config.source)
        capture = config.capture
        counts = [capture.frames]
        (cloud,) = averages_through(recording, counts, capture.average, capture.filter).values()
        detector = load_detector(config.detector.name, dict(config.detector.settings))
        choice = choice_by(getattr(detector, "settings", None), cloud)
        result = judged(detector, cloud, detector.analyse(cloud), k)
        facts = {
            "target": choice_facts(choice),
            "capture": capture_facts(recording, cloud),
            "threshold": {"k": k, "from": "given"},
            "settings": config.to_data(),
            "provenance": record(command),
        }
        write_findings(folder / name, result, facts, point.label or name, beside=pictures(choice))
        row = {
            "point": name,
            "variant": point.variant,
            "what": point.label,
            "frames_used": cloud.n_frames,
        }
        row |= {
            "frames_left_out": len(cloud.left_out),
            "findings": len(result.findings),
            "threshold_k": k,
        }
        rows.append(row | {"threshold_mm": round(k * result.evidence.scale_m / MM, 4)})
        warnings = (
            *recording.warnings,
            *(choice.warnings if choice else ()),
            *result.evidence.warnings,
        )
        print_warnings(f"{name}: {text}" for text in warnings)
        print(
            f"{name} {point.label}: {len(result.findings)} findings beyond "
            f"{rows[-1]['threshold_mm']:.2f} mm"
        )
        for left_out in cloud.left_out:
            print(f"  left out: {left_out.name}: {left_out.why}")
    write_json(folder / PROVENANCE.name, {"results_version": RESULTS_VERSION, **record(command)})
    write_table(folder, POINTS_OF_CAPTURES, POINTS_OF_CAPTURES.frame(rows))
    point_to(folder)
    print(f"findings: {folder}")
    return 0
