"""A package of somebody else's: a detector and a camera, with their entry points, as its author
would publish it."""

from __future__ import annotations

from pathlib import Path

from scenes.sensor.camera import CAMERA_FOLDER

PYPROJECT = """\
[build-system]
requires = ["setuptools>=61"]
build-backend = "setuptools.build_meta"

[project]
name = "acme-inspection"
version = "2.5"

[project.entry-points."tofpod.detectors"]
acme_median = "acme_inspection.detector:MedianDetector"
acme_broken = "acme_inspection.detector:NoSuchDetector"

[project.entry-points."tofpod.cameras"]
acme_tof = "acme_inspection:CAMERA"

[tool.setuptools]
packages = ["acme_inspection"]

[tool.setuptools.package-data]
acme_inspection = ["*.yaml"]
"""

PACKAGE = """\
from pathlib import Path

CAMERA = Path(__file__).parent / "acme_tof.yaml"
"""

DETECTOR = '''\
import cv2
import numpy as np
from pydantic import Field

from detectors.crop import BoxCrop, CropConfig, crop
from detectors.interface import Evidence
from detectors.score_map import ScoreMapConfig, ScoreMapDetector


class MedianConfig(ScoreMapConfig):
    """``window_px``: side of the square whose mean is taken for the undamaged surface."""

    crop: CropConfig = Field(default_factory=BoxCrop)
    window_px: int = Field(default=41, ge=3, le=199)


class MedianDetector(ScoreMapDetector[MedianConfig]):
    """What departs from the mean of its surroundings, in robust standard deviations."""

    settings_type = MedianConfig
    name = "acme_median"
    version = 4

    def analyse(self, cloud):
        mask = crop(cloud, self.settings.crop)
        z = np.where(mask, cloud.points_m[..., 2], 0.0)
        side = (self.settings.window_px,) * 2
        surface = cv2.blur(z, side) / np.maximum(cv2.blur(mask.astype(float), side), 1e-12)
        residual = np.where(mask, z - surface, np.nan)
        scale = max(float(np.nanmedian(np.abs(residual))) / 0.6745, 1e-9)
        return Evidence(np.abs(residual) / scale, residual, np.where(mask, surface, np.nan), scale)
'''


def write_package(folder: Path) -> Path:
    """Write the package's sources; its camera is an Azure Kinect by another name, with a title of
    its own."""
    code = folder / "acme_inspection"
    code.mkdir(parents=True)
    (folder / "pyproject.toml").write_text(PYPROJECT)
    (code / "__init__.py").write_text(PACKAGE)
    (code / "detector.py").write_text(DETECTOR)
    azure = (CAMERA_FOLDER / "azure_kinect_nfov.yaml").read_text()
    renamed = azure.replace("name: azure_kinect_nfov", "name: acme_tof", 1)
    titled = renamed.replace("title: Azure Kinect DK, NFOV unbinned", "title: Acme ToF 1", 1)
    (code / "acme_tof.yaml").write_text(titled)
    return folder
