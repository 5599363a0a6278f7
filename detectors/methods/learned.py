"""Detects damage by a small network that was trained on simulated frames (`tofpod train`).

The network sees the residuals whitened as by `matched`, C^-1/2 r, and which pixels are known. It
states the logarithm of the odds that a pixel is damage. Less the odds among the pixels that it was
trained on, this is the logarithm of a likelihood ratio L, and

    score = sqrt(2 ln(1 + L))

is in deviations, as a matched filter's score s has ln L = s^2 / 2. What lies in front of the
surface is judged by the same network on the residuals with their sign reversed. From ln(1 + L) a
share of the largest of the other sign nearby is subtracted, as side lobes of the whitening have it.

Not modelled: what the training frames did not show. Noise of other cameras is whitened to the same
deviation, but a mixture of pixels at edges that no training frame had may look like damage. Scores
count as deviations for saddles between findings only; thresholds come from hole-free captures."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path
from typing import Any, ClassVar

import cv2
import numpy as np
from pydantic import Field, model_validator

from detectors.methods.deviations import RIM_PX
from detectors.methods.matched import (
    LOBE_SHARE,
    MatchedConfig,
    MatchedDetector,
    Whitened,
)
from detectors.methods.network import Network, read_network
from harness.vocabulary.errors import UserError
from harness.vocabulary.files import file_digest

SHIPPED = Path(__file__).with_suffix(".npz")
"""The network that comes with tofpod, trained by ``tofpod train experiments/training.yaml``."""
LINEAR_SIGMAS = 4.0
"""Whitened residuals up to about this size count in proportion; larger ones by their logarithm, so
that a deep hole does not exceed single precision or drown its neighbours."""


class LearnedConfig(MatchedConfig):
    """``surface``: the thesis' polynomial unless its ``shape`` is given. ``hole_model``: measures
    sizes."""

    network: str | None = Field(
        default=None,
        min_length=1,
        max_length=1000,
        description="a file of tofpod train, from the current folder; null: tofpod's own",
    )
    digest: str | None = Field(
        default=None,
        description="of the network's file, which results hang on; null: that of the file as it is",
    )

    @model_validator(mode="before")
    @classmethod
    def _with_digest(cls, data: Any) -> Any:
        if not isinstance(data, dict) or data.get("digest") is not None:
            return data
        name = data.get("network", cls.model_fields["network"].default)
        path = SHIPPED if name is None else Path(str(name))
        if not path.is_file():
            raise ValueError(f"network: there is no file {path}; write one with tofpod train")
        digest = file_digest(path)
        try:
            _read(path, digest)
        except UserError as error:
            raise ValueError(f"network: {error}") from error
        return {**data, "digest": digest}


class LearnedDetector(MatchedDetector):
    """A small network on whitened residuals, trained on simulated frames; findings are peaks."""

    settings_type: ClassVar[type[LearnedConfig]] = LearnedConfig
    name = "learned"
    version = 4

    def scored(
        self,
        residual_m: np.ndarray,
        weights: np.ndarray,
        rounding_m2: tuple[float, float],
        reach_px: float,
    ) -> tuple[np.ndarray, float, str]:
        """Return signed scores (r, c), a pixel's deviation (m), and the unit of score. The network
        sees the rim as it is: variances of its own are not taken off."""
        whitened = self.whitened(residual_m, weights, rounding_m2)
        network = self.network
        behind = _evidence(network, whitened, 1.0)
        before = _evidence(network, whitened, -1.0)
        # what lies beside stronger evidence of the other sign is a side lobe of the whitening
        reach = np.ones((2 * RIM_PX + 1,) * 2, np.uint8)
        alone_behind = behind - LOBE_SHARE * cv2.dilate(before, reach)
        alone_before = before - LOBE_SHARE * cv2.dilate(behind, reach)
        strongest = np.maximum(alone_behind, alone_before)
        side = np.where(alone_behind >= alone_before, 1.0, -1.0)
        strongest = np.maximum(strongest, 0.0)
        # below one deviation in proportion: the root is too steep at 0 to repeat
        score = np.where(strongest > 0.5, np.sqrt(2.0 * strongest), 2.0 * strongest)
        signed = side * score * whitened.is_known
        deviation_m = float(np.median(whitened.unit_m[whitened.is_known]))
        unit = (
            "the root of twice the logarithm of a network's likelihood ratio; the noise of a pixel"
            f" is {1e3 * deviation_m:.3g} mm"
        )
        return signed.astype(np.float64), deviation_m, unit

    @property
    def network(self) -> Network:
        """The network of the settings. Raises UserError if its file is not a network, or changed
        since the settings were read."""
        settings = self.settings
        assert isinstance(settings, LearnedConfig)
        path = SHIPPED if settings.network is None else Path(settings.network)
        if not path.is_file() or file_digest(path) != settings.digest:
            problem = f"is not the network with the digest {settings.digest} of the settings"
            fix = "restore the file, or leave `digest` out of the detector's settings"
            raise UserError(f"{path}: {problem}", fix=fix)
        return _read(path, str(settings.digest))


@lru_cache(maxsize=8)
def _read(path: Path, digest: str) -> Network:
    """Return the network of a file whose content has a digest."""
    return read_network(path)


def seen_by_network(values: np.ndarray, known: np.ndarray, sign: float) -> np.ndarray:
    """Return what a network sees (2, r, c): whitened residuals (r, c) times a sign, and the known
    pixels (r, c) bool."""
    signed = np.float32(sign) * values
    shrunk = LINEAR_SIGMAS * np.arcsinh(signed / LINEAR_SIGMAS)
    return np.stack([shrunk * known, known]).astype(np.float32)


def _evidence(network: Network, whitened: Whitened, sign: float) -> np.ndarray:
    """Return ln(1 + L) (r, c) float32 for the residuals times a sign."""
    pictures = seen_by_network(whitened.values, whitened.is_known, sign)
    log_ratio = network.log_odds(pictures) - np.float32(network.prior_log_odds)
    return np.logaddexp(np.float32(0.0), log_ratio)
