"""What an experiment's data is declared to be, the settings of the detector that it names included."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import detectors
from harness.experiment.schema import ExperimentConfig
from harness.vocabulary.declaration import shape

DETECTOR_NAME = ("detector", "name")
DETECTOR_SETTINGS = ("detector", "settings")


@lru_cache(maxsize=1)
def detector_names() -> tuple[str, ...]:
    """Every known detector. Remembered, because looking for plug-ins reads every installed package: 7 ms each time."""
    return detectors.detector_names()


@lru_cache
def detector_type(name: str) -> Any:
    """The class of a detector, remembered as `detector_names` are."""
    return detectors.detector_type(name)


def forget_detectors() -> None:
    """Look for plug-ins anew."""
    detector_names.cache_clear()
    detector_type.cache_clear()


def splices_of(data: Any) -> shape.Splices:
    """The model of the detector's settings where they stand in the data; nothing for a detector that does not exist."""
    detector = shape.child(data, "detector")
    name = detector.get("name", "thesis") if isinstance(detector, dict) else "thesis"
    if not isinstance(name, str) or name not in detector_names():
        return {}
    return {DETECTOR_SETTINGS: detector_type(name).settings_type}


def declared_of(data: Any) -> shape.Declared:
    """The declaration that ``data`` is meant to fill."""
    return shape.Declared(ExperimentConfig, data, splices_of(data))


def detector_version(config: ExperimentConfig) -> int:
    """The version of the experiment's detector."""
    kind = detector_type(config.detector.name)
    return int(kind(kind.settings_type.from_data(config.detector.settings)).version)
