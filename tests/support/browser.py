"""Pages opened in a browser without a window, at the widths of a telephone and of a desktop, light
and dark."""

import html
import json
import re
import shutil
import subprocess
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import pytest

WIDTHS_PX = (400, 1280)
SCHEMES = {"light": 1, "dark": 0}
"""Chromium's number of each colour scheme."""
SCRIPT = Path(__file__).with_name("browser.js")


@dataclass(frozen=True)
class Measured:
    """A page at one width in one colour scheme."""

    scheme: str
    """light or dark."""
    width_px: int
    """Width of the window."""
    height_px: int
    """Height of the whole page."""
    overflow_px: int
    """Width of the page beyond that of the window."""
    wide: list[str]
    """Elements that reach beyond the window."""
    faint: list[str]
    """Texts with less contrast than WCAG 2.2 AA asks for (4.5, large texts 3)."""
    missing: list[str]
    """Images that could not be shown."""


def browser() -> str:
    """Return the command of Chromium; skip the test where there is none."""
    for name in ("chromium", "chromium-browser", "google-chrome"):
        command = shutil.which(name)
        if command is not None:
            return command
    pytest.skip("no Chromium to open a page in")


def opened(path: Path, folder: Path, *options: str) -> str:
    """Return a page's elements after its scripts have run; skip the test where Chromium does not
    run. ``folder`` takes the browser's profile."""
    command = [
        browser(),
        "--headless",
        "--no-sandbox",
        "--disable-background-networking",
        f"--user-data-dir={folder / 'profile'}",
        *options,
        "--virtual-time-budget=4000",
        "--dump-dom",
        path.as_uri(),
    ]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    if done.returncode or "</html>" not in done.stdout:
        pytest.skip(f"Chromium does not run here: {done.stderr[-200:]}")
    return done.stdout


def measure(paths: Sequence[Path], folder: Path) -> dict[Path, list[Measured]]:
    """Return what a browser shows of pages at each width and in each colour scheme."""
    frames = ""
    for path in paths:
        for width_px in WIDTHS_PX:
            style = f"border:0;width:{width_px}px;height:900px"
            frames += f'<iframe src="{path.resolve().as_uri()}" style="{style}"></iframe>'
    around = folder / "around.html"
    around.write_text(
        "<!doctype html><html><head><meta name=color-scheme content='light dark'></head><body>"
        f"{frames}<pre></pre><script>{SCRIPT.read_text()}</script></body></html>"
    )
    pages: dict[Path, list[Measured]] = {path: [] for path in paths}
    for scheme, number in SCHEMES.items():
        shown = opened(
            around,
            folder,
            "--window-size=1400,900",
            "--hide-scrollbars",
            "--allow-file-access-from-files",
            f"--blink-settings=preferredColorScheme={number}",
        )
        written = re.search(r"<pre>(.+?)</pre>", shown, re.DOTALL)
        assert written is not None, "the page was not measured"
        values = json.loads(html.unescape(written.group(1)))
        for number, value in enumerate(values):
            path = paths[number // len(WIDTHS_PX)]
            pages[path].append(Measured(scheme=scheme, **value))
    return pages
