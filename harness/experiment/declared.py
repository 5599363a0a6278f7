"""What an experiment's data is declared to be, the settings of the detector that it names included."""

from __future__ import annotations

from typing import Any

from detectors import DETECTORS, detector_names, detector_type
from harness.experiment.schema import ExperimentConfig
from harness.vocabulary.declaration import shape

DETECTOR_NAME = ("detector", "name")
DETECTOR_SETTINGS = ("detector", "settings")


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


def detector_content(config: ExperimentConfig) -> dict[str, Any]:
    """What can change the detector's numbers beside its settings: its version, of a plug-in the package's too."""
    offer = DETECTORS.offer(config.detector.name)
    origin = {} if offer.built_in else {"detector_from": offer.origin}
    return {"detector_version": detector_version(config), **origin}
