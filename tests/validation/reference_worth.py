"""What a reference buys: the smallest dent that is found, and false calls, on simulated parts.

    python tests/validation/reference_worth.py [PARTS]

A ribbed plate, made with ribs and a bend that vary by 0.2 mm (standard deviation), is compared with
nothing but a smooth surface, with its own earlier capture, with 1, 5 and 20 good parts, and with
its drawing. False calls are findings on undamaged parts. Flat discs, half as deep as wide, are
pressed into the captures of the same parts at places without findings; hits and misses of all
parts give one curve."""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import trimesh

from detectors import load_detector
from detectors.crop import NoCrop
from detectors.interface import Detector, Evidence
from detectors.surfaces.scans import good_parts, scan_of
from detectors.views.marks.mark import CodedMarks
from harness.inspection.judging import analysed, judged, threshold_of
from harness.inspection.limit import SizeCount, fitted, limit_of
from harness.inspection.references import Reference, SeenPart, checked_on_parts, seen
from harness.vocabulary.errors import UserError
from harness.vocabulary.geometry import MM, Cloud
from tests.support.made_parts import HALF_M, MadePart, cloud_of, pose

CALLS = 1.0
OPTIONS = argparse.Namespace(threshold=None, quiet_capture=None, false_calls=CALLS)
GOOD_PARTS = (1, 5, 20)
SPREAD_MM = 0.2


def made(number: int) -> MadePart:
    """A part of the series."""
    rng = np.random.default_rng([7, number])
    bend_mm, rib_mm = rng.normal(0.0, SPREAD_MM, 2)
    return MadePart(bend_mm=float(bend_mm), rib_mm=float(rib_mm))


def captured(part: MadePart, seed: int) -> SeenPart:
    """A part in a capture of its own, without what lies beside it."""
    rng = np.random.default_rng([8, seed])
    T = pose(tuple(rng.uniform(-2, 2, 3)), tuple(rng.uniform(-2, 2, 2)))
    cloud, mask = cloud_of(part, T, seed=seed)
    alone = replace(cloud, points_m=np.where(mask[..., None], cloud.points_m, np.nan))
    return seen(f"capture {seed}", alone, NoCrop(), CodedMarks())


def reference_of_parts(count: int) -> Reference:
    """A reference of so many good parts."""
    parts = [captured(made(1000 + number), 1000 + number) for number in range(count)]
    first, *others = [part.scan for part in parts]
    stack = good_parts(first, [(scan, None) for scan in others], central=True)
    return Reference(Path("good"), (), parts, stack.mean("the good parts"), stack)


def drawing(folder: Path) -> Path:
    """Write the part as drawn, as triangles of 0.5 mm."""
    x_m = np.linspace(-HALF_M[0], HALF_M[0], 301)
    y_m = np.linspace(-HALF_M[1], HALF_M[1], 221)
    places = np.stack(np.meshgrid(x_m, y_m), axis=-1)
    heights_m = MadePart().height_m(places[..., 0], places[..., 1])
    corners = np.concatenate([places, heights_m[..., None]], axis=-1) / MM
    index = np.arange(heights_m.size).reshape(heights_m.shape)
    first, right, below = index[:-1, :-1], index[:-1, 1:], index[1:, :-1]
    faces = [np.stack([first, right, below], axis=-1)]
    faces.append(np.stack([right, index[1:, 1:], below], axis=-1))
    path = folder / "drawing.stl"
    trimesh.Trimesh(
        corners.reshape(-1, 3), np.concatenate([face.reshape(-1, 3) for face in faces])
    ).export(path)
    return path


@dataclass
class Count:
    """Findings and hits over all parts."""

    calls: int = 0
    parts: int = 0
    sizes: tuple[SizeCount, ...] = ()


def own(detector: Detector, cloud: Cloud) -> tuple[float, Evidence]:
    """The threshold that a capture sets for itself, and the evidence to search."""
    evidence = analysed(detector, cloud)
    threshold, _, searched = threshold_of(
        OPTIONS, detector, cloud, evidence, lambda: (float("nan"), "")
    )
    return threshold, searched


def counted(
    parts: int, surface: dict[str, object], cloud_at: Callable[[int], Cloud], factor: float
) -> Count:
    """Findings on undamaged parts, and hits of discs."""
    detector = load_detector("local", {"crop": {"kind": "none"}, "surface": surface})
    count = Count()
    for number in range(parts):
        cloud = cloud_at(number)
        threshold, evidence = own(detector, cloud)
        threshold *= factor
        result = judged(detector, cloud, evidence, threshold)
        count.calls += len(result.findings)
        count.parts += 1
        try:
            count.sizes += limit_of(detector, result, threshold).sizes
        except UserError:
            continue
    return count


def main(parts: int) -> None:
    """Print a table."""
    now = [captured(made(number), number) for number in range(parts)]

    def plain(number: int) -> Cloud:
        return now[number].cloud

    def since(number: int) -> Cloud:
        then = captured(made(number), 500 + number)
        scan = scan_of(then.cloud, then.mask, "then")
        return Reference(Path("then"), (), [then], scan, None).under(now[number])

    print("reference | false calls per part | found nine times out of ten (bound)", flush=True)

    def row(name: str, count: Count) -> None:
        limit = fitted(count.sizes, None)
        calls = count.calls / count.parts
        size = f"{limit.a90_mm:.1f} mm ({limit.bound_mm:.1f})"
        print(f"{name} | {calls:.1f} | {size}", flush=True)

    row("a smooth surface", counted(parts, {"shape": "auto"}, plain, 1.0))
    row("its earlier capture", counted(parts, {"shape": "expected"}, since, 1.0))
    for number in GOOD_PARTS:
        reference = reference_of_parts(number)
        detector = load_detector(
            "local", {"crop": {"kind": "none"}, "surface": {"shape": "expected"}}
        )
        check = checked_on_parts(reference, detector, own, CALLS)
        factor = check.factor if check else 1.0
        count = counted(
            parts,
            {"shape": "expected"},
            lambda k, reference=reference: reference.under(now[k]),  # type: ignore[misc]
            factor,
        )
        row(f"{number} good parts, threshold times {factor:.2f}", count)
    with tempfile.TemporaryDirectory() as folder:
        mesh = {"shape": "mesh", "reference": {"file": str(drawing(Path(folder)))}}
        row("its drawing", counted(parts, mesh, plain, 1.0))


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 6)
