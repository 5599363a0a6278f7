"""Prints an inspection, and writes its files and its page."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from detectors.crop import described_text
from detectors.surfaces.pieces import part_text
from harness.inspection import output
from harness.inspection.limit import Limit
from harness.inspection.reference_page import changes_section, decision_section
from harness.inspection.run import Inspection, warnings_of
from harness.inspection.sheets import Sheets
from harness.inspection.verdict import CLASSES, FLAGS, calls_text
from harness.records import outputs
from harness.report.blocks import joined, paragraph, plain
from harness.report.findings import write_findings
from harness.vocabulary.files import plain_json
from harness.vocabulary.geometry import MM
from harness.vocabulary.provenance import made_by, record
from harness.vocabulary.text import Grid, many

if TYPE_CHECKING:
    from markupsafe import Markup

    from detectors.views.mapping.merge import Mapped
    from harness.records.examples import Scene3d

FileWriter = Callable[[Path], object]


def print_inspection(run: Inspection, further_warnings: Sequence[str] = ()) -> None:
    """Print warnings (``further_warnings`` last), the verdict, the capture, the surface, the
    threshold, the classes and the strongest findings."""
    output.print_warnings((*warnings_of(run), *further_warnings))
    if run.decision is not None:
        print(run.decision.sentence)
    print(run.verdict.sentence)
    if run.mapped is None:
        _print_capture(run)
    else:
        _print_map(run, run.mapped)
    notes = run.result.evidence.notes
    if "choice" in notes:
        print(f"detector: {notes['choice']['text']}")
    print(f"surface: {_surface_text(run)}")
    if run.result.missing is not None:
        print(run.result.missing.blind_text)
    print(f"threshold: {_threshold_text(run)}")
    if run.changes is not None:
        print(f"change: {run.changes.sentence}")
    if run.limit is not None:
        print(f"limit: {run.limit.text}")
    findings = run.result.findings
    if findings:
        output.print_classes(run.verdict.counts)
    grid = "px" if run.cell_m is None else "cell"
    output.print_findings(findings, grid, is_written=run.arguments.out is not None)


def _surface_text(run: Inspection) -> str:
    evidence = run.result.evidence
    unit = evidence.unit or f"{output.mm(evidence.scale_m)} at the median point"
    return f"{evidence.notes.get('surface', '')}; one unit of score is {unit}"


def _threshold_text(run: Inspection) -> str:
    limit = output.threshold_text(run.threshold, run.result.evidence)
    return f"{limit} ({run.threshold_origin})"


def _print_capture(run: Inspection) -> None:
    """Print the target, the frames, and how many points were judged."""
    recording = run.recordings[0]
    cloud = run.result.cloud
    crop = run.arguments.crop
    is_judged = np.isfinite(run.result.evidence.residual_m)
    pieces = run.result.evidence.notes.get("pieces")
    if pieces:
        print(part_text(pieces))
    output.print_choice(run.choices[0])
    output.print_capture(recording, cloud, recording.name, is_judged, crop)
    off_count = cloud.valid.sum() - is_judged.sum()
    if not cloud.organised and crop == "auto" and off_count > 0:
        text = f"{off_count} points lie off the target or on its rim: not judged"
        print(f"note: {text}; --crop none judges all of them")


def _print_map(run: Inspection, mapped: Mapped) -> None:
    """Print the registrations, and the size of the merged cloud."""
    output.print_registrations(run.registrations)
    merged = mapped.merged
    output.print_notes(merged.notes)
    cloud = run.result.cloud
    judged_count = np.isfinite(run.result.evidence.residual_m).sum()
    text = f"{len(merged.views_used)} views, {cloud.valid.sum()} points, {judged_count} judged"
    if run.cell_m is not None:
        height, width = cloud.valid.shape
        text += f", a map of {width} x {height} cells of {output.mm(run.cell_m)}"
    print(f"merged: {text}")


def write_inspection(
    run: Inspection,
    command: str,
    further_inputs: Sequence[Path] = (),
    further_files: Mapping[str, FileWriter] | None = None,
    further_warnings: Sequence[str] = (),
) -> None:
    """Write the findings, their facts and pictures into the folder of ``--out``, and print the
    paths. ``further_inputs``: other files that were read; ``further_files``: how to write other
    files, by name; ``further_warnings``: last on the page."""
    mapped = run.mapped
    limit = output.threshold_text(run.threshold, run.result.evidence)
    subject = f"{len(mapped.merged.views_used)} views" if mapped else run.recordings[0].name
    title = f"{subject}: {len(run.result.detections)} findings beyond {limit}"
    files: dict[str, FileWriter] = dict(further_files or {})
    facts = _facts(run, command, further_inputs)
    scene = output.scene_of(run.result, _scene_facts(run), mapped)
    if mapped is None:
        cloud_name = "cloud.ply"
        files |= output.pictures(run.choices[0])
    else:
        from harness.report.view3d import write_view3d

        cloud_name = "merged.ply"
        registrations = plain_json(run.registrations)
        files["registrations.json"] = lambda path: path.write_text(registrations, encoding="utf-8")
        files["view3d.html"] = lambda path: write_view3d(path, scene, title)
        for number, choice in enumerate(run.choices, start=1):
            files |= output.pictures(choice, f"targets-{number}.png")
    if run.changes is not None:
        changes_csv = run.changes.csv_text
        files[outputs.CHANGE.name] = lambda path: path.write_text(changes_csv, encoding="utf-8")
    if run.decision is not None:
        sheets = Sheets(run.decision, _decision_rows(run), facts["provenance"]["files"])
        files[outputs.DECISION.name] = lambda path: path.write_text(
            sheets.html(run.result), encoding="utf-8"
        )
        files[outputs.DECISION_DATA.name] = lambda path: path.write_text(
            plain_json(sheets.facts), encoding="utf-8"
        )
    page = partial(_page_html, run, subject, scene, facts["provenance"], further_warnings)
    files[outputs.INSPECTION_PAGE.name] = lambda path: path.write_text(page(), encoding="utf-8")
    written = write_findings(
        run.arguments.out, run.result, facts, title, cloud_name=cloud_name, beside=files
    )
    for path in written:
        print(f"wrote {path}")


def _scene_facts(run: Inspection) -> list[tuple[str, str]]:
    """Return what stands beside the cloud."""
    if run.mapped is not None:
        return output.map_facts(run.mapped, run.result)
    frames = str(run.result.cloud.n_frames)
    return [("frames averaged", frames), ("findings", str(len(run.result.findings)))]


def _facts(run: Inspection, command: str, further_inputs: Sequence[Path]) -> dict[str, Any]:
    """Return the facts in the JSON file besides the findings, with the origin and digests of all
    files read."""
    evidence = run.result.evidence
    arguments = run.arguments
    settings: dict[str, Any] = {"average": arguments.average, "unit": arguments.unit}
    if run.config is not None:
        settings["mapping"] = run.config.to_data()
    settings["detector"] = {
        "name": run.detector.name,
        "version": run.detector.version,
        "settings": run.settings,
    }
    recordings = [*run.recordings, *run.quiet_recordings]
    inputs = [path for recording in recordings for path in recording.files]
    if run.reference is not None:
        inputs += run.reference.files
    for path in (arguments.poses, arguments.flat_field, *further_inputs):
        if path:
            inputs.append(path)
    scale_mm = evidence.scale_m / MM
    threshold_mm = None if evidence.unit else run.threshold * scale_mm
    return {
        **_capture_facts(run),
        "threshold": {"k": run.threshold, "mm": threshold_mm, "from": run.threshold_origin},
        "verdict": run.verdict.facts,
        "limit": None if run.limit is None else run.limit.facts,
        "change": None if run.changes is None else run.changes.facts,
        "tolerance": None if run.decision is None else run.decision.facts,
        "warnings": evidence.warnings,
        "missing_returns": None if run.result.missing is None else run.result.missing.facts,
        "surface": {"one_unit_of_score_mm": scale_mm, **evidence.notes},
        "settings": settings,
        "provenance": {**record(command), "files": [_file_facts(path) for path in inputs]},
    }


def _capture_facts(run: Inspection) -> dict[str, Any]:
    """Return the facts about one capture, or about the views and their map."""
    if run.mapped is None:
        return {
            "target": output.choice_facts(run.choices[0]),
            "capture": output.capture_facts(run.recordings[0], run.result.cloud),
        }
    merged = run.mapped.merged
    captures = []
    for recording, view, choice in zip(run.recordings, run.mapped.views, run.choices, strict=True):
        captures.append(
            {
                "view": view.view.name,
                **output.capture_facts(recording, view.view.cloud),
                "target": output.choice_facts(choice),
            }
        )
    frame = (
        "of the merged cloud; registrations.json has its pose relative to the first view's camera"
    )
    cell_mm = None if run.cell_m is None else run.cell_m / MM
    return {
        "frame": frame,
        "captures": captures,
        "merged": {"views": merged.views_used, "cell_mm": cell_mm, "notes": merged.notes},
    }


def _file_facts(path: Path) -> dict[str, str]:
    with path.open("rb") as stream:
        digest = hashlib.file_digest(stream, "sha256").hexdigest()
    return {"path": path.as_posix(), "sha256": digest}


# ---------------------------------------------------------------- the page


def _page_html(
    run: Inspection,
    subject: str,
    scene: Scene3d,
    provenance: Mapping[str, Any],
    further_warnings: Sequence[str],
) -> str:
    """Return report.html as text."""
    from harness.report.inspection_page import PageText, inspection_html

    text = PageText(
        title=subject,
        sentence=_sentence(run),
        conditions=_conditions(run),
        warnings=(*warnings_of(run), *further_warnings),
        classes={name: CLASSES[name] for name in run.verdict.counts},
        flags=FLAGS,
        summary=tuple(_summary_rows(run)),
        judged=tuple(_judged_rows(run)),
        facts=tuple(_fact_rows(run)),
        sections=_sections(run),
        files=_files_text(run),
        provenance=provenance,
    )
    return inspection_html(run.result, scene, text)


def _sentence(run: Inspection) -> str:
    """Return the decision on the tolerances, if there are any, and the verdict."""
    if run.decision is None:
        return run.verdict.sentence
    return f"{run.decision.short}. {run.verdict.sentence}"


def _conditions(run: Inspection) -> str:
    """Return the frames, the distance and the detector in a few words."""
    cloud = run.result.cloud
    is_judged = np.isfinite(run.result.evidence.residual_m)
    parts = [many(cloud.n_frames, "frame")]
    if run.mapped is not None:
        views = many(len(run.mapped.merged.views_used), "view")
        parts = [f"{views} merged"]
    elif is_judged.any():
        distance_m = float(np.median(run.result.evidence.surface_z_m[is_judged]))
        parts.append(f"{distance_m:.2f} m away")
    parts.append(f"detector {run.detector.name} {run.detector.version}")
    if run.reference is not None:
        parts.append(f"compared with {run.reference.name}")
    return ", ".join(parts)


def _summary_rows(run: Inspection) -> list[tuple[str, str]]:
    """Return the figures of the verdict."""
    verdict = run.verdict
    rows = [(name, str(count)) for name, count in verdict.counts.items()]
    if run.changes is not None:
        rows += [(state, str(count)) for state, count in run.changes.counts.items()]
    extent = verdict.extent
    if np.isfinite(extent.judged_m2):
        rows.append(("judged", _area_text(extent.judged_m2)))
    if np.isfinite(extent.judged_share):
        rows.append(("share of the part", f"{100 * extent.judged_share:.0f} %"))
    if np.isfinite(extent.blind_m2):
        rows.append(("blind", f"{1e4 * extent.blind_m2:.3g} cm2"))
    false_sure = verdict.expected_false_sure
    rows.append(("false calls", verdict.calls.text))
    rows.append(("of them among the sure", calls_text(false_sure)))
    return rows


def _area_text(area_m2: float) -> str:
    """Return an area to four digits, in cm2 below a square metre."""
    return f"{1e4 * area_m2:.4g} cm2" if area_m2 < 1.0 else f"{area_m2:.4g} m2"


def _judged_rows(run: Inspection) -> list[tuple[str, str]]:
    """Return what was judged and what not."""
    extent = run.verdict.extent
    rows = []
    if np.isfinite(extent.judged_m2):
        share = ""
        if np.isfinite(extent.judged_share):
            share = f", {100 * extent.judged_share:.0f} % of the part's outline"
        rows.append(("judged", f"{_area_text(extent.judged_m2)}{share}"))
    missing = run.result.missing
    if missing is not None:
        blind = f"{1e4 * extent.blind_m2:.3g} cm2, {100 * missing.blind:.2g} % of the outline"
        rows.append(("blind: no light came back", blind))
    null = run.result.evidence.notes.get("own_null")
    if null is not None:
        rim = f"{null['rim_pixels']} pixels, not judged"
        rows.append(("rim mixed with what lies behind", rim))
        objects = f"{null['objects']} places"
        if np.isfinite(null["at_marks"]):
            objects += f", {calls_text(null['at_marks'])} false calls expected there"
        rows.append(("objects, printed marks and edges in the picture", objects))
    choice = run.choices[0]
    if run.mapped is None and choice is not None:
        for number, candidate in enumerate(choice.candidates, start=1):
            role = "taken" if number == choice.taken else f"not judged: --target {number}"
            rows.append((f"surface {number}", f"{described_text(candidate)} ({role})"))
    pieces = run.result.evidence.notes.get("pieces")
    if pieces is not None:
        rows.append(("pieces of the part", plain(pieces)))
    return rows


def _fact_rows(run: Inspection) -> list[tuple[str, str]]:
    """Return how the capture was read and judged."""
    rows = []
    for recording in run.recordings:
        rows.append((recording.name, "; ".join((recording.unit_text, *recording.notes))))
    for left_out in run.result.cloud.left_out:
        rows.append(("left out", f"{left_out.name}: {left_out.why}"))
    for registration in run.registrations.get("views", ()):
        rows.append((f"registration of {registration['view']}", _registration_text(registration)))
    rows.append(("surface", _surface_text(run)))
    rows.append(("threshold", _threshold_text(run)))
    choice = run.result.evidence.notes.get("choice")
    if choice is not None:
        rows.append(("choice of the detector", plain(choice)))
    return rows


def _sections(run: Inspection) -> dict[str, Markup]:
    """Return the sections that only some inspections have, by their headings."""
    sections = {}
    if run.decision is not None:
        sections["Within tolerance?"] = decision_section(run.decision)
    if run.changes is not None:
        sections["What changed"] = changes_section(run.changes)
    if run.limit is not None:
        sections["What would have been missed"] = _limit_section(run.limit)
    return sections


def _decision_rows(run: Inspection) -> list[tuple[str, str]]:
    """Return part, reference, conditions and version of a decision."""
    reference = "none: a smooth surface"
    if run.arguments.reference is not None:
        reference = str(run.arguments.reference)
    return [
        ("part", ", ".join(recording.name for recording in run.recordings)),
        ("reference", reference),
        ("conditions", _conditions(run)),
        ("version", made_by(record(""))),
    ]


def _limit_section(limit: Limit) -> Markup:
    """Return the section on sizes that would have been missed."""
    heads = ("width (mm)", "depth (mm)", "found", "95 % interval")
    rows = []
    for size in limit.sizes:
        share = f"{100 * size.low:.0f} to {100 * size.high:.0f} %"
        count = f"{size.hits} of {size.places}"
        rows.append((f"{size.diameter_mm:.2f}", f"{size.depth_mm:.2f}", count, share))
    sentence = f"{limit.text[0].upper()}{limit.text[1:]}."
    explanation = (
        "Flat discs were pressed into this capture's cloud at places without findings, blurred by"
        " the camera's filter, and searched by the same detector at the same threshold."
    )
    return joined([paragraph(sentence), paragraph(explanation), Grid.of(heads, rows).html()])


def _registration_text(registration: Mapping[str, Any]) -> str:
    residual = output.number(registration["residual_mm"], 3)
    in_plane = output.number(registration["predicted_in_plane_mm"], 3)
    across = output.number(registration["predicted_across_mm"], 3)
    return (
        f"{registration['method']}, residual {residual} mm, predicted error {in_plane} mm in plane"
        f" and {across} mm across"
    )


def _files_text(run: Inspection) -> dict[str, str]:
    """Return the files beside the page, with their content."""
    shown = [outputs.FINDINGS, outputs.FINDINGS_DATA, outputs.ANNOTATED]
    if run.result.missing is not None:
        shown.append(outputs.BLIND)
    if run.mapped is None and run.choices[0] is not None:
        shown.append(outputs.TARGETS)
    if run.changes is not None:
        shown.append(outputs.CHANGE)
    if run.decision is not None:
        shown += [outputs.DECISION, outputs.DECISION_DATA]
    files = {shown_file.name: shown_file.note for shown_file in shown}
    if run.mapped is None:
        files[outputs.CLOUD.name] = outputs.CLOUD.note
    else:
        files["merged.ply"] = "the merged cloud, with findings in magenta"
        files["registrations.json"] = "the pose of each view, with its covariance and checks"
        files["view3d.html"] = "the merged cloud that can be turned, as a page of its own"
    return files
