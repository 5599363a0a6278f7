"""Choosing how Mitsuba runs: on a GPU where one works, else on the processor through LLVM, else a message."""

from __future__ import annotations

import os
import sys
import warnings
from pathlib import Path
from typing import Any

from harness.vocabulary.errors import UserError

VARIANTS = ("cuda_ad_mono", "llvm_ad_mono")


def load_mitsuba() -> Any:
    """The mitsuba module with a variant set. Raises UserError that names what to install where none works.

    Dr.Jit 1.5 aborts the process at the first kernel with LLVM 14 to 16, so the LLVM of the wheel
    karellen-llvm-core is preferred to the system's; a path in DRJIT_LIBLLVM_PATH has the last word.
    """
    # Dr.Jit looks for LLVM when it is imported, so the path comes first; that there is none matters without a GPU only.
    missing = _point_to_llvm()
    import mitsuba as mi

    if mi.variant() in VARIANTS or _works(mi, "cuda_ad_mono"):
        return mi
    if missing is not None:
        raise missing
    if _works(mi, "llvm_ad_mono"):
        return mi
    if "open3d" in sys.modules:
        # Both wheels bring a libc++.so.1; the first that is loaded serves both, and Open3D's is too old for LLVM.
        raise UserError(
            "Mitsuba cannot run: Open3D was imported before it, and its C++ library stands in for the one of LLVM",
            fix="call scenes.render.variant.load_mitsuba() before importing open3d, or render in a process of its own",
        )
    raise UserError(
        "Mitsuba cannot run: no NVIDIA GPU answers and no usable LLVM was found",
        legal="LLVM 17 or newer (14 to 16 abort the process with Dr.Jit 1.5)",
        fix="pip install karellen-llvm-core (Linux x86-64), or apt install libllvm19, or set DRJIT_LIBLLVM_PATH",
    )


def _works(mi: Any, name: str) -> bool:
    """Tell whether a small kernel runs in the variant."""
    if name not in mi.variants() or (name.startswith("cuda") and not _has_nvidia_driver()):
        return False
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            mi.set_variant(name)
            import drjit as dr

            return bool(dr.sum(mi.Float(1.0, 2.0) * 2.0)[0] == 6.0)
        except Exception:
            # Dr.Jit reports a missing backend by exceptions of several types; any of them means "not this one".
            return False


def _has_nvidia_driver() -> bool:
    """Asking Dr.Jit for CUDA without a driver prints warnings that a user would take for a fault."""
    return Path("/proc/driver/nvidia/version").exists() or Path("/dev/nvidiactl").exists() or sys.platform == "win32"


def _point_to_llvm() -> UserError | None:
    """Set DRJIT_LIBLLVM_PATH where it is not set; the mistake to raise where no LLVM can be used."""
    if os.environ.get("DRJIT_LIBLLVM_PATH"):
        named = Path(os.environ["DRJIT_LIBLLVM_PATH"])
        if not named.exists():
            return UserError(
                f"DRJIT_LIBLLVM_PATH names {named}, which does not exist",
                legal="the path of a libLLVM shared library, version 17 or newer",
                fix="mend or unset DRJIT_LIBLLVM_PATH",
            )
        return None
    for folder in (Path(sys.prefix) / "lib", Path(sys.base_prefix) / "lib"):
        found = sorted(folder.glob("libLLVM.so.*"), key=lambda p: (len(p.name), p.name))
        if found:
            os.environ["DRJIT_LIBLLVM_PATH"] = str(found[-1])
            return None
    if sys.platform == "linux" and not _system_has_recent_llvm():
        return UserError(
            "no LLVM was found that Dr.Jit can use",
            legal="LLVM 17 or newer (14 to 16 abort the process with Dr.Jit 1.5)",
            fix="pip install karellen-llvm-core (Linux x86-64), or apt install libllvm19, or set DRJIT_LIBLLVM_PATH",
        )
    return None


def _system_has_recent_llvm() -> bool:
    """Looks where distributions put it, and points to it: Dr.Jit's own search may pick an older one."""
    for version in range(30, 16, -1):
        for pattern in (f"*/libLLVM-{version}.so*", f"*/libLLVM.so.{version}*", f"llvm-{version}/lib/libLLVM*.so*"):
            for root in (Path("/usr/lib"), Path("/usr/lib64")):
                found = sorted(root.glob(pattern))
                if found:
                    os.environ["DRJIT_LIBLLVM_PATH"] = str(found[0])
                    return True
    return False
