"""The reference of an inspection: an earlier capture of the part, captures of good parts, or a
drawing."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from detectors.crop import AnyCrop, crop
from detectors.interface import Detector, Evidence
from detectors.surfaces.drawing import Drawing, DrawingFile, drawing_under, read_drawing
from detectors.surfaces.expected import KnownPose
from detectors.surfaces.scans import GoodParts, PartScan, good_parts, laid_under, scan_of
from detectors.views.marks.find import find_marks
from detectors.views.marks.mark import MarksConfig
from detectors.views.registration.by_marks import register_by_marks
from detectors.views.registration.pairing import SHARED_M
from detectors.views.view import PreparedView, View
from harness.vocabulary.errors import UserError
from harness.vocabulary.geometry import Cloud
from harness.vocabulary.text import many

if TYPE_CHECKING:
    from detectors.recordings import Recording

MOST_PARTS = 50
"""Most captures of good parts."""
MOST_LEFT_OUT = 10
"""Most parts that are left out in turn, of which each costs an analysis by each detector."""
WHOLE_FILES = (".mkv", ".bag", ".r3d")
"""Files that each are a capture when they lie together in a folder; others there are the frames of
one capture."""
LEAST_SCORE = 3.0
"""Findings of left-out parts with lower scores are not counted: no threshold is so low."""

Opened = Callable[[Path], "tuple[Recording, Cloud]"]
"""Opens a capture and averages it."""


def captures_in(path: Path) -> tuple[Path, ...]:
    """Return the captures of good parts in a folder that holds nothing but folders, or several
    files that are a capture each; none if the path is one capture."""
    if not path.is_dir():
        return ()
    try:
        entries = sorted(entry for entry in path.iterdir() if not entry.name.startswith("."))
    except OSError as error:
        raise UserError(f"{path}: cannot be read ({error.strerror})") from error
    if entries and all(entry.is_dir() for entry in entries):
        # the folders of one capture: depth/ beside color/
        return () if (path / "depth").is_dir() else tuple(entries)
    are_captures = all(entry.suffix.lower() in WHOLE_FILES for entry in entries)
    return tuple(entries) if are_captures else ()


@dataclass(frozen=True, eq=False)
class SeenPart:
    """A part in a capture."""

    name: str
    cloud: Cloud
    """Its average."""
    mask: np.ndarray
    """(h, w) bool: the pixels of the part."""
    prepared: PreparedView
    """The same with its marks."""

    @property
    def scan(self) -> PartScan:
        """The part as a surface."""
        return scan_of(self.cloud, self.mask, self.name)


def seen(name: str, cloud: Cloud, config: AnyCrop, marks: MarksConfig) -> SeenPart:
    """Cut a part out of a cloud and find its marks. Raises UserError as the crop does."""
    mask = crop(cloud, config)
    prepared = PreparedView(View(name, cloud, None), mask, find_marks(cloud, mask, marks))
    return SeenPart(name, cloud, mask, prepared)


def pose_by_marks(reference: SeenPart, part: SeenPart) -> KnownPose | None:
    """Return the pose of a part's cloud on the reference's by marks; None without enough marks. Its
    covariance holds `SHARED_M` of each mark, too, which each capture adds by itself."""
    if reference.cloud.rgb is None or part.cloud.rgb is None:
        return None
    registration = register_by_marks(reference.prepared, part.prepared)
    if registration.failure:
        return None
    centres_m = np.array([mark.centre_m for mark in reference.prepared.marks.trusted])
    arms_m2 = ((centres_m - registration.centre_m) ** 2).sum(axis=1).mean()
    shared_m2 = 2.0 * SHARED_M**2 / registration.pairs
    shared = np.diag([shared_m2 / arms_m2] * 3 + [shared_m2] * 3)
    return KnownPose(
        registration.T_reference_view, registration.covariance + shared, registration.centre_m
    )


@dataclass(frozen=True, eq=False)
class DrawnReference:
    """The drawing that a part is compared with."""

    path: Path
    """As stated."""
    drawing: Drawing

    @property
    def name(self) -> str:
        """Return what it is, in words."""
        return f"the drawing {self.path.name}"

    @property
    def files(self) -> list[Path]:
        """Return the files that were read."""
        return [self.path]

    def under(self, part: SeenPart) -> Cloud:
        """Return the cloud of a part with what is expected of it. Raises UserError if the drawing
        is not of this part."""
        cloud = part.cloud
        points_m = cloud.points_m[part.mask]
        central = cloud.projection == "central"
        return replace(cloud, expected=drawing_under(self.drawing, points_m, central))


@dataclass(frozen=True, eq=False)
class CapturedReference:
    """The captures that a part is compared with."""

    path: Path
    """As stated."""
    recordings: Sequence[Recording]
    """The captures that were read."""
    parts: Sequence[SeenPart]
    """An earlier capture, or the good parts."""
    scan: PartScan
    """The surface that is expected."""
    stack: GoodParts | None
    """The good parts; None for an earlier capture."""

    @property
    def name(self) -> str:
        """Return what it is, in words."""
        return self.scan.name

    @property
    def files(self) -> list[Path]:
        """Return the files that were read."""
        return [path for recording in self.recordings for path in recording.files]

    @property
    def is_earlier(self) -> bool:
        """True if it is the same part at an earlier time."""
        return self.stack is None

    def under(self, part: SeenPart, left_out: int | None = None) -> Cloud:
        """Return the cloud of a part with what is expected of it. ``left_out``: the good part that
        does not count. Raises UserError if the reference does not show this part."""
        scan = self.scan
        if left_out is not None:
            assert self.stack is not None
            scan = self.stack.mean(f"{len(self.parts) - 1} other good parts", left_out)
        known_pose = pose_by_marks(self.parts[0], part)
        return replace(part.cloud, expected=laid_under(scan, part.cloud, part.mask, known_pose))


Reference = DrawnReference | CapturedReference


def drawn_reference(source: DrawingFile) -> DrawnReference:
    """Read the mesh of --reference. Raises UserError."""
    return DrawnReference(Path(source.file), read_drawing(source))


def captured_reference(
    path: Path, opened: Opened, config: AnyCrop, marks: MarksConfig
) -> CapturedReference:
    """Open and average the captures of --reference, and find the part in each by ``config``.
    Raises UserError."""
    captures = captures_in(path)
    if len(captures) > MOST_PARTS:
        raise UserError(
            f"{path}: {len(captures)} captures of good parts", legal=f"up to {MOST_PARTS}"
        )
    recordings = []
    parts = []
    for capture in captures or (path,):
        recording, cloud = opened(capture)
        recordings.append(recording)
        try:
            parts.append(seen(f"reference {capture.name}", cloud, config, marks))
        except UserError as mistake:
            message = f"reference {capture}: {mistake.message}"
            raise UserError(message, legal=mistake.legal, fix=mistake.fix) from mistake
    first = parts[0].scan
    if not captures:
        earlier = replace(first, name=f"the earlier capture {path.name}")
        return CapturedReference(path, recordings, parts, earlier, None)
    later_scans = [(part.scan, pose_by_marks(part, parts[0])) for part in parts[1:]]
    stack = good_parts(first, later_scans, parts[0].cloud.projection == "central")
    name = f"{many(len(parts), 'good part')} in {path.name}"
    return CapturedReference(path, recordings, parts, stack.mean(name), stack)


# ---------------------------------------------------------------- leaving one part out


@dataclass(frozen=True)
class CheckOnParts:
    """The findings on good parts that are each compared with the others."""

    factor: float
    """Multiple, at least 1, of a capture's own threshold at which good parts have as many findings
    as wanted."""
    parts: int
    """Number of parts that were left out in turn."""
    findings: int
    """Number of findings on them at their own thresholds."""

    @property
    def text(self) -> str:
        """Return the check in words."""
        count = f"{many(self.findings, 'finding')} on {self.parts} good parts, each left out once"
        if self.factor == 1.0:
            return f"not more than expected: {count}"
        return f"raised {self.factor:.2g} times: {count}"


def checked_on_parts(
    reference: CapturedReference,
    detector: Detector,
    judged: Callable[[Detector, Cloud], tuple[float, Evidence]],
    calls: float,
) -> CheckOnParts | None:
    """Compare each good part with the others. ``judged``: own threshold and evidence of a detector
    on a cloud; ``calls``: wanted number of findings on a good part. None for fewer than two good
    parts."""
    if reference.stack is None or len(reference.parts) < 2:
        return None
    ratios: list[float] = []
    parts = reference.parts[:MOST_LEFT_OUT]
    for number, part in enumerate(parts):
        cloud = reference.under(part, left_out=number)
        threshold, evidence = judged(detector, cloud)
        for finding in detector.find(cloud, evidence, LEAST_SCORE):
            ratios.append(finding.score / threshold)
    ratios.sort(reverse=True)
    allowed = int(calls * len(parts))
    factor = ratios[allowed] if len(ratios) > allowed else 1.0
    return CheckOnParts(
        factor=max(1.0, factor),
        parts=len(parts),
        findings=sum(ratio > 1.0 for ratio in ratios),
    )
