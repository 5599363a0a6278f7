"""A package of detectors that each have one fault, as plug-ins: what a gate must notice."""

from __future__ import annotations

from pathlib import Path

SOURCE = '''\
"""The thesis' detector with one fault each; settings and version are its own."""

import numpy as np
from dataclasses import replace

from detectors.methods.thesis import ThesisDetector


class Halved(ThesisDetector):
    """Half the sensitivity to what lies behind the surface; false calls before it keep the threshold where it was."""

    name = "halved"

    def analyse(self, cloud):
        evidence = super().analyse(cloud)
        return replace(evidence, score=np.where(evidence.residual_m > 0, 0.5, 1.0) * evidence.score)


class Shifted(ThesisDetector):
    """Takes another threshold than the one it is given."""

    name = "shifted"
    by = 2.0

    def find(self, cloud, evidence, threshold):
        return super().find(cloud, evidence, self.by * threshold)


class Lowered(Shifted):
    name = "lowered"
    by = 1 / 1.5


class Cropped(ThesisDetector):
    """Cuts a third of the board."""

    name = "cropped"

    def analyse(self, cloud):
        evidence = super().analyse(cloud)
        columns = np.flatnonzero(np.isfinite(evidence.score).any(axis=0))
        score = evidence.score.copy()
        score[:, columns[: len(columns) // 3]] = np.nan
        return replace(evidence, score=score)
'''
NAMES = {"halved": "Halved", "shifted": "Shifted", "lowered": "Lowered", "cropped": "Cropped"}


def write_mutants(folder: Path) -> Path:
    """The package as an installer leaves it in ``folder``, which is to be put on the search path."""
    info = folder / "faulty_detectors-1.0.dist-info"
    info.mkdir(parents=True)
    (folder / "faulty_detectors.py").write_text(SOURCE)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: faulty-detectors\nVersion: 1.0\n")
    entries = "".join(f"{name} = faulty_detectors:{kind}\n" for name, kind in NAMES.items())
    (info / "entry_points.txt").write_text(f"[tofpod.detectors]\n{entries}")
    return folder
