"""Rows of the tables on the page of several views, as text."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from harness.evaluation.maps import (
    AgainstOne,
    MapCase,
    MapSetUp,
    against_one,
    change_text,
    label_of,
    maps_of,
    ratio_text,
    span,
)
from harness.evaluation.registration import PARTS, trusted
from harness.evaluation.summary import hole_list
from harness.report.page_parts import shade
from harness.report.set_ups_rows import count_text, found_text, limit_text
from harness.tables.text import bounded, mm
from harness.tables.trials import ResultTables

if TYPE_CHECKING:
    import pandas as pd

Row = Mapping[str, Any]


@dataclass(frozen=True)
class Ways:
    """The set-ups by way of making a map (down) and number of views (across).

    ``views``: numbers of views, ascending. ``rows``: the way in words -> variant by number of views. ``shown_frames``:
    the least and the most frames a view. ``several_places``: whether a way's words name a place too.
    """

    views: tuple[int, ...]
    rows: Mapping[str, Mapping[int, str]]
    shown_frames: tuple[int, ...]
    several_places: bool

    @staticmethod
    def of(tables: ResultTables, compared: pd.DataFrame) -> Ways:
        """The layout of an experiment's set-ups, variations left out."""
        set_ups = [one for one in maps_of(tables) if not one.is_variation]
        places = {one.place for one in set_ups}
        rows: dict[str, dict[int, str]] = {}
        for one in set_ups:
            rows.setdefault(_way(one, len(places) > 1), {})[one.views] = one.variant
        own = compared[~compared["is_variation"]] if len(compared) else compared
        frames = sorted(int(n) for n in own["frames"].unique()) if len(own) else []
        shown = tuple(dict.fromkeys([*frames[:1], *frames[-1:]]))
        return Ways(tuple(sorted({one.views for one in set_ups})), rows, shown, len(places) > 1)

    def table(self, compared: pd.DataFrame, frames: int, cell: Callable[[Row | None], Any]) -> list[dict[str, Any]]:
        """One row for each way with a cell for each number of views, made of the row of ``compared`` or of None."""
        there = {(row["variant"], row["frames"]): row for row in records(compared)}
        return [
            {"name": name, "cells": [cell(there.get((variants.get(n), frames))) for n in self.views]}
            for name, variants in self.rows.items()
        ]


def records(table: pd.DataFrame) -> list[dict[str, Any]]:
    """The rows of a table as mappings."""
    return [{str(key): value for key, value in row.items()} for row in table.to_dict("records")]


def found_cell(row: Row | None) -> dict[str, str]:
    """What one map finds, the bluer the more."""
    if row is None:
        return {"count": "–", "found": "", "style": "", "title": "not finished"}
    return {
        "count": count_text(row),  # type: ignore[arg-type]
        "found": found_text(row),  # type: ignore[arg-type]
        "style": shade(len(row["found"]) / row["holes"]),
        "title": f"all found from {limit_text(row)} on" if np.isfinite(row["limit_mm"]) else "none found",  # type: ignore[arg-type]
    }


def call_cell(row: Row | None) -> tuple[str, str]:
    """Threshold in mm (k), and false calls on the damaged board."""
    if row is None or not np.isfinite(row["runs"]):
        return "–", ""
    return f"{mm(row['threshold_mm'])} ({mm(row['threshold'], 1)})", f"{int(row['false_calls'])} in {int(row['runs'])}"


def time_cell(row: Row | None) -> tuple[str, str]:
    """Seconds of making the map, and views that a failed registration left out."""
    if row is None:
        return "–", ""
    left_out = row["views_left_out"]
    return mm(row["seconds_map"]), f"{left_out:.2f} left out" if left_out > 0 else ""


def noise_cell(row: Row | None) -> tuple[str, str]:
    """Temporal noise and systematic error at fixed places, and the noise of the fitted surface."""
    if row is None:
        return "–", ""
    systematic = float(np.hypot(row["offset_mm"], row["pattern_mm"]))
    return f"{mm(row['temporal_mm'], 3)}; {mm(systematic, 3)}", mm(row["surface_mm"], 3)


def registration_rows(summary: pd.DataFrame) -> list[dict[str, Any]]:
    """Of `harness.evaluation.registration.summarise_registrations`."""
    rows = []
    for row in records(summary):
        text: dict[str, Any] = {
            "method": row["method"],
            "frames": row["frames"],
            "n": row["n"],
            "failed": f"{row['failed']} ({100 * row['failed_low']:.0f}–{100 * row['failed_high']:.0f} %)",
            "reasons": row["reasons"],
            "guess": mm(row["guess_mm"], 1),
            "seconds": f"{1000 * row['seconds']:.1f}" if np.isfinite(row["seconds"]) else "–",
        }
        for part in PARTS:
            text[part] = f"{mm(row[f'{part}_median_mm'])}; {mm(row[f'{part}_q90_mm'])}"
            text[f"{part}_rms"] = f"{mm(row[f'{part}_rms_mm'])}; {mm(row[f'{part}_predicted_mm'])}"
            text[f"{part}_ratio"] = bounded(
                row[f"{part}_ratio"], row[f"{part}_ratio_low"], row[f"{part}_ratio_high"], 2
            )
        rows.append(text)
    return rows


