"""``tofpod implant``: states your camera's detection limit on your part, by virtual damage in
captures."""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from harness.inspection import arguments as cli
from harness.vocabulary.errors import UserError
from harness.vocabulary.geometry import MM
from harness.vocabulary.lengths import LEGAL, in_unit
from harness.vocabulary.program import length, program, span
from harness.vocabulary.words import damage_kind

if TYPE_CHECKING:
    from detectors.interface import Detector
    from harness.evaluation.study.record import SetUpRecord
    from harness.programs.implant.scans import Implanted, Judging, Scan
    from harness.records.trials import ResultTables
    from harness.vocabulary.geometry import Cloud
    from scenes.target.drawn import DrawnTargetConfig

DAMAGES = ("through", "blind", "dent", "pressed_dent", "pressed_bump", "protrusion", "slot")
# Most damages of a placement
MOST_AT_ONCE = 8
# Least room between damages
ROOM_MM = 10.0
# Largest share of the scan within half of --apart from a placement's damages
FILLED = 0.25
COMPARED = (
    "virtual damage may be harder to find than real damage: on the only drilled plate where "
    "both were compared, 7 of 23"
    " virtual holes and 50 of 56 real holes of the same apparent width were found; check "
    "the limit with a gauge board"
)


def _options(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add(
        "paths",
        nargs="+",
        type=Path,
        metavar="PATH",
        help="captures, in any format that tofpod detect reads",
    )
    add(
        "--camera",
        required=True,
        metavar="NAME|FILE.yaml",
        help="the captures' camera, or the most similar one",
    )
    _add_damage(add)
    _add_study(add)
    _add_judging(add)
    cli.add_reading(add)
    add(
        "--out",
        type=Path,
        default=Path("results/implant"),
        metavar="DIR",
        help="default: results/implant",
    )


def _add_damage(add: Callable[..., Any]) -> None:
    """Add the options of the damage, and of the part that it is in."""
    add(
        "--damage",
        required=True,
        metavar="KIND",
        help=f"hole, {', '.join(DAMAGES)}",
    )
    add(
        "--diameters",
        required=True,
        type=span("mm"),
        metavar="FROM:TO",
        help="diameters (bare numbers: mm); for slots their widths",
    )
    add(
        "--depths",
        type=span("mm"),
        metavar="FROM:TO",
        help="depths (bare: mm); of bumps and protrusions the heights",
    )
    add("--lengths", type=span("mm"), metavar="FROM:TO", help="lengths of slots (bare: mm)")
    add(
        "--thickness",
        type=length("mm"),
        default=12.7,
        metavar="LENGTH",
        help="thickness of the part (bare: mm; default: 12.7)",
    )
    behind = "distance to the surface behind a through-hole (bare: mm), or none (default: 20)"
    add("--backing", default="20", metavar="LENGTH|none", help=behind)
    add(
        "--albedo",
        type=float,
        metavar="A",
        default=0.6,
        help="albedo of part and backing at this wavelength (default: 0.6)",
    )


def _add_study(add: Callable[..., Any]) -> None:
    """Add the options of what is planned: frames, places and sizes."""
    add(
        "--frames",
        type=int,
        nargs="+",
        metavar="N",
        help="numbers of frames to average (default: 1 and all)",
    )
    add(
        "--targets",
        type=int,
        default=60,
        metavar="N",
        help="number of damages (default: 60, as MIL-HDBK-1823A asks)",
    )
    add(
        "--hit-radius",
        type=length("mm"),
        default=15.0,
        metavar="LENGTH",
        help="largest distance of a hit (bare: mm; default: 15)",
    )
    add(
        "--apart",
        type=length("mm"),
        metavar="LENGTH",
        help="least distance of damages (bare: mm; default: 10 more than 2 hit radii and than the "
        "largest damage)",
    )
    add("--seed", type=int, default=1, help="seed of places, sizes and noise (default: 1)")


def _add_judging(add: Callable[..., Any]) -> None:
    """Add the options of the detector and its threshold."""
    calls = (
        "expected number, which sets the threshold as in tofpod detect (default: "
        f"{cli.DEFAULT_FALSE_CALLS:g})"
    )
    add("--false-calls", type=float, metavar="N", help=calls)
    add(
        "--threshold",
        type=float,
        metavar="K",
        help="threshold in units of score, instead of --false-calls",
    )
    add(
        "--detector",
        metavar="NAME",
        default=cli.CANDIDATES[0],
        help=f"detector's name (default: {cli.CANDIDATES[0]})",
    )
    add(
        "--set",
        action="append",
        default=[],
        metavar="KEY=VALUE",
        help="a setting of the detector: surface.degree=5",
    )
    add("--crop", default="auto", metavar="KIND", help=f"the target: {cli.LEGAL_CROP}")


@program(
    _options,
    "Put virtual damage at random places of recorded frames of an undamaged part, as the "
    "camera would "
    "have measured it, and state which size is found: a50, a90, a90/95 and false calls per "
    "square metre. Each PATH "
    "is one static capture. The frames keep their own noise, fixed pattern and surface; "
    "only the damage is "
    "simulated.",
    "tofpod implant captures/wall --camera azure_kinect_nfov --damage hole --diameters 2:10",
    "tofpod implant captures/wall --camera azure_kinect_nfov --damage dent --diameters 8:30 "
    "--depths 1:4",
)
def main(options: argparse.Namespace, command: str) -> int:
    """Run the program. Returns 0 (also if no limit is demonstrated), 2 for a user's mistake, 130
    after Ctrl-C."""
    from harness.inspection.arguments import opened_as
    from harness.inspection.judging import refuse_thresholds
    from harness.programs.implant.scans import Scan, judge_scans
    from scenes.render.scene import load_mitsuba

    load_mitsuba()  # must precede Open3D, after which LLVM cannot be loaded
    # options of tofpod detect that this program lacks
    options.quiet_capture = None
    options.target = None
    options.damage = damage_kind("--damage", options.damage, DAMAGES)
    refuse_thresholds(options)
    _refuse_numbers(options)
    detector, settings = cli.detector_of(options, options.crop, options.set)
    judging = _judging(options, detector, settings)
    cli.refuse_repeats(options.paths)
    reading = cli.reading_of(options)
    recordings = [
        opened_as(options.camera, [path], options.intrinsics, **reading) for path in options.paths
    ]
    scans = [Scan(recording, judging) for recording in recordings]
    family = _family(options, scans)
    implanted = _implanted(options, scans, family)
    longest = max(len(scan.frames) for scan in scans)
    frames = sorted(set(options.frames or (1, longest)))
    tables, set_ups, doubts = judge_scans(scans, implanted, family, options.camera, judging, frames)
    warnings = [COMPARED]
    for recording in recordings:
        warnings.extend(recording.warnings)
    warnings.extend(doubts)

    area_m2 = sum(scan.area_m2 for scan in scans)
    plural = "s" * (len(scans) > 1)
    scanned = f"{len(scans)} recording{plural} of {longest} frames, {area_m2:.3g} m² judged"
    peaks_mm = [implant.depth_mm for placement in implanted for implant in placement.implants]
    notes = dict.fromkeys(note for recording in recordings for note in recording.notes)
    facts = {
        "implanted": [
            *_shares(options, scanned, peaks_mm),
            *(f"Note: {note}." for note in notes),
        ],
        "recordings": [path.as_posix() for path in options.paths],
        "camera": options.camera,
        "targets": options.targets,
        "frames": frames,
        "detector": {"name": options.detector, "settings": settings},
        "family": family.to_data(),
    }
    _write(options, command, tables, set_ups, facts, warnings, f"Virtual damage in {scanned}")
    return 0


def _refuse_numbers(options: argparse.Namespace) -> None:
    """Raise UserError for a number that is not above 0."""
    numbers = [("targets", options.targets)]
    for frame_count in options.frames or ():
        numbers.append(("frames", frame_count))
    for name, number in numbers:
        if not 0 < number < math.inf:
            raise UserError(f"--{name} {number:g}", legal="above 0")


def _judging(options: argparse.Namespace, detector: Detector, settings: dict[str, Any]) -> Judging:
    """Return the rule by which clouds are judged."""
    from harness.inspection.judging import analysed, threshold_of
    from harness.programs.implant.scans import Judging
    from harness.vocabulary.seeds import canonical_json

    def own_threshold(cloud: Cloud) -> tuple[float, tuple[str, ...]]:
        """Return the threshold of an undamaged cloud, and warnings."""
        threshold, _, evidence = threshold_of(
            options, detector, cloud, analysed(detector, cloud), lambda: (0.0, "")
        )
        return threshold, evidence.warnings

    return Judging(
        detector=options.detector,
        settings_json=canonical_json(settings),
        radius_m=options.hit_radius * MM,
        threshold=options.threshold,
        threshold_of=own_threshold,
    )


def _implanted(
    options: argparse.Namespace, scans: list[Scan], family: DrawnTargetConfig
) -> list[Implanted]:
    """Render all placements of damage, with a line of progress for each."""
    from harness.programs.implant.scans import placements

    cache = options.out / ".cache" / "renders"
    implanted = []
    rendered = 0
    for placement in placements(
        scans, family, options.camera, options.targets, options.seed, cache
    ):
        implanted.append(placement)
        rendered += len(placement.implants)
        print(f"damages rendered: {rendered}, wanted: {options.targets}", file=sys.stderr)
    return implanted


def _write(
    options: argparse.Namespace,
    command: str,
    tables: ResultTables,
    set_ups: tuple[SetUpRecord, ...],
    facts: dict[str, Any],
    warnings: list[str],
    title: str,
) -> None:
    """Write the study's record, its tables and its page, and show it in the terminal."""
    from harness.evaluation.study.record import StudyRecord, record_text
    from harness.evaluation.study.result import evaluate_study
    from harness.records.outputs import PROVENANCE, REPORT, STUDY
    from harness.report.study_page import study_html, study_parts
    from harness.runs.tables import write_tables
    from harness.tables.study import study_tables
    from harness.vocabulary.declaration.yaml_source import to_yaml
    from harness.vocabulary.files import write_json, write_text
    from harness.vocabulary.provenance import RESULTS_VERSION, record
    from harness.vocabulary.seeds import digest
    from harness.vocabulary.text import show

    origin = {**record(command), "warnings": warnings, "seed": options.seed, "failures": []}
    recorded_origin = {
        key: origin[key] for key in ("commit", "dirty", "versions", "seed", "command")
    }
    study = StudyRecord(
        name="implant",
        digest=digest(facts),
        hit_radius_mm=options.hit_radius,
        false_calls_per_m2=None,
        provenance={**recorded_origin, "thresholds": _thresholds(options)},
        set_ups=set_ups,
    )
    provenance = {
        **origin,
        "results_version": RESULTS_VERSION,
        "experiment": "implant",
        "digest": study.digest,
    }
    result = evaluate_study(study, tables, facts)
    frames = {table: table.frame(rows) for table, rows in study_tables(result).items()}
    page = options.out / REPORT.name
    write_text(options.out / STUDY.name, record_text(study))
    write_tables(options.out, frames, provenance)
    write_json(options.out / PROVENANCE.name, provenance)
    write_text(page, study_html(result, (), provenance, to_yaml(facts), title))
    show([*(f"warning: {text}" for text in warnings), *study_parts(result)])
    print(f"report: {page}")


def _thresholds(options: argparse.Namespace) -> str:
    """State how the thresholds were set."""
    if options.threshold:
        return f"Given as {options.threshold:g}."
    expected = options.false_calls or cli.DEFAULT_FALSE_CALLS
    return (
        "Set by the undamaged frames, as in tofpod detect, by noise towards the camera, for "
        f"{expected:g} false calls a capture: the median over groups of frames."
    )


def _family(options: argparse.Namespace, scans: list[Scan]) -> DrawnTargetConfig:
    """Return the damage as a family of boards as large as the largest scan. Raises UserError for
    illegal options."""
    from harness.vocabulary.declaration.diagnose import settings_of
    from scenes.sensor.camera import camera_of
    from scenes.sensor.common.config import CameraConfig
    from scenes.target.drawn import DrawnTargetConfig

    width_mm = max(float(scan.size_m[0]) for scan in scans) / MM
    height_mm = max(float(scan.size_m[1]) for scan in scans) / MM
    length_mm = options.lengths[1] if options.lengths else 0.0
    widest_mm = math.hypot(options.diameters[1], length_mm)
    apart_mm = options.apart or max(2 * options.hit_radius, widest_mm) + ROOM_MM
    room = FILLED * min(scan.area_m2 for scan in scans) / (math.pi / 4 * (apart_mm * MM) ** 2)
    damage = {"kind": options.damage, "per_board": max(1, min(MOST_AT_ONCE, int(room)))}
    size_name = "width_mm" if options.damage == "slot" else "diameter_mm"
    damage[size_name] = list(options.diameters)
    if options.depths:
        damage["depth_mm"] = list(options.depths)
    if options.lengths:
        damage["length_mm"] = list(options.lengths)
    wavelength_nm = camera_of(CameraConfig(name=options.camera)).optics.wavelength_nm
    albedos = {"wavelength_nm": wavelength_nm, "board": options.albedo, "backing": options.albedo}
    backing_mm = None if options.backing == "none" else in_unit(options.backing, "mm")
    if backing_mm is None and options.backing != "none":
        raise UserError(f"--backing {options.backing}: is not a length", legal=f"{LEGAL}, or none")
    data = {
        "seed": options.seed,
        "damage": damage,
        "board": {"width_mm": width_mm, "height_mm": height_mm, "thickness_mm": options.thickness},
        "apart_mm": apart_mm,
        "edge_mm": 1.0,
        "material": {"albedo_850": options.albedo, "grain_contrast": 0.0},
        "backing": backing_mm and {"distance_mm": backing_mm, "albedo_850": options.albedo},
        "room": None,
        "other_wavelengths": [albedos],
    }
    return settings_of(
        DrawnTargetConfig, data, "the virtual damage (--damage, --diameters, --depths, --lengths)"
    )


def _shares(options: argparse.Namespace, recordings: str, peaks_mm: list[float]) -> list[str]:
    """Return sentences on what is measured and simulated, and on the limit's validity;
    ``peaks_mm``: visible depths."""
    low, middle, high = np.quantile(peaks_mm, (0.1, 0.5, 0.9))
    return [
        (
            f"Measured: {recordings}, with their surface, noise, fixed pattern, texture and "
            "missing returns."
        ),
        f"Simulated: the damage, by the model of {options.camera}, in a flat board as large as "
        f"the part on the tangent plane at its place, with an albedo of {options.albedo:g}; noise "
        "is added where the damage weakens the light, but never removed.",
        f"Virtual damage shows a median depth of {middle:.2g} mm ({low:.2g} to {high:.2g} "
        "mm for eight in ten). If "
        "real damage of such sizes shows more or less depth in recordings of this camera, "
        "the limit is wrong "
        "accordingly: check it with a gauge board.",
        "Here, a board is a placement of damage in a group of recorded frames. Placements "
        "share the recording's "
        "surface and fixed pattern, and also its noise if it has few frames: intervals are "
        "over places and sizes in "
        "this recording, not over other parts, units or days.",
        "No damage was placed within the hit radius of a finding in the average of all "
        "undamaged frames. The undamaged "
        "recording is the hole-free board; a warning is given if the same frames set the "
        "threshold.",
    ]


if __name__ == "__main__":
    raise SystemExit(main())
