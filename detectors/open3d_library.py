"""Access to Open3D for odometry, volumes and the detectors of others. Only this module imports it:
that takes seconds."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from harness.vocabulary.errors import UserError
from harness.vocabulary.extras import load_extra

DEBIAN_PACKAGES = {
    "libGL": "libgl1",
    "libgomp": "libgomp1",
    "libX11": "libx11-6",
    "libudev": "libudev1",
    "libusb": "libusb-1.0-0",
}
"""Debian's packages of the system libraries that Open3D's wheel expects."""


class MissingLibrary(UserError):
    """Open3D is installed, but the system lacks a library that it needs."""


def load_open3d() -> Any:
    """Return the module open3d. Raises UserError if it is not installed, MissingLibrary with the
    Debian package of a missing system library."""
    try:
        open3d = load_extra("open3d", "this")
    except (ImportError, OSError) as error:
        package = next(
            (package for library, package in DEBIAN_PACKAGES.items() if library in str(error)), None
        )
        if package is None:
            raise
        problem = f"this needs Open3D, which cannot start: {error}"
        legal = ", ".join(DEBIAN_PACKAGES.values())
        legal = f"a system with the libraries of the Debian packages {legal}"
        raise MissingLibrary(problem, legal=legal, fix=f"apt install {package}") from error
    return open3d


@contextmanager
def open3d_on_one_thread() -> Iterator[Any]:
    """Give the module open3d, silent and on one OpenMP thread within the block: the same bits on
    any machine."""
    import threadpoolctl

    o3d = load_open3d()
    quiet = o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error)
    with threadpoolctl.threadpool_limits(1, user_api="openmp"), quiet:
        yield o3d
