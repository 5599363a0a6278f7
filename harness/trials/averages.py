"""Averages of simulated frames, as a trial needs them."""

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

from detectors.averages.average import AverageConfig
from detectors.averages.flat_captures import flattened, separated
from detectors.averages.flat_field import FlatField, FlatFieldConfig, corrected
from detectors.filters import DepthFilterConfig
from detectors.filters.stream import averages_through
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
    filter_json: str | None = None
    """A `DepthFilterConfig` as canonical JSON; None without a filter."""

    @property
    def filter(self) -> DepthFilterConfig | None:
        """The filter."""
        if self.filter_json is None:
            return None
        return DepthFilterConfig.from_data(json.loads(self.filter_json))


def averages_of(
    capture: SimulatedCapture, counts: Sequence[int], averaging: Averaging
) -> dict[int, Cloud]:
    """Return the averages of the first n frames of a capture for each n in ``counts``, by
    `detectors.filters.stream.averages_through` (which may raise). A flat field, measured with the
    same filter, is subtracted. Clouds state how far the camera's edges reach."""
    reach_px = float(capture.unit.camera.optics.margin_px)
    clouds: dict[int, Cloud] = {}
    averages = averages_through(capture, counts, averaging.config, averaging.filter)
    for n, cloud in averages.items():
        clouds[n] = replace(cloud, edge_reach_px=reach_px)
    if averaging.flat_field is None:
        return clouds
    field = flat_field_of(
        capture.unit.config, averaging.flat_field, capture.seed, averaging.filter_json
    )
    return {n: corrected(cloud, field) for n, cloud in clouds.items()}


def measured_flat_field(
    camera: CameraConfig, config: FlatFieldConfig, seed: int, filter_json: str | None = None
) -> FlatField:
    """Measure a unit's flat field on a plane across its axis, with the filter of `Averaging`.
    Raises UserError if no pixel has a range."""
    facts = camera_of(camera)
    view = plane_view(facts, facts.nominal_lens.whole, config.distance_m, FLAT_ALBEDO)
    capture = SimulatedUnit(facts, camera, view).capture(config.frames, seed, "flat field")
    averaging = Averaging(AverageConfig(), filter_json=filter_json)
    clouds = averages_of(capture, [config.frames], averaging)
    cloud = clouds[config.frames]
    flat = flattened(cloud, cloud.valid, "flat field")
    return separated([flat], facts.nominal_lens).field


# all trials of a unit share its flat field
flat_field_of = lru_cache(maxsize=4)(measured_flat_field)
