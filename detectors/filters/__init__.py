"""Filters from depth to depth that a driver or a user puts before the average.

Filters are found by name: the built-in ones below, others through the entry point group
``tofpod.filters``."""

from __future__ import annotations

import uuid
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any, Literal, cast

from pydantic import Field

from detectors.filters.interface import (
    DepthFilter,
    DepthFunction,
    FunctionFilter,
    NoSettings,
)
from harness.vocabulary.config import Config
from harness.vocabulary.errors import UserError
from harness.vocabulary.plug_ins import PlugIns

GROUP = "tofpod.filters"
"""Entry points of this group name a class ``C`` with ``C.settings_type`` (a Config) and
``C(settings)`` a `DepthFilter`, or a `DepthFunction`."""

BUILT_IN = {
    "hole_filling": "detectors.filters.hole_filling:HoleFillingFilter",
    "median": "detectors.filters.median:MedianFilter",
    "spatial": "detectors.filters.spatial:SpatialFilter",
    "temporal": "detectors.filters.temporal:TemporalFilter",
}

FILTERS = PlugIns(GROUP, "filter", lambda: BUILT_IN)

_functions: dict[str, FunctionFilter] = {}  # those of `functions_named`


class DepthFilterConfig(Config):
    """A filter by name, its settings, which each filter declares, and what it acts on."""

    name: str
    settings: dict[str, Any] = Field(default_factory=dict)
    acts_on: Literal["frames", "average"] = Field(
        "frames",
        description="each frame before the average, as in a driver, or the average itself",
    )


@contextmanager
def functions_named(functions: Mapping[str, DepthFunction]) -> Iterator[None]:
    """Let experiments of this process use functions as filters. A function has no version, so that
    results with it are never used again. Raises UserError for a name that is taken."""
    for name, function in functions.items():
        if name in filter_names():
            raise UserError(f"there is a filter {name!r} already", fix="choose another name")
        version = uuid.uuid4().int
        _functions[name] = FunctionFilter(name, function, version)
    try:
        yield
    finally:
        for name in functions:
            _functions.pop(name, None)


def filter_names() -> tuple[str, ...]:
    """Return every known name, sorted."""
    return tuple(sorted({*FILTERS.names(), *_functions}))


def filter_origin(name: str) -> str:
    """Return the package of a plug-in with its version; empty for built-in filters and functions
    of this process."""
    if name in _functions:
        return ""
    offer = FILTERS.offer(name)
    return "" if offer.built_in else offer.origin


def filter_module(name: str) -> str | None:
    """Return the module with a filter's code; None for a function of this process."""
    if name in _functions:
        return None
    return FILTERS.offer(name).target.partition(":")[0]


def filter_settings_type(name: str) -> type[Config]:
    """Return the declaration of a filter's settings. Raises UserError as `load_filter`."""
    if name in _functions:
        return NoSettings
    return cast("type[Config]", getattr(_loaded(name), "settings_type", NoSettings))


def load_filter(name: str, settings: dict[str, Any]) -> DepthFilter:
    """Return the filter of that name with these settings (plain data, as YAML holds it). Raises
    UserError on an unknown name, a name taken twice, a plug-in that is not a filter, and settings
    that are not legal (every problem at once)."""
    from harness.vocabulary.declaration.diagnose import settings_of

    declared = settings_of(filter_settings_type(name), settings, f"settings of filter {name!r}")
    if name in _functions:
        return _functions[name]
    loaded = _loaded(name)
    if not isinstance(loaded, type):
        return FunctionFilter(name, loaded)
    return cast("DepthFilter", loaded(declared))


def _loaded(name: str) -> Any:
    """Return the class or function behind a name."""
    offer = FILTERS.offer(name)
    loaded = FILTERS.load(offer)
    if not callable(loaded):
        raise FILTERS.broken(offer, "it is neither a class nor a function")
    if isinstance(loaded, type):
        settings_type = getattr(loaded, "settings_type", None)
        if not (isinstance(settings_type, type) and issubclass(settings_type, Config)):
            why = "it has no `settings_type` that is a harness.vocabulary.config.Config"
            raise FILTERS.broken(offer, why)
        own_name = getattr(loaded, "name", None)
        if isinstance(own_name, str) and own_name != name:
            raise FILTERS.broken(offer, f"it is called {own_name!r}, but offered as {name!r}")
    return loaded
