"""How often a wrong decision is made on simulated parts with a dent about as deep as allowed.

    python tests/validation/tolerance_risks.py [[FIRST] LAST]

Each part is a ribbed plate with one dent, 11 to 16 mm wide and 0.5 to 1.5 times as deep as the
tolerance of 1 mm, in another pose. It is compared with one good part, or, without ribs, with a
smooth surface."""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from detectors import load_detector
from detectors.surfaces.scans import PartScan, laid_under, scan_of
from harness.evaluation import intervals
from harness.inspection.judging import judged
from harness.inspection.tolerance import CONFORMS, FAILS, Missed, Tolerance, part_decision
from harness.vocabulary.geometry import Cloud, ExpectedSurface
from tests.support.made_parts import Dent, MadePart, cloud_of, pose

TOLERANCE = Tolerance("depth", 1.0)
PLACES_MM = ((0.0, 0.0), (15.0, -25.0), (-15.0, -30.0), (20.0, 5.0))
THRESHOLD = 6.0


@dataclass(frozen=True)
class Decided:
    """A decision on a part."""

    true_mm: float
    """True depth of its dent."""
    decision: str

    @property
    def is_wrong(self) -> bool:
        """Whether it accepts a part beyond the tolerance, or rejects one within it."""
        is_within = self.true_mm <= TOLERANCE.limit
        return self.decision == (FAILS if is_within else CONFORMS)


def decided_on(number: int, reference: PartScan | None) -> Decided:
    """Decide on part ``number``, against a good part or a smooth surface."""
    rng = np.random.default_rng([42, number])
    true_mm = float(rng.uniform(0.5, 1.5) * TOLERANCE.limit)
    x_mm, y_mm = PLACES_MM[number % len(PLACES_MM)]
    dent = Dent(x_mm, y_mm, float(rng.uniform(11, 16)), true_mm)
    part = MadePart((dent,), has_ribs=reference is not None)
    turn_deg = tuple(rng.uniform(-3, 3, 3))
    cloud, mask = cloud_of(part, pose(turn_deg, tuple(rng.uniform(-3, 3, 2))), seed=1000 + number)
    cloud = cut(cloud, mask)
    shape = "auto"
    if reference is not None:
        shape = "expected"
        cloud = cut(cloud, mask, laid_under(reference, cloud, mask))
    settings = {"crop": {"kind": "none"}, "surface": {"shape": shape}}
    detector = load_detector("local", settings)
    result = judged(detector, cloud, detector.analyse(cloud), THRESHOLD)
    decision = part_decision(result, (TOLERANCE,), Missed(""))
    decisions = [finding.decision for finding in decision.findings if finding.id == 1]
    return Decided(true_mm, decisions[0] if decisions else CONFORMS)


def cut(cloud: Cloud, mask: np.ndarray, expected: ExpectedSurface | None = None) -> Cloud:
    """Return the cloud without what lies beside the part."""
    points_m = np.where(mask[..., None], cloud.points_m, np.nan)
    return replace(cloud, points_m=points_m, expected=expected)


def reported(name: str, decisions: Sequence[Decided]) -> None:
    """Print the shares of wrong decisions, with their 95 % intervals, and all decisions."""
    print(f"compared with {name}: {len(decisions)} parts")
    for beyond, kind in ((True, "accepted beyond the tolerance"), (False, "rejected within it")):
        group = [
            decision for decision in decisions if (decision.true_mm > TOLERANCE.limit) == beyond
        ]
        wrong = sum(decision.is_wrong for decision in group)
        low, high = intervals.wilson(wrong, len(group))
        print(f"  {kind}: {wrong} of {len(group)} ({100 * low:.1f} to {100 * high:.1f} %)")
    print(f"  {dict(Counter(decision.decision for decision in decisions))}", flush=True)


def main(first: int, last: int) -> None:
    """Decide on parts ``first`` to ``last`` - 1 and report every hundred."""
    good, mask = cloud_of(MadePart(), pose(), seed=1)
    reference = scan_of(good, mask, "one good part")
    for name, scan in (("one good part", reference), ("a smooth surface", None)):
        decisions = []
        for number in range(first, last):
            decisions.append(decided_on(number, scan))
            if (number + 1) % 100 == 0 or number + 1 == last:
                reported(name, decisions)


if __name__ == "__main__":
    numbers = [int(word) for word in sys.argv[1:]] or [300]
    main(0 if len(numbers) == 1 else numbers[0], numbers[-1])
