"""Pictures with the truth from simulated boards, on which a network is trained."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from detectors.methods.learned import LearnedDetector, seen_by_network
from detectors.pixels.masks import grown
from harness.programs.train.gradients import Example
from harness.runs.plan import SweepPlan
from harness.trials.board import LabelledCloud, load_board
from harness.trials.judge import detector_of
from harness.trials.trial import Trial, captured, sharing_averages
from harness.vocabulary.errors import UserError

HALO_PX = 3
"""Width of the ring around damage that does not count: a camera's window and lens blur reach into
it, and a finding may."""
DAMAGE_PIXELS = 10.0
"""Number of pixels as which each damage counts, whatever its size: large damage is found anyway."""


class TrainingBoard(NamedTuple):
    """A damaged board in one draw of the noise."""

    number: int
    """The board's number."""
    trial: Trial
    """Draws its frames."""


class LabelledPicture(NamedTuple):
    """A whitened picture of one cloud, with the truth."""

    board: int
    """Number of the board."""
    whitened: np.ndarray
    """(r, c) float32: whitened residuals."""
    is_known: np.ndarray
    """(r, c) bool."""
    damage: np.ndarray
    """(r, c) bool: on damage."""
    weights: np.ndarray
    """(r, c) float32: how much each pixel counts; 0 where unknown and next to damage."""


def boards_of(plan: SweepPlan) -> list[TrainingBoard]:
    """Return all draws of all damaged boards of a plan."""
    boards = []
    for group in plan.groups:
        for batch in group.then:
            if batch.role == "damaged":
                for _, trial in group.trials(batch, None):
                    boards.append(TrainingBoard(batch.board or 0, trial))
    return boards


def pictures_of_board(board: TrainingBoard) -> list[LabelledPicture]:
    """Return the pictures of a board, one for each different cloud. Raises UserError if the
    detector has no network."""
    trial = board.trial
    boards = [load_board(view) for view in trial.views]
    pictures = []
    for points in sharing_averages(trial.points):
        clouds = captured(trial, boards, points)
        for point in points:
            detector = detector_of(point.criteria.detector, point.criteria.settings_json)
            if not isinstance(detector, LearnedDetector):
                problem = f"the detector {point.criteria.detector!r} has no network to train"
                raise UserError(problem, legal="learned, or a plug-in that derives from it")
            pictures.append(labelled_picture(board.number, clouds.labelled(point), detector))
    return pictures


def labelled_picture(
    number: int, labelled: LabelledCloud, detector: LearnedDetector
) -> LabelledPicture:
    """Return the picture of a cloud with the truth."""
    picture = detector.picture(labelled.cloud)
    whitened = detector.whitened(*picture.residuals)
    shape = whitened.is_known.shape
    damage = np.zeros(shape, bool)
    weights = np.ones(shape, np.float32)
    for flaw in labelled.truth:
        cells = np.unique(picture.cell.ravel()[labelled.outlines[flaw.id]])
        cells = cells[cells >= 0]
        damage.ravel()[cells] = True
        weights.ravel()[cells] = DAMAGE_PIXELS / max(len(cells), 1)
    weights[grown(damage, HALO_PX) & ~damage] = 0.0
    weights[~whitened.is_known] = 0.0
    return LabelledPicture(number, whitened.values, whitened.is_known, damage, weights)


def prior_of(pictures: Sequence[LabelledPicture]) -> float:
    """Return the logarithm of the odds of damage among the weighted pixels, each picture counted
    with both signs. Raises UserError if no damage is in sight."""
    on_damage = sum(float(picture.weights[picture.damage].sum()) for picture in pictures)
    total = sum(float(picture.weights.sum()) for picture in pictures)
    if not on_damage > 0:
        problem = "no damage lies in the parts of the boards that the detector judges"
        raise UserError(problem, fix="check its crop against the boards' poses")
    return float(np.log(on_damage / (2.0 * total - on_damage)))


def example_of(picture: LabelledPicture, sign: float) -> Example:
    """Return a picture as a network is to see it, its residuals times a sign: damage behind the
    surface is none to a network that looks for it in front."""
    pictures = seen_by_network(picture.whitened, picture.is_known, sign)
    damage = picture.damage * np.float32(sign > 0)
    return Example(pictures, damage, picture.weights)
