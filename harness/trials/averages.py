"""Averages of simulated frames, as a trial needs them."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

from detectors.averages.average import AverageConfig, prefix_averages
from detectors.averages.flat_captures import flattened, separated
from detectors.averages.flat_field import FlatField, FlatFieldConfig, corrected
from harness.vocabulary.geometry import Cloud
from scenes.closed_form import plane_view
from scenes.sensor.camera import camera_of
from scenes.sensor.common.config import CameraConfig
from scenes.sensor.source import SimulatedCapture, SimulatedUnit

# albedo of a flat field's plane: painted wood or paper, like the boards of the experiments
FLAT_ALBEDO = 0.6


@dataclass(frozen=True)
class Averaging:
    """The way in which frames become a cloud."""

    config: AverageConfig
    """The average, and which frames it leaves out."""
    flat_field: FlatFieldConfig | None = None
    """The flat field to subtract."""


def averages_of(
    capture: SimulatedCapture, counts: Sequence[int], averaging: Averaging
) -> dict[int, Cloud]:
    """Return the averages of the first n frames of a capture for each n in ``counts``, by
    `detectors.averages.average.prefix_averages` (which may raise). A flat field is subtracted.
    Clouds state how far the camera's edges reach."""
    reach_px = float(capture.unit.camera.optics.margin_px)
    clouds: dict[int, Cloud] = {}
    for n, cloud in prefix_averages(capture, counts, averaging.config).items():
        clouds[n] = replace(cloud, edge_reach_px=reach_px)
    if averaging.flat_field is None:
        return clouds
    field = flat_field_of(capture.unit.config, averaging.flat_field, capture.seed)
    return {n: corrected(cloud, field) for n, cloud in clouds.items()}


def measured_flat_field(camera: CameraConfig, config: FlatFieldConfig, seed: int) -> FlatField:
    """Measure a unit's flat field on a plane across its axis. Raises UserError if no pixel has a
    range."""
    facts = camera_of(camera)
    view = plane_view(facts, facts.nominal_lens.whole, config.distance_m, FLAT_ALBEDO)
    capture = SimulatedUnit(facts, camera, view).capture(config.frames, seed, "flat field")
    clouds = averages_of(capture, [config.frames], Averaging(AverageConfig()))
    cloud = clouds[config.frames]
    flat = flattened(cloud, cloud.valid, "flat field")
    return separated([flat], facts.nominal_lens).field


# all trials of a unit share its flat field
flat_field_of = lru_cache(maxsize=4)(measured_flat_field)
