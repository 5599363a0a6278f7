"""Common parts of all pages of results: templates, the closing sections, ways to write numbers."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from harness.evaluation.summary import STATES
from harness.tables.text import bounded, mm
from harness.tables.trials import ResultTables
from harness.vocabulary.versions import GENERATOR

if TYPE_CHECKING:
    import pandas as pd
    from jinja2 import Template

MARKS = {"borne out": "✓", "not borne out": "✗", "undecided": "?"}
CLASSES = {"borne out": "yes", "not borne out": "no", "undecided": "open"}
SHOWN_APART = ("command", "seconds", "failures")
"""Keys of the provenance with a section of their own."""


def template(name: str, folder: Path | None = None) -> Template:
    """A template of ``folder``, which may use those of this one, or of this one; a missing name is an error, text is
    escaped."""
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    environment = Environment(
        loader=FileSystemLoader([one for one in (folder, Path(__file__).parent) if one]),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    environment.globals["generator"] = GENERATOR
    return environment.get_template(name)


def closing(tables: ResultTables, provenance: Mapping[str, Any], experiment_yaml_text: str) -> dict[str, Any]:
    """Return the values of the sections from failures to the resolved experiment, and the looks of verdicts."""
    return closing_sections(provenance, experiment_yaml_text, _left_out(tables.runs))


def closing_sections(provenance: Mapping[str, Any], experiment_yaml_text: str, left_out: str = "") -> dict[str, Any]:
    """`closing` without tables; ``left_out``: a sentence on frames that were."""
    return {
        "failures": [_failure(failure) for failure in provenance.get("failures", ())],
        "left_out": left_out,
        "seconds": _seconds(provenance),
        "provenance": _provenance_rows(provenance),
        "command": provenance.get("command", "not recorded"),
        "experiment": experiment_yaml_text,
        "marks": MARKS,
        "classes": CLASSES,
    }


def shade(rate: float) -> str:
    """CSS of a cell: the bluer, the higher the rate."""
    weight = 0.06 + 0.94 * rate
    r, g, b = (round(255 + (channel - 255) * weight) for channel in (0, 94, 156))
    return f"background:rgb({r},{g},{b});color:{'#fff' if rate > 0.72 else '#1d2530'}"


def rate_cell(row: pd.Series) -> dict[str, str]:
    """One detection rate of a summary row: counts, interval, status, a shade of blue, and what the pixels told."""
    rate = float(row["rate"])
    interval = bounded(rate, row["rate_low"], row["rate_high"])
    states = {state: float(row[f"share_{state.replace(' ', '_')}"]) for state in STATES}
    seen = ", ".join(f"{state} {100 * share:.0f} %" for state, share in states.items() if share > 0)
    return {
        "count": f"{row['detected']}/{row['n']}",
        "interval": f"{row['rate_low']:.2f}–{row['rate_high']:.2f}",
        "status": str(row["status"]),
        "style": shade(rate),
        "title": f"{row['status']}: rate {interval}, 95 % Wilson interval. The hole's pixels: {seen or 'unknown'}",
    }


def call_row(row: pd.Series) -> dict[str, str]:
    """A row of `harness.evaluation.summary.false_calls` as text."""
    return {
        "frames": str(row["frames"]),
        "role": "damaged board" if row["role"] == "damaged" else "hole-free board",
        "count": f"{row['false_calls']} in {row['runs']}",
        "rate": bounded(row["per_run"], row["per_run_low"], row["per_run_high"], 3),
        "threshold": f"{row['threshold']:.2f}",
        "threshold_mm": mm(row["threshold_mm"]),
        "quiet": f"{mm(row['quiet_highest'])} ({row['quiet_runs']:.0f} runs)" if row["quiet_runs"] > 0 else "–",
        "noise": mm(row["surface_noise_mm"], 3),
    }


def _failure(failure: Any) -> str:
    """A failure as text; a mapping with ``what`` and ``why`` as one sentence."""
    if isinstance(failure, Mapping) and set(failure) == {"what", "why"}:
        return f"{failure['what']}: {failure['why']}"
    return _plain(failure)


def _left_out(runs: pd.DataFrame) -> str:
    """Number of frames that averaging left out as disturbed, over all runs, as a sentence."""
    out, used = int(runs["left_out"].sum()), int(runs["frames_used"].sum())
    return f"{out} of {out + used} frames were left out of an average as disturbed." if out else ""


def _seconds(provenance: Mapping[str, Any]) -> list[tuple[str, str, float]]:
    """(stage, seconds as text, share of the longest in per cent)."""
    seconds = {stage: float(value) for stage, value in dict(provenance.get("seconds", {})).items()}
    longest = max(seconds.values(), default=0.0) or 1.0
    return [(stage, f"{value:.1f}", round(100 * value / longest, 1)) for stage, value in seconds.items()]


def _provenance_rows(provenance: Mapping[str, Any]) -> list[tuple[str, str]]:
    expected = (
        "commit",
        "dirty",
        "seed",
        "started",
        "machine",
        "mitsuba_variant",
        "indirect_noise_mm",
        "renders",
        "versions",
    )
    others = [key for key in provenance if key not in expected and key not in SHOWN_APART]
    return [
        (key.replace("_mm", " (mm)").replace("_", " "), _plain(provenance.get(key, "not recorded")))
        for key in (*expected, *others)
    ]


def _plain(value: Any) -> str:
    """A recorded value as text: yes and no, ``name: value`` pairs, lists; never Python's own notation."""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, Mapping):
        return ", ".join(f"{key}: {_plain(part)}" for key, part in value.items())
    if isinstance(value, (list, tuple)):
        return ", ".join(_plain(part) for part in value) or "none"
    if value is None:
        return "not recorded"
    return value if isinstance(value, str) else json.dumps(value, default=str)
