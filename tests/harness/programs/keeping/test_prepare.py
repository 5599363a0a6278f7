"""What is compiled beforehand includes the loops that size a finding."""

from __future__ import annotations

from typing import Any

import pytest

from detectors.findings import family
from harness.programs.keeping.prepare import analyse


def test_a_hole_is_fitted(monkeypatch: pytest.MonkeyPatch) -> None:
    fitted = []

    def fit_hole(*arguments: Any, **settings: Any) -> Any:
        fitted.append(settings["shape"])
        return unwatched(*arguments, **settings)

    unwatched = family.fit_hole
    monkeypatch.setattr(family, "fit_hole", fit_hole)
    analyse()
    assert {"disc", "cap", "bowl"} <= set(fitted)
