"""Score one answer of `tofpod detect`: right, warned or wrong, and why."""

from __future__ import annotations

import contextlib
import csv
import io
import math
import re
import traceback
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from harness import detect
from tests.strangers.recording import Stranger, Truth
from tests.strangers.world import CastView

NEAR_MM = 12.0
FALSE_CALLS = 1
"""False findings that a right answer may hold; none of them on another surface than the target."""
DOUBTFUL_CALLS = 3
"""False findings of the class "doubtful" that a right answer may hold besides, if it does not state
an interval of false calls; else up to the interval's upper end."""
INTERVAL = re.compile(r"([0-9.e-]+) false calls? expected \(\d+ to (\d+)\)")
"""The number of false calls that an answer expects, and its interval."""
CAUSES = {"at_rim", "open_behind", "depth_open"}
"""Flags that warn of a wrong size."""
FACTOR = 1.5
"""A size is right within this factor of what may rightly be called the size ..."""
PIXELS = 2.0
SIGMAS = 3.0
"""... and two pixels, or three deviations of an averaged pixel."""
RIM_PX = 4


@dataclass(frozen=True)
class Score:
    """``verdict``: right, warned or wrong; ``why``: what is not right, empty where all is."""

    verdict: str
    why: tuple[str, ...]
    warnings: tuple[str, ...]
    output: str
    clear: int
    found: int
    false: int
    doubtful: int
    """False findings of the class "doubtful"."""
    expected: float
    """False calls that the answer expects; NaN where it states none."""

    @property
    def needless(self) -> bool:
        """Right, and yet warned of."""
        return self.verdict == "right" and bool(self.warnings)


def answered(
    path: Path, out: Path, arguments: tuple[str, ...] = ()
) -> tuple[int, str, list[dict[str, str]]]:
    """(exit code, all that was printed, rows of findings.csv) of the default command; a traceback
    is code 1."""
    string_io = io.StringIO()
    with contextlib.redirect_stdout(string_io), contextlib.redirect_stderr(string_io):
        try:
            code = detect.main([str(path), "--out", str(out), *arguments])
        except SystemExit as exit_:
            code = int(exit_.code or 0)
        except Exception:
            string_io.write(traceback.format_exc())
            code = 1
    table = out / "findings.csv"
    rows = list(csv.DictReader(table.open())) if code == 0 and table.is_file() else []
    return code, string_io.getvalue(), rows


def scored(
    stranger: Stranger,
    view: CastView,
    truths: tuple[Truth, ...],
    code: int,
    said: str,
    rows: list[dict[str, str]],
) -> Score:
    """Compare an answer with the truth."""
    lines = [line for line in said.splitlines() if line.strip()]
    warnings = []
    for line in lines:
        if not line.startswith("warning: "):
            break
        warnings.append(line)
    clear = [truth for truth in truths if truth.clear]
    if code == 2 and "Traceback" not in said and len(lines) <= 6:
        return Score("warned", ("refused",), (), said, len(clear), 0, 0, 0, math.nan)
    why = [] if code == 0 else [f"exit {code}"]
    matched = [_match(row, truths) for row in rows]
    result = {id(truth) for truth in matched if truth is not None}
    missed = [truth for truth in clear if id(truth) not in result]
    if missed:
        shown = ", ".join(_shown(truth) for truth in missed[:3])
        why.append(f"{len(missed)} of {len(clear)} missed ({shown})")
    # joints are named as features of the part, not as damage
    is_damage = [row["certainty"] != "feature" for row in rows]
    unmatched = [
        row
        for row, truth, damage in zip(rows, matched, is_damage, strict=True)
        if truth is None and damage
    ]
    elsewhere, false = _unmatched(
        stranger, view, [row for row in unmatched if row["certainty"] != "doubtful"]
    )
    doubtful_elsewhere, doubtful = _unmatched(
        stranger, view, [row for row in unmatched if row["certainty"] == "doubtful"]
    )
    doubtful += doubtful_elsewhere
    if elsewhere:
        why.append(f"{elsewhere} on another surface")
    if false > FALSE_CALLS:
        why.append(f"{false} false")
    stated = INTERVAL.search(said)
    if doubtful > (int(stated.group(2)) if stated else DOUBTFUL_CALLS):
        why.append(f"{doubtful} doubtful ones false")
    misjudged, is_flagged = _misjudged(stranger, rows, matched)
    why += misjudged
    is_only_flagged = bool(misjudged) and is_flagged and why == misjudged
    is_warned = bool(warnings) or is_only_flagged
    if stranger.doubtful and not warnings:
        why.append("no word about a target that is none")
    verdict = "right"
    if why:
        verdict = "warned" if is_warned else "wrong"
    if stranger.doubtful and warnings and code == 0:
        verdict = "warned"
    return Score(
        verdict,
        tuple(why),
        tuple(warnings),
        said,
        len(clear),
        len(clear) - len(missed),
        false + elsewhere + doubtful,
        doubtful,
        float(stated.group(1)) if stated else math.nan,
    )


