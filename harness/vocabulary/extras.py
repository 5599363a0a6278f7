"""Packages that tofpod needs for some tasks only, and what to type where one is missing."""

import importlib
from importlib.util import find_spec
from typing import Any

from harness.vocabulary.errors import UserError

EXTRAS = {
    "mitsuba": "sim",
    "manifold3d": "sim",
    "open3d": "open3d",
    "distributed": "cluster",
    "dask_jobqueue": "cluster",
    "openpyxl": "excel",
    "py4dgeo": "peers",
}
"""The extra in `pyproject.toml` of each module that a plain installation lacks."""


def load_extra(module: str, purpose: str) -> Any:
    """Return a module of `EXTRAS`. Raises UserError with the line to type if it is not installed;
    ``purpose`` begins the message: "a render"."""
    require_extra(module, purpose)
    return importlib.import_module(module)


def require_extra(module: str, purpose: str) -> None:
    """Raise the UserError of `load_extra` if a module of `EXTRAS` is not installed."""
    try:
        is_installed = find_spec(module) is not None
    except ValueError:  # a test has put None in its place
        is_installed = False
    if not is_installed:
        fix = f"pip install 'tofpod[{EXTRAS[module]}]'"
        raise UserError(
            f"{purpose} needs the package {module}, which is not installed: {fix}", fix=fix
        )
