"""Parts that the checks share: making a detector, a look at a cloud, comparing values, reporting a breach."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, cast

import numpy as np

from detectors.interface import Detection, Detector, Evidence
from harness.vocabulary.capture import Cloud

Make = Callable[[], Detector]


def made_by(make: Callable[[], Detector] | type, settings: Mapping[str, Any] | None) -> Make:
    """A function that makes the detector anew."""
    settings_type = getattr(make, "settings_type", None)
    if settings_type is None:
        if settings is not None:
            raise TypeError("`settings` belong to a detector's class with a `settings_type`, not to a function")
        return make
    build = cast("Callable[[Any], Detector]", make)
    return lambda: build(settings_type.from_data(dict(settings or {})))


def broken(what: str) -> AssertionError:
    """The contract is broken."""
    return AssertionError(what)


def require(kept: bool | np.bool_, what: str) -> None:
    """Raise AssertionError unless this part of the contract is kept; python -O does not switch it off."""
    if not kept:
        raise broken(what)


@contextmanager
def no_crash(doing: str) -> Iterator[None]:
    """Tell any exception but a breach as one: a detector that is given a cloud may refuse it, but not break."""
    try:
        yield
    except AssertionError:
        raise
    except Exception as error:
        raise broken(f"{doing} ended in {type(error).__name__}: {error}") from error


@dataclass(frozen=True)
class Look:
    """One detector's evidence on one cloud."""

    detector: Detector
    cloud: Cloud
    evidence: Evidence

    @classmethod
    def at(cls, detector: Detector, cloud: Cloud) -> Look:
        """Analyse a cloud that can be judged."""
        with no_crash("`analyse`"):
            return cls(detector, cloud, detector.analyse(cloud))

    @property
    def quiet(self) -> float:
        """The quiet threshold."""
        with no_crash("`quiet_threshold`"):
            return float(self.detector.quiet_threshold(self.cloud, self.evidence))

    def find(self, threshold: float) -> tuple[Detection, ...]:
        """Return the findings above a threshold."""
        with no_crash(f"`find` at a threshold of {threshold:g}"):
            return tuple(self.detector.find(self.cloud, self.evidence, threshold))

    def thresholds(self) -> tuple[float, ...]:
        """Return rising thresholds from 0 to the quiet threshold at scores of pixels, where findings change."""
        scores = self.evidence.score[np.isfinite(self.evidence.score)]
        high = np.quantile(scores, [0.5, 0.9, 0.99, 0.999]) if len(scores) else np.zeros(0)
        steps = (0.0, *map(float, high), *(share * self.quiet for share in (0.25, 0.5, 0.75, 0.95)))
        return tuple(sorted({step for step in steps if 0.0 <= step < self.quiet}))


def pixels_of(found: tuple[Detection, ...]) -> np.ndarray:
    """Flat indices of all findings' pixels together."""
    return (
        np.unique(np.concatenate([np.asarray(finding.pixels) for finding in found])) if found else np.zeros(0, np.int64)
    )


def same(a: Any, b: Any) -> bool:
    """Return whether two values hold the same bits: arrays, numbers, text, and dataclasses or mappings of them."""
    if isinstance(a, np.ndarray) or isinstance(b, np.ndarray):
        a, b = np.asarray(a), np.asarray(b)
        numbers = a.dtype.kind == "f" and b.dtype.kind == "f"
        return a.shape == b.shape and bool(np.array_equal(a, b, equal_nan=numbers))
    if hasattr(a, "__dataclass_fields__"):
        return type(a) is type(b) and all(same(getattr(a, f), getattr(b, f)) for f in a.__dataclass_fields__)
    if isinstance(a, list | tuple):
        return isinstance(b, list | tuple) and len(a) == len(b) and all(map(same, a, b))
    if isinstance(a, dict):
        return isinstance(b, dict) and a.keys() == b.keys() and all(same(a[key], b[key]) for key in a)
    return bool(a == b) or (a != a and b != b)
