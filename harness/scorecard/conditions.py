"""The conditions under which a quantity is measured, as a user writes them: what the camera looks at.

All scenes lie about the optical axis. Defaults are the usual case; a published figure states what differs.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import Field

from harness.vocabulary.config import Config

Distance = Annotated[float, Field(ge=0.1, le=20.0, description="along the optical axis, in metres")]
Albedo = Annotated[float, Field(gt=0.0, le=1.0, description="diffuse reflectance, above 0 and up to 1")]
Lag = Annotated[int, Field(ge=0, le=16, description="pixels from 0 to 16")]
DiameterPx = Annotated[float, Field(ge=0.5, le=12.0, description="in pixels, 0.5 to 12")]
StepMm = Annotated[float, Field(ge=0.5, le=5e3, description="from front to back, 0.5 to 5000 mm")]


class PlaneConditions(Config):
    """An endless matte plane that fills the field of view."""

    distance_m: Distance = 1.5
    albedo: Albedo = 0.8
    angle_deg: Annotated[float, Field(ge=0.0, le=80.0, description="of incidence, 0 to 80 degrees")] = 0.0


class LagConditions(PlaneConditions):
    """Two pixels of a plane, so far apart."""

    lag_x_px: Lag = 1
    lag_y_px: Lag = 0


class StepConditions(Config):
    """A straight edge of one matte plane before another, both frontal, the edge 6 degrees off the pixel grid.

    ``across``: the image axis along which z steps. ``shadow``: whether the front stands on the emitter's side, so that
    it throws its shadow on the visible back (where the emitter is offset along that axis).
    """

    distance_m: Distance = 0.75
    step_mm: StepMm = 50.0
    albedo: Albedo = 0.6
    across: Literal["x", "y"] = "x"
    shadow: bool = False


class SurvivalConditions(Config):
    """Round plateaus before a plane, at all positions relative to the pixel grid."""

    distance_m: Distance = 0.75
    diameter_px: DiameterPx = 3.0
    albedo: Albedo = 0.6


class PlateauConditions(SurvivalConditions):
    """Round plateaus of one height before a plane."""

    step_mm: StepMm = 18.0


class RoomConditions(Config):
    """A board of 400 x 300 mm, albedo 0.6, in a room with a floor and a back wall."""

    distance_m: Annotated[float, Field(ge=0.4, le=2.2, description="in metres, 0.4 to 2.2")] = 0.7
    multipath: bool = True


def scene_of(conditions: Config) -> tuple[str, dict[str, Any]]:
    """What has to be simulated for some conditions: equal for those that share it, such as all lags on one plane."""
    data = conditions.to_data()
    for lag in ("lag_x_px", "lag_y_px"):
        data.pop(lag, None)
    kind = type(conditions)
    return (PlaneConditions if kind is LagConditions else kind).__name__, data


def in_words(conditions: Config) -> str:
    """Conditions as a short text with units: ``1.5 m, albedo 0.8``."""
    data = conditions.to_data()
    lag = data.pop("lag_x_px", None), data.pop("lag_y_px", None)
    words = [_WORDS[key](value) for key, value in data.items()]
    if lag != (None, None):
        words.append(f"lag ({lag[0]}, {lag[1]}) px")
    return ", ".join(word for word in words if word)


_WORDS: dict[str, Any] = {
    "distance_m": lambda v: f"{v:g} m",
    "albedo": lambda v: f"albedo {v:g}",
    "angle_deg": lambda v: f"{v:g}°" if v else "",
    "step_mm": lambda v: f"step {v:g} mm",
    "across": lambda v: f"across {v}",
    "shadow": lambda v: "shadowed" if v else "",
    "diameter_px": lambda v: f"⌀ {v:g} px",
    "multipath": lambda v: "multipath on" if v else "multipath off",
}
