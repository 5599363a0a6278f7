"""The references of a board in a trial: an earlier capture of it, good parts, or its drawing.

References are recorded by the board's own unit of the camera, with as many frames, averaged and
cropped alike. No marks place the board: the surface does, and the outline."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from detectors.crop import AnyCrop, crop
from detectors.surfaces.drawing import Drawing, drawing_of, drawing_under
from detectors.surfaces.scans import GoodParts, PartScan, good_parts, laid_under, scan_of
from harness.experiment.schema import AnyReference, GoodPartsReference, MeshReference
from harness.trials.averages import Averaging, averages_of
from harness.trials.board import BoardRef, load_board
from harness.vocabulary.geometry import Cloud
from harness.vocabulary.text import many
from scenes.sensor.common.config import CameraConfig
from scenes.target.custom import BoardConfig, TargetConfig


@dataclass(frozen=True)
class ReferenceBoards:
    """The boards that references show, all without damage."""

    earlier: tuple[BoardRef, ...] = ()
    """The board itself in another pose; of a learning trial, each of its boards. Empty if no point
    compares with it."""
    good_parts: tuple[BoardRef, ...] = ()
    """Other boards of the family, as many as any point compares with."""

    def before(self, camera: CameraConfig) -> ReferenceBoards:
        """Return the same boards before another unit of the camera."""
        earlier = tuple(replace(board, camera=camera) for board in self.earlier)
        parts = tuple(replace(part, camera=camera) for part in self.good_parts)
        return ReferenceBoards(earlier, parts)


NO_REFERENCES = ReferenceBoards()


@dataclass(frozen=True)
class Recorded:
    """The way in which boards are recorded."""

    frames: int
    """Number of frames to average."""
    averaging: Averaging
    """The average of the frames."""
    crop: AnyCrop
    """How the board is cut out."""
    seed: int
    """Seed of the noise."""


def compared(
    cloud: Cloud,
    board: BoardConfig,
    reference: AnyReference,
    *,
    boards: ReferenceBoards,
    recorded: Recorded,
    labels: tuple[str | int, ...],
) -> Cloud:
    """Return the cloud of a board with what its reference says that it should show. ``labels``: of
    the trial's random stream. Raises UserError if the board cannot be placed on it."""
    mask = crop(cloud, recorded.crop)
    if isinstance(reference, MeshReference):
        central = cloud.projection == "central"
        surface = drawing_under(_drawing(board.as_drawn), cloud.points_m[mask], central)
        return replace(cloud, expected=surface)
    if isinstance(reference, GoodPartsReference):
        scan = _mean(boards.good_parts, recorded, reference.parts)
    else:
        (earlier,) = boards.earlier
        scan = _scan(earlier, recorded, ("earlier", *labels))
    return replace(cloud, expected=laid_under(scan, cloud, mask))


# a few boards take turns
@lru_cache(maxsize=8)
def _drawing(board: BoardConfig) -> Drawing:
    """Return a board's drawing, board frame."""
    # loads the library of meshes, which takes 0.1 s and few studies need
    from scenes.target.mesh import board_solid

    solid = board_solid(TargetConfig(board=board), ())
    return drawing_of("the drawing", np.asarray(solid.vertices)[np.asarray(solid.faces)])


def _scan(ref: BoardRef, recorded: Recorded, labels: Sequence[str | int]) -> PartScan:
    """Record a board as a surface."""
    capture = load_board(ref).unit.capture(recorded.frames, recorded.seed, *labels)
    averages = averages_of(capture, [recorded.frames], recorded.averaging)
    cloud = averages[recorded.frames]
    return scan_of(cloud, crop(cloud, recorded.crop), "the earlier capture")


# all trials of a unit share its good parts, of which each takes a second or two to be placed;
# trials of a few kinds of boards take turns
@lru_cache(maxsize=4)
def _stack(parts: tuple[BoardRef, ...], recorded: Recorded) -> GoodParts:
    """Record good parts, and lay them on the first."""
    scans = [_scan(part, recorded, ("good part", number)) for number, part in enumerate(parts)]
    first, *others = scans
    return good_parts(first, [(other, None) for other in others], central=True)


@lru_cache(maxsize=12)
def _mean(parts: tuple[BoardRef, ...], recorded: Recorded, count: int) -> PartScan:
    """Return the mean of the first ``count`` good parts."""
    stack = _stack(parts, recorded).first_parts(count)
    return stack.mean(many(count, "good part"))
