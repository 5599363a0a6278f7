"""The parts of the atlas: the set-ups of a camera at one distance, which are one experiment.

All lengths of a part scale with the distance, so that every part sees boards of as many pixels, and
damage of one to some twenty pixels: what a camera resolves there."""

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from harness.programs.atlas.limits import Conditions, pixel_width_mm
from harness.vocabulary.geometry import MM

EXPERIMENT = "atlas"
"""The experiment of one part."""
NEAREST_M = 0.3
FARTHEST_M = 3.0
COARSEST_PX_MM = 8.0
"""Width of a pixel on the target beyond which nothing is computed: boards of as many pixels would
be wider than 1.2 m, and only damage of several centimetres be found."""
PARTS = 6
"""Distances of a camera."""
DARK = 0.1
BRIGHT = 0.9
FRAMES = (1, 50)
DEPTHS_MM: Mapping[str, tuple[float, float] | None] = {
    "through": None,
    "blind": (1.0, 10.0),
    "dent": (0.5, 4.0),
    "slot": (1.0, 10.0),
}
"""Ends of the depths of each kind of damage, which are drawn between them; None: through the
board. Shallower ones come beside deeper ones on each board."""
BACKING_MM = 20.0
"""Distance of the surface behind the boards, which is what is seen through a hole. It moves limits
of through-holes (`assumptions` says how far) and is no axis: where it alternated between 15 and 60
mm, signals at distances left out departed from the law by .64 for one camera, and by .07 at 20 mm
throughout. More depth behind a hole does not act as more depth of it. No other damage sees it."""
PER_BOARD = 6
BOARD_PX = (150.0, 110.0)
HOLE_PX = (1.0, 12.0)
SLOT_PX = (0.5, 8.0)
SLOT_LENGTH_PX = 14.0
DENT_PX = (3.0, 20.0)
APART_PX = 24.0
EDGE_PX = 7.0
RADIUS_PX = 10.0
FALSE_CALLS_PER_BOARD = 0.25
"""False calls on a board: a rate per view, as boards of as many pixels scale with the distance, and
6 boards can show it."""


@dataclass(frozen=True)
class Part:
    """The set-ups of a camera at one distance, which are one experiment."""

    camera: str
    """Name of the camera, or the path of its file."""
    distance_m: float
    """Distance of the boards."""
    albedo: float
    """Albedo of the boards."""
    backing_mm: float
    """Distance of the surface behind the boards."""
    pixel_mm: float
    """Width of a pixel on the boards."""
    frames: tuple[int, ...] = FRAMES
    """Numbers of averaged frames."""
    depths_mm: Mapping[str, tuple[float, float] | None] = field(default_factory=lambda: DEPTHS_MM)
    """Ends of the depths of each kind of damage."""

    @property
    def damages(self) -> list[dict[str, Any]]:
        """The kinds of damage, with sizes that scale with the distance."""
        damages = []
        for kind, depths_mm in self.depths_mm.items():
            deep = {} if depths_mm is None else {"depth_mm": list(depths_mm)}
            damage = {"kind": kind, "per_board": PER_BOARD, **self._sizes(kind), **deep}
            damages.append({**damage, "sizes": "log"})
        return damages

    def _sizes(self, kind: str) -> dict[str, list[float]]:
        """Return the ranges of size of a kind of damage."""
        if kind == "slot":
            length_mm = self._mm(SLOT_LENGTH_PX)
            width_mm = [self._mm(pixels) for pixels in SLOT_PX]
            return {"width_mm": width_mm, "length_mm": [length_mm, length_mm]}
        diameter_px = DENT_PX if kind == "dent" else HOLE_PX
        return {"diameter_mm": [self._mm(pixels) for pixels in diameter_px]}

    def _mm(self, pixels: float) -> float:
        """Return the length of so many pixels, with three digits."""
        return float(f"{pixels * self.pixel_mm:.3g}")

    @property
    def false_calls_per_m2(self) -> float:
        """The rate of false calls that gives `FALSE_CALLS_PER_BOARD`, with three digits."""
        area_m2 = self._mm(BOARD_PX[0]) * self._mm(BOARD_PX[1]) * MM**2
        return float(f"{FALSE_CALLS_PER_BOARD / area_m2:.3g}")

    @property
    def overrides(self) -> list[str]:
        """The settings of `tofpod sweep atlas --set` that make this part."""
        settings = {
            "source.camera.name": self.camera,
            "source.target.distance_m": self.distance_m,
            "source.target.board.width_mm": self._mm(BOARD_PX[0]),
            "source.target.board.height_mm": self._mm(BOARD_PX[1]),
            "source.target.backing.distance_mm": self.backing_mm,
            "source.target.apart_mm": self._mm(APART_PX),
            "source.target.edge_mm": self._mm(EDGE_PX),
            "threshold.calibrate.false_calls_per_m2": self.false_calls_per_m2,
            "source.target.material.albedo_850": self.albedo,
            "matching.radius_mm": self._mm(RADIUS_PX),
            "sweep": {
                "source.target.damage": self.damages,
                "capture.frames": list(self.frames),
            },
        }
        return [f"{path}={json.dumps(value)}" for path, value in settings.items()]


def exact_overrides(camera: str, focal_px: float, kind: str, conditions: Conditions) -> list[str]:
    """Return what `tofpod sweep atlas --set` needs to run a single set-up."""
    is_through = DEPTHS_MM.get(kind) is None
    part = Part(
        camera=camera,
        distance_m=conditions.distance_m,
        albedo=conditions.albedo,
        backing_mm=conditions.depth_mm if is_through else BACKING_MM,
        pixel_mm=pixel_width_mm(conditions.distance_m, focal_px),
        frames=(conditions.frames,),
        depths_mm={kind: None if is_through else (conditions.depth_mm, conditions.depth_mm)},
    )
    return part.overrides


def between(low: float, high: float, share: float) -> float:
    """Return a value between two in logarithms, with three digits."""
    return float(f"{low ** (1 - share) * high**share:.3g}")