def _place(row: dict[str, str]) -> np.ndarray:
    return np.array([float(row[k] or "nan") for k in ("x_mm", "y_mm", "z_mm")])


def _match(row: dict[str, str], truths: tuple[Truth, ...]) -> Truth | None:
    """The nearest damage whose centre is within its radius, at least 12 mm, across the line of
    sight."""
    position = _place(row)
    best = None
    least = math.inf
    for truth in truths:
        centre = 1e3 * np.array(truth.centre_m)
        # an error of the camera's range moves a place along its line of sight
        separation = float(np.hypot(*(position[:2] * centre[2] / position[2] - centre[:2])))
        deep = 0.0 if not math.isfinite(truth.depth_m[1]) else 1e3 * truth.depth_m[1]
        if (
            separation < max(NEAR_MM, 1e3 * truth.radius_m)
            and abs(position[2] - centre[2]) < 50 + deep
            and separation < least
        ):
            best = truth
            least = separation
    return best


def _unmatched(stranger: Stranger, view: CastView, rows: list[dict[str, str]]) -> tuple[int, int]:
    """(findings on another surface than the target, false findings on the target)."""
    cam, (h, w) = stranger.camera, view.on_target.shape
    elsewhere = false = 0
    v, u = np.mgrid[:h, :w]
    for row in rows:
        x, y, z = _place(row) / 1e3
        if any(cam.distortion):
            at_u = float(row["u_px"])
            at_v = float(row["v_px"])
        else:
            at_u = cam.f_px * x / z + cam.cx_px
            at_v = cam.f_px * y / z + cam.cy_px
        nearby = np.hypot(u - at_u, v - at_v) <= RIM_PX
        if stranger.ignored is not None and (nearby & stranger.ignored).any():
            continue
        if (nearby & view.on_object).any() and row["kind"] != "hole":
            continue
        if nearby.any() and not (nearby & view.on_target).any():
            elsewhere += 1
        else:
            false += 1
    return elsewhere, false


def _misjudged(
    stranger: Stranger, rows: list[dict[str, str]], matched: list[Truth | None]
) -> tuple[list[str], bool]:
    """Wrong signs and sizes of the clearly visible damages, each by the strongest finding at its
    place, and whether the flags of each of them warn of a wrong size."""
    why = []
    is_flagged = True
    done = set()
    for row, truth in zip(rows, matched, strict=True):
        if truth is None or not truth.clear or id(truth) in done:
            continue
        done.add(id(truth))
        if row["kind"] != truth.kind and "no return" not in (row["kind"], truth.kind):
            why.append(f"a {row['kind']} where a {truth.kind} is ({_shown(truth)})")
            is_flagged = False
            continue
        before = len(why)
        pitch_mm = 1e3 * truth.centre_m[2] / stranger.camera.f_px
        diameter = float(row["diameter_mm"] or "nan")
        low, high = [1e3 * end_m for end_m in truth.diameter_m]
        slack = PIXELS * pitch_mm
        if diameter < low / FACTOR - slack or diameter > high * FACTOR + slack:
            why.append(f"diameter {diameter:.0f} mm of {low:.0f}..{high:.0f}")
        depth = abs(float(row["depth_mm"] or "nan"))
        low, high = [1e3 * end_m for end_m in truth.depth_m]
        slack = 1e3 * SIGMAS * truth.noise_m
        judged = (
            "no return" not in (row["kind"], truth.kind) and 2e3 * truth.radius_m >= 5 * pitch_mm
        )
        if judged and (depth < low / FACTOR - slack or depth > high * FACTOR + slack):
            why.append(f"depth {depth:.1f} mm of {low:.1f}..{high:.1f}")
        if len(why) > before and not CAUSES & set(row["flags"].split()):
            is_flagged = False
    return why, is_flagged


def _shown(truth: Truth) -> str:
    x, y, z = [1e3 * coordinate_m for coordinate_m in truth.centre_m]
    size = f"{2e3 * truth.radius_m:.0f} mm wide, {1e3 * truth.depth_m[0]:.1f} deep"
    return f"{truth.kind} {size} at {x:.0f} {y:.0f} {z:.0f}"
