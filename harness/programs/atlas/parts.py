"""The parts of the atlas: the set-ups of a camera at one distance, which are one experiment.

All lengths of a part scale with the distance, so that every part sees boards of as many pixels, and
damage of one to some twenty pixels: what a camera resolves there."""

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from harness.programs.atlas.limits import Conditions
from harness.vocabulary.geometry import MM

EXPERIMENT = "atlas"
"""The experiment of one part."""
NEAREST_M = 0.3
FARTHEST_M = 3.0
COARSEST_PX_MM = 8.0
"""Width of a pixel on the target beyond which nothing is computed: boards of as many pixels would
be wider than 1.2 m, and only damage of several centimetres be found."""
DARK = 0.1
BRIGHT = 0.9
FRAMES = (1, 50)
DEPTHS_MM: Mapping[str, tuple[float | None, ...]] = {
    "through": (None,),
    "blind": (2.0, 8.0),
    "dent": (0.5, 2.0),
    "slot": (2.0, 8.0),
}
"""Depths of each kind of damage, at the ends of what is asked; None: through the board."""
PER_BOARD = 6
BOARD_PX = (150.0, 110.0)
HOLE_PX = (1.0, 12.0)
SLOT_PX = (0.5, 8.0)
SLOT_LENGTH_PX = 14.0
DENT_PX = (2.0, 20.0)
DENT_PER_DEPTH = 3.0  # a dent of a ball, at least so wide for its depth
DENT_SPAN = 2.0  # least ratio of the widest dent to the narrowest; less tells no limit
APART_PX = 24.0
EDGE_PX = 7.0
RADIUS_PX = 10.0
FALSE_CALLS_PER_BOARD = 0.25
"""False calls on a board: a rate per view, as boards of as many pixels scale with the distance, and
6 boards can show it."""
CHECKED = ("azure_kinect_nfov", "pmd_flexx2", "realsense_l515")
"""Cameras with a part that is kept aside from the fit: an imager of fine pixels, one of coarse
pixels, and a scanner."""
CHECK_ALBEDO = 0.3
CHECK_FRAMES = 8
CHECK_SHARE = 0.75  # where the check stands between the first two distances, in logarithms


@dataclass(frozen=True)
class Part:
    """The set-ups of a camera at one distance, which are one experiment."""

    camera: str
    """Name of the camera, or the path of its file."""
    distance_m: float
    """Distance of the boards."""
    albedos: tuple[float, ...]
    """Albedos at which the camera gives a depth there."""
    frames: tuple[int, ...]
    """Numbers of averaged frames."""
    pixel_mm: float
    """Width of a pixel on the boards."""
    depths_mm: Mapping[str, tuple[float | None, ...]] = field(default_factory=lambda: DEPTHS_MM)
    """Depths of each kind of damage."""
    is_check: bool = False
    """Whether its limits are kept aside from the fit."""

    @property
    def damages(self) -> list[dict[str, Any]]:
        """The kinds of damage, with sizes that scale with the distance."""
        damages = []
        for kind, depths_mm in self.depths_mm.items():
            for depth_mm in depths_mm:
                sizes = self._sizes(kind, depth_mm)
                if sizes:
                    deep = {} if depth_mm is None else {"depth_mm": [depth_mm, depth_mm]}
                    damage = {"kind": kind, "per_board": PER_BOARD, **sizes, **deep}
                    damages.append({**damage, "sizes": "log"})
        return damages

    def _sizes(self, kind: str, depth_mm: float | None) -> dict[str, list[float]]:
        """Return the ranges of size of a kind of damage; empty if none tells a limit."""
        if kind == "slot":
            length_mm = self._mm(SLOT_LENGTH_PX)
            width_mm = [self._mm(pixels) for pixels in SLOT_PX]
            return {"width_mm": width_mm, "length_mm": [length_mm, length_mm]}
        if kind != "dent" or depth_mm is None:
            return {"diameter_mm": [self._mm(pixels) for pixels in HOLE_PX]}
        narrowest_mm = max(self._mm(DENT_PX[0]), DENT_PER_DEPTH * depth_mm)
        widest_mm = self._mm(DENT_PX[1])
        if widest_mm < DENT_SPAN * narrowest_mm:
            return {}
        return {"diameter_mm": [narrowest_mm, widest_mm]}

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
            "source.target.apart_mm": self._mm(APART_PX),
            "source.target.edge_mm": self._mm(EDGE_PX),
            "threshold.calibrate.false_calls_per_m2": self.false_calls_per_m2,
            "matching.radius_mm": self._mm(RADIUS_PX),
            "sweep": {
                "source.target.material.albedo_850": list(self.albedos),
                "source.target.damage": self.damages,
                "capture.frames": list(self.frames),
            },
        }
        return [f"{path}={json.dumps(value)}" for path, value in settings.items()]


def exact_overrides(camera: str, focal_px: float, kind: str, conditions: Conditions) -> list[str]:
    """Return what `tofpod sweep atlas --set` needs to run a single set-up."""
    part = Part(
        camera=camera,
        distance_m=conditions.distance_m,
        albedos=(conditions.albedo,),
        frames=(conditions.frames,),
        pixel_mm=conditions.distance_m / focal_px / MM,
        depths_mm={kind: (conditions.depth_mm,)},
    )
    return part.overrides


def between(low: float, high: float, share: float = 0.5) -> float:
    """Return a value between two in logarithms, with two digits."""
    return float(f"{low ** (1 - share) * high**share:.2g}")