def by_views_rows(summary: pd.DataFrame, views: Sequence[int], frames: int) -> list[dict[str, Any]]:
    """Root mean square errors by method (down) and number of views (across), of `registration.by_views`."""
    rows = records(summary[summary["frames"] == frames])
    there = {(row["method"], row["views"]): row for row in rows}
    return [
        {"name": method, "cells": [_pair(there.get((method, n))) for n in views if n > 1]}
        for method in dict.fromkeys(row["method"] for row in rows)
    ]


def against_rows(cases: Sequence[MapCase]) -> list[dict[str, str]]:
    """Two views against one for every way of making a map, with the most frames, by both measures."""
    rows = []
    for case in cases:
        ways = dict.fromkeys((one.registration, one.merge) for one in case.set_ups if one.views == 2)
        for registration, merge in ways:
            found, model = (against_one(case, registration, merge, measure=m) for m in ("extent", "model"))
            if found is None or model is None:
                continue
            name = label_of(registration, merge, case.place)
            rows.append({"name": name} | _against(found, model))
    return rows


def variation_rows(tables: ResultTables, compared: pd.DataFrame) -> list[dict[str, Any]]:
    """The sensitivity study: each variation beside the set-up that it changes, which may have other frames."""
    there: dict[str, list[dict[str, Any]]] = {}
    for row in records(compared):
        there.setdefault(str(row["variant"]), []).append(row)
    rows = []
    for variant in records(tables.variants[tables.variants["is_variation"].astype(bool)]):
        name, reference = str(variant["variant"]), str(variant["reference"])
        lines = [_line(row, there.get(reference, [])) for row in there.get(name, [])]
        rows.append(
            {
                "name": name,
                "reason": variant["reason"],
                "settings": variant["settings"],
                "reference": reference,
                "lines": lines,
                "registered": _registered(tables.registrations, name),
            }
        )
    return rows


def _line(row: Row, others: Sequence[Row]) -> dict[str, Any]:
    """One number of frames of a variation, beside its set-up's with as many, else with the most that it has."""
    alike = [other for other in others if other["frames"] == row["frames"]]
    other = (alike or list(others))[-1] if others else None
    changed = other is not None and (row["found"], row["undecided"]) != (other["found"], other["undecided"])
    return {"mine": _said(row), "usual": _said(other), "changed": changed}


def _said(row: Row | None) -> dict[str, str]:
    if row is None:
        return dict.fromkeys(("what", "count", "found", "threshold", "surface", "size", "place"), "–")
    views = f"{row['views']} view{'s' if row['views'] != 1 else ''}"
    return {
        "what": f"{views} × {row['frames']} frame{'s' if row['frames'] > 1 else ''}",
        "count": count_text(row),  # type: ignore[arg-type]
        "found": found_text(row),  # type: ignore[arg-type]
        "threshold": mm(row["threshold_mm"]),
        "surface": mm(row["surface_mm"], 3),
        "size": _error(row, "extent"),
        "place": _error(row, "extent_place"),
    }


def _error(row: Row, name: str) -> str:
    if not row[f"{name}_n"]:
        return "–"
    std = f" ± {row[f'{name}_std_mm']:.2f}" if np.isfinite(row[f"{name}_std_mm"]) else ""
    return f"{row[f'{name}_bias_mm']:+.2f}".replace("-", "−") + std


def _registered(registrations: pd.DataFrame, variant: str) -> str:
    """Median errors of a variation's own registrations; empty where it shares those of a set-up."""
    rows = registrations[registrations["variant"] == variant]
    if rows.empty:
        return ""
    good = trusted(rows)
    plane, across = (float(good[f"tre_{part}_mm"].median()) for part in PARTS)
    return f"{mm(plane)} in the plane, {mm(across)} across; {len(rows) - len(good)} of {len(rows)} failed"


def _against(found: AgainstOne, model: AgainstOne) -> dict[str, str]:
    crossing = f"{found.sizes.crossing_mm:.1f} ({span(found.sizes.crossing_interval, 1)})"
    return {
        "large": change_text(found.large, ""),
        "small": change_text(found.small, ""),
        "model_large": change_text(model.large, ""),
        "model_small": change_text(model.small, ""),
        "crossing": crossing if np.isfinite(found.sizes.crossing_mm) else "none",
        "threshold": change_text(found.threshold, ""),
        "noise": ratio_text(found.noise),
        "lost": hole_list(found.lost),
        "gained": hole_list(found.gained),
    }


def _pair(row: Row | None) -> str:
    return "–" if row is None else f"{mm(row['in_plane_rms_mm'])}; {mm(row['across_rms_mm'])}"


def _way(one: MapSetUp, with_place: bool) -> str:
    return label_of(one.registration, one.merge, one.place if with_place else "")
