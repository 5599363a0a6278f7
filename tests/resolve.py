"""Resolve the requirements for every platform and Python, from wheels only, and print the table of
`docs/releasing.md`: ``python -m tests.resolve``. Asks the package index and nothing else."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PYTHONS = ("3.11", "3.12", "3.13", "3.14")
PLATFORMS = {
    "Linux x86-64": "x86_64-manylinux_2_35",
    "Linux Arm (aarch64)": "aarch64-manylinux_2_35",
    "Windows x86-64": "x86_64-pc-windows-msvc",
    "macOS Arm": "aarch64-apple-darwin",
}
"""uv's names; glibc 2.35 is that of Ubuntu 22.04 and JetPack 6."""
EXTRAS = ("", "sim", "open3d", "cluster", "excel", "peers")


def resolved(platform: str, python: str, extra: str) -> tuple[int, str]:
    """Return the number of packages of tofpod with an extra, itself not counted, and an empty
    text; or 0 and why there is none."""
    command = [sys.executable, "-m", "uv", "pip", "compile", "--quiet", "--no-header"]
    command += ["--no-annotate", "--only-binary", ":all:", "--python-platform", platform]
    command += ["--python-version", python, "pyproject.toml"]
    if extra:
        command += ["--extra", extra]
    ran = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    if ran.returncode:
        return 0, ran.stderr
    return len(ran.stdout.splitlines()), ""


def cell(platform: str, extra: str) -> str:
    """Return the least and most packages over the Pythons; or for which there is no wheel, whose
    reasons go to the standard error."""
    counts = []
    lacking = []
    for python in PYTHONS:
        count, why = resolved(platform, python, extra)
        if why:
            print(f"{platform}, Python {python}, {extra or 'light'}:\n{why}", file=sys.stderr)
            lacking.append(python)
        else:
            counts.append(count)
    if lacking:
        return "none" if len(lacking) == len(PYTHONS) else "none for " + ", ".join(lacking)
    return str(counts[0]) if min(counts) == max(counts) else f"{min(counts)}-{max(counts)}"


def main() -> int:
    """Print the table. Return 1 if a plain installation or a simulation does not resolve."""
    print("| platform | light | " + " | ".join(f"`{extra}`" for extra in EXTRAS[1:]) + " |")
    print("|---" * (1 + len(EXTRAS)) + "|")
    failures = 0
    for name, platform in PLATFORMS.items():
        cells = [cell(platform, extra) for extra in EXTRAS]
        failures += sum(text.startswith("none") for text in cells[:2])
        print(f"| {name} | " + " | ".join(cells) + " |", flush=True)
    return int(failures > 0)


if __name__ == "__main__":
    raise SystemExit(main())
