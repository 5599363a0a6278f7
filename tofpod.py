"""``import tofpod``: the harness from Python; see `harness.api`."""

from harness.api import *  # noqa: F403
from harness.api import __all__ as __all__
