"""How often a wrong decision is made on simulated parts with a dent about as deep as allowed.

    python tests/validation/tolerance_risks.py [PARTS]

Each part is a ribbed plate with one dent, 11 to 16 mm wide and 0.5 to 1.5 times as deep as the
tolerance of 1 mm, in another pose. It is compared with one good part, or, without ribs, with a
smooth surface."""

from __future__ import annotations

import sys
from collections import Counter
from dataclasses import dataclass

import numpy as np

from detectors import load_detector
from detectors.surfaces.scans import PartScan, laid_under, scan_of
from harness.evaluation import intervals
from harness.inspection.judging import judged
from harness.inspection.tolerance import CONFORMS, FAILS, Tolerance, part_decision
from harness.vocabulary.geometry import Cloud
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
        is_within = self.true_mm <= TOLERANCE.limit_mm
        return self.decision == (FAILS if is_within else CONFORMS)


def decided_on(number: int, reference: PartScan | None) -> Decided:
    """Decide on part ``number``, against a good part or a smooth surface."""
    rng = np.random.default_rng([42, number])
    true_mm = float(rng.uniform(0.5, 1.5) * TOLERANCE.limit_mm)
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
    decision = part_decision(result, (TOLERANCE,), None, "")
    decisions = [finding.decision for finding in decision.findings if finding.id == 1]
    return Decided(true_mm, decisions[0] if decisions else CONFORMS)


def cut(cloud: Cloud, mask: np.ndarray, expected: object = None) -> Cloud:
    """Return the cloud without what lies beside the part."""
    from dataclasses import replace

    points_m = np.where(mask[..., None], cloud.points_m, np.nan)
    return replace(cloud, points_m=points_m, expected=expected)


def main(parts: int) -> None:
    """Print the shares of wrong and of open decisions."""
    good, mask = cloud_of(MadePart(), pose(), seed=1)
    reference = scan_of(good, mask, "one good part")
    for name, scan in (("a smooth surface", None), ("one good part", reference)):
        decisions = [decided_on(number, scan) for number in range(parts)]
        print(f"compared with {name}")
        for beyond, kind in ((True, "accepted beyond the tolerance"), (False, "rejected within")):
            group = [d for d in decisions if (d.true_mm > TOLERANCE.limit_mm) == beyond]
            wrong = sum(d.is_wrong for d in group)
            low, high = intervals.wilson(wrong, len(group))
            share = f"{100 * low:.1f} to {100 * high:.1f} %"
            print(f"  {kind}: {wrong} of {len(group)} ({share})")
        print(f"  {dict(Counter(d.decision for d in decisions))}")


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 300)
