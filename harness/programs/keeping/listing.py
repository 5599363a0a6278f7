"""Finds what `tofpod ls` lists and `tofpod clean` removes: tofpod's own entries in ``--results``,
never behind a link."""

import contextlib
import csv
import inspect
import io
import os
import re
from collections.abc import Iterator, Mapping, Sequence
from math import isfinite
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from detectors import DETECTORS, detector_type, load_detector
from detectors.filters import FILTERS, filter_settings_type, load_filter
from detectors.sources import SOURCES
from harness.programs.keeping.written_files import is_output
from harness.records.outputs import EXPERIMENT, JOURNAL, LATEST, LOCK_NAME, PROVENANCE, RUN_NAME
from harness.runs.journal import SEGMENT_NAME, Journal
from harness.runs.results_folder import EXPERIMENT_NAME, folders_in, latest_run
from harness.runs.shards import LOCK
from harness.vocabulary import system
from harness.vocabulary.declaration.shape import (
    Declared,
    default_at,
    every_key,
    get,
    kinds_of,
    legal_at,
    plain,
)
from harness.vocabulary.declaration.yaml_source import read_yaml
from harness.vocabulary.errors import UserError
from harness.vocabulary.files import TEXT_BYTES, bounded_bytes, opened_lock, strict_json
from harness.vocabulary.path_names import names_of, value_text
from harness.vocabulary.plug_ins import Offer, PlugIns
from harness.vocabulary.provenance import RESULTS_VERSION
from harness.vocabulary.seeds import canonical_json
from harness.vocabulary.text import Grid, many
from scenes.render.cache import StoredFile, leftovers, longest_unused, stored_renders
from scenes.sensor.camera import CAMERAS, load_camera, number_paths

Row = Mapping[str, Any]
SETTABLE = {
    "detectors": "settings",
    "filters": "settings",
    "cameras": "numbers",
    "sources": "settings",
}  # kinds of offers, and what can be set for each


def plug_ins(kind: str) -> PlugIns:
    """Return the detectors, the filters, the cameras, or the sources of frames."""
    return {
        "detectors": DETECTORS,
        "filters": FILTERS,
        "cameras": CAMERAS,
        "sources": SOURCES,
    }[kind]


def offered(kind: str) -> list[Row]:
    """Return a row for each offer; that of an unusable offer has ``broken`` with the reason, and
    ``fix``."""
    rows: list[Row] = []
    for offer in plug_ins(kind).offers():
        try:
            rows.append({**_origin(offer), **_facts(kind, offer.name)})
            continue
        except UserError as error:
            mistake = error
        except (Exception, SystemExit) as error:
            if offer.built_in:
                raise
            mistake = plug_ins(kind).broken(offer, f"{type(error).__name__}: {error}")
        rows.append({**_origin(offer), "broken": mistake.message, "fix": mistake.fix})
    return rows


def shown(kind: str, name: str) -> Row:
    """Return an offer's row with all of its settings. Raises UserError if it is unknown, ambiguous
    or broken."""
    settable = []
    if kind == "cameras":
        settable = _numbers(name)
    elif kind != "sources":
        settable = _declared_settings(kind, name)
    return {**_origin(plug_ins(kind).offer(name)), **_facts(kind, name), SETTABLE[kind]: settable}


def grid_of(kind: str, rows: Sequence[Row]) -> Grid:
    """Return a table of rows of offers."""
    heads: tuple[str, ...] = ("pixels", "range", "light", "title")
    if kind != "cameras":
        heads = ("version", "what it does")
    lines = []
    for row in rows:
        cells: tuple[Any, ...] = (row.get("version") or "-", row.get("about", ""))
        if "title" in row:
            nearest_m = row["nearest_m"]
            far = row["farthest_m"]
            reach = f"from {nearest_m:.4g} m" if far is None else f"{nearest_m:.4g} to {far:.4g} m"
            cells = (
                f"{row['columns']} x {row['rows']}",
                reach,
                f"{row['wavelength_nm']:.4g} nm",
                row["title"],
            )
        if "broken" in row:
            cells = ("-",) * (len(heads) - 1) + (f"broken: {row['broken']}",)
        lines.append((row["name"], f"{row['package']} {row['package_version']}".strip(), *cells))
    return Grid.of(("name", "package", *heads), lines, left=2 + len(heads))


def _origin(offer: Offer) -> Row:
    return {"name": offer.name, "package": offer.package, "package_version": offer.package_version}


def _facts(kind: str, name: str) -> Row:
    if kind == "detectors":
        loaded = detector_type(name)
        try:
            version = load_detector(name, {}).version
        except UserError:  # not known without settings
            version = None
        return {
            "version": version,
            "about": (inspect.getdoc(loaded) or "").strip().partition("\n")[0],
        }
    if kind == "filters":
        return _facts_of_filter(name)
    if kind == "sources":
        about = inspect.getdoc(SOURCES.load(SOURCES.offer(name))) or ""
        return {"version": None, "about": about.strip().partition("\n")[0]}
    camera = load_camera(name)
    optics = camera.optics
    return {
        "title": camera.title,
        "columns": optics.lens.width,
        "rows": optics.lens.height,
        "nearest_m": optics.nearest_m,
        "farthest_m": optics.farthest_m if isfinite(optics.farthest_m) else None,
        "wavelength_nm": optics.wavelength_nm,
    }


def _facts_of_filter(name: str) -> Row:
    """Return the facts of a filter. Raises UserError if it cannot be used."""
    filter_settings_type(name)
    documentation = inspect.getdoc(FILTERS.load(FILTERS.offer(name))) or ""
    version = None
    with contextlib.suppress(UserError):  # not known without settings
        version = load_filter(name, {}).version
    return {"version": version, "about": documentation.strip().partition("\n")[0]}


def _declared_settings(kind: str, name: str) -> list[dict[str, Any]]:
    """Return every setting of a detector or filter with default and legal values; of several
    kinds, only the settings of the default kind."""
    settings_type = _settings_type(kind, name)
    try:
        defaults = settings_type().to_data()
    except ValidationError as error:
        lacking = ", ".join(".".join(map(str, error["loc"])) for error in error.errors())
        raise UserError(
            f"{plug_ins(kind).noun} {name!r} has settings without a default: {lacking}"
        ) from error
    declared = Declared(settings_type, defaults, {})

    def legal(path: tuple[str, ...]) -> str:
        around = kinds_of(declared.at(path[:-1]))
        if around is not None and around[0] == path[-1]:
            return "one of " + ", ".join(around[1])
        return legal_at(declared.at(path)) or ""

    return [
        {"path": ".".join(path), "value": value, "about": legal(path)}
        for path, value in leaves(defaults)
    ]


def _settings_type(kind: str, name: str) -> Any:
    """Return the declaration of a detector's or filter's settings."""
    return filter_settings_type(name) if kind == "filters" else detector_type(name).settings_type


def _numbers(name: str) -> list[dict[str, Any]]:
    """Return every number of the camera's file with its tag and source."""
    data = load_camera(name).to_data()
    numbers = {path: get(data, tuple(path.split("."))) for path in number_paths(data)}
    return [
        {"path": path, "value": n["value"], "about": f"{n['tag']}: {n['source']}"}
        for path, n in numbers.items()
    ]


def leaves(
    data: Mapping[str, Any], path: tuple[str, ...] = ()
) -> Iterator[tuple[tuple[str, ...], Any]]:
    """Yield (path, value) of the leaves of nested mappings; an empty mapping is a leaf."""
    for key, value in data.items():
        if isinstance(value, dict) and value:
            yield from leaves(value, (*path, key))
        else:
            yield (*path, key), value


def reference() -> str:
    """Return every key of an experiment and of tofpod's detectors and filters in Markdown: legal
    values, default, meaning."""
    from harness.experiment.schema import ExperimentConfig

    sections = {"Experiments": every_key(ExperimentConfig)}
    for kind in ("detectors", "filters"):
        for offer in plug_ins(kind).offers():
            if offer.built_in:
                title = f"Settings of the {plug_ins(kind).noun} `{offer.name}`"
                sections[title] = every_key(_settings_type(kind, offer.name))
    lines = [
        "# Every key",
        "",
        "`key[]` is an item of a list; `key[kind=blind]` holds where `kind` is `blind`.",
    ]
    for title, keys in sections.items():
        lines += ["", f"## {title}"]
        rows_by_section: dict[str, list[str]] = {}
        for path, slot, model in keys:
            section, _, key = path.rpartition(".")
            default = default_at(slot)
            note = (slot.field.description if slot.field else "") or ""
            legal = (
                "a mapping"
                if slot.models
                else (legal_at(slot) or "any value").removesuffix(f" ({note})")
            )
            cells = f"`{key}`", legal, plain(default[0]) if default else "required", note
            row = "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"
            head = (
                inspect.cleandoc(model.__doc__ or ""),
                "",
                "| key | legal | default | meaning |",
                "|---|---|---|---|",
            )
            rows_by_section.setdefault(section, [*head]).append(row)
        for section, rows in rows_by_section.items():
            lines += ["", *([f"### `{section}`", ""] if section else []), *rows]
    return "\n".join(lines)


# ---------------------------------------------------------------- results


SHOWN_SETTINGS = 6


def result_folders(out: Path, experiment: str | None = None) -> list[dict[str, Any]]:
    """Return `described` for every folder, with its ``limits``, the settings in which it
    ``differs``, ``is_latest``."""
    described_runs = []
    for parent in folders_in(out, EXPERIMENT_NAME):
        if experiment is not None and parent.name != experiment:
            continue
        runs = folders_in(parent, RUN_NAME)
        settings = {run: _settings(run) for run in runs} if len(runs) > 1 else {}
        known_settings = [setting for setting in settings.values() if setting]
        paths = dict.fromkeys(path for setting in known_settings for path in setting)
        differing_paths = [
            path
            for path in paths
            if len({canonical_json(setting.get(path)) for setting in known_settings}) > 1
        ]
        newest = latest_run(parent)
        for run in runs:
            run_settings = settings.get(run)
            differs = (
                {path: run_settings.get(path) for path in differing_paths} if run_settings else {}
            )
            described_runs.append(
                described(run)
                | {"limits": _limits(run), "differs": differs, "is_latest": run.name == newest}
            )
    return described_runs


def limit_text(limits: list[dict[str, Any]]) -> str:
    """Return the detection limit with its set-up, or the range of several limits; "" if there is
    no study."""
    demonstrated = [
        row for row in limits if row["a90_95_mm"] is not None and row["verdict"] == "demonstrated"
    ]
    if not demonstrated:
        return "a90/95 not demonstrated" if limits else ""
    demonstrated.sort(key=lambda row: row["a90_95_mm"])
    ends = [demonstrated[0], *demonstrated[1:][-1:]]
    missing = len(limits) - len(demonstrated)
    beside = f"; not demonstrated by {missing} of {len(limits)} set-ups" if missing else ""
    return (
        "a90/95 "
        + " to ".join(f"{row['a90_95_mm']:.2f} mm ({row['set_up']})" for row in ends)
        + beside
    )


def differs_text(differs: dict[str, Any]) -> str:
    """Return at most `SHOWN_SETTINGS` settings in which a run differs from others of its
    experiment."""
    names = names_of(differs)
    parts = [f"{names[path]}={value_text(path, value)}" for path, value in differs.items()]
    hidden_count = len(parts) - SHOWN_SETTINGS
    return ", ".join(parts[:SHOWN_SETTINGS]) + (
        f" and {hidden_count} more" if hidden_count > 0 else ""
    )


def _settings(run: Path) -> dict[str, Any]:
    """Return every setting of a run's resolved experiment by its dotted path; empty if it cannot
    be read."""
    try:
        settings = {
            ".".join(path): value for path, value in leaves(read_yaml(run / EXPERIMENT.name).data)
        }
        canonical_json(settings)
    except (UserError, ValueError, OSError, TypeError, AttributeError):
        return {}
    return settings


def _limits(run: Path) -> list[dict[str, Any]]:
    """Return the detection limits of a study; empty if there are none or they cannot be read."""
    rows = []
    try:
        for row in csv.DictReader(
            io.StringIO(bounded_bytes(run / "limits.csv", TEXT_BYTES).decode())
        ):
            size = row["a90_95_mm"]
            names = {"set_up": row["set_up"][:60], "verdict": row["a90_95_verdict"][:40]}
            if not all(word.isprintable() for word in names.values()):
                return []
            rows.append({**names, "a90_95_mm": float(size) if size else None})
    except (UserError, OSError, ValueError, KeyError, TypeError, csv.Error):
        return []
    return rows


def _count_in(trials: Mapping[str, Any], name: str) -> int:
    """Return a number of trials in a provenance; 0 where it is missing or not a number."""
    count = trials.get(name)
    return count if type(count) is int and count >= 0 else 0


def described(run: Path) -> dict[str, Any]:
    """Describe a results folder as JSON types. ``state`` is complete, unfinished, running or
    broken."""
    row: dict[str, Any] = {
        "path": run.as_posix(),
        "experiment": run.parent.name,
        "digest": run.name,
        "state": "broken",
    }
    row |= {"note": "", "size_bytes": folder_bytes(run), "date": None}
    try:
        facts = strict_json(bounded_bytes(run / PROVENANCE.name, TEXT_BYTES), nan=True)
        if not isinstance(facts, dict):
            raise ValueError("is no provenance")
    except FileNotFoundError:  # the run is not finished
        records = 0
        # written by a newer tofpod, or reached through a link
        with contextlib.suppress(UserError):
            records = len(Journal(run / "journal"))
        if not records and not (run / EXPERIMENT.name).is_file():
            return row | {"note": "broken: it has neither an experiment nor records"}
        state = "running" if in_use(run) else "unfinished"
        return row | {"state": state, "note": f"{state}: {many(records, 'record')}"}
    except (UserError, ValueError, OSError) as error:
        return row | {"note": f"broken: provenance.json: {error}"}
    trials = facts.get("trials")
    trials = trials if isinstance(trials, dict) else {}
    done = _count_in(trials, "done")
    resumed = _count_in(trials, "resumed")
    failed = _count_in(trials, "failed")
    if in_use(run):
        state = "running"
    elif failed:
        state = "unfinished"
    else:
        state = "complete"
    note = f"{state}: {many(done + resumed, 'trial')}" + (f", {failed} failed" if failed else "")
    version = facts.get("results_version")
    started = facts.get("started")
    if type(version) is int and version != RESULTS_VERSION:
        note += f" (results version {version}, this tofpod writes {RESULTS_VERSION})"
    date = started[:40] if isinstance(started, str) and started.isprintable() else None
    return row | {"state": state, "note": note, "date": date}


def results_bytes(out: Path) -> list[int]:
    """Return the size of every results folder in bytes."""
    parents = folders_in(out, EXPERIMENT_NAME)
    return [folder_bytes(run) for parent in parents for run in folders_in(parent, RUN_NAME)]


def folder_bytes(folder: Path) -> int:
    """Return the size of all files below a folder; those that vanish meanwhile count nothing."""
    size_bytes = 0
    for path in files_below(folder):
        with contextlib.suppress(OSError):
            size_bytes += path.lstat().st_size
    return size_bytes


def in_use(run: Path) -> bool:
    """Return whether a sweep is running in this folder; False if the system has no locks."""
    try:
        if not (run / LOCK).is_file():
            return False
        with opened_lock(run / LOCK) as file:
            return system.lock(file, shared=False, wait=False) == "busy"
    except (OSError, UserError):
        return False


def files_below(folder: Path) -> Iterator[Path]:
    """Yield all files and links below a folder; links are not followed."""
    return (Path(inner, name) for inner, _, names in os.walk(folder) for name in names)


# ---------------------------------------------------------------- removal

UNFINISHED = re.compile(
    r"^\.(.+)\.\w{8}\.part(\.\w+)$"
)  # name of a file that a killed process was writing


def refuse_links(*paths: Path) -> None:
    """Raise UserError if a path is a link."""
    for path in paths:
        if path.is_symlink():
            fix = "remove it there by hand"
            raise UserError(
                f"{path}: is a link to another place, from which nothing is removed", fix=fix
            )


def cache_removal(folder: Path, limit_bytes: int | None) -> list[StoredFile]:
    """Return the longest unused renders to remove so that the rest fits the limit, and leftovers;
    None: all of both."""
    if limit_bytes is None:
        return stored_renders(folder) + leftovers(folder, 0.0)
    return longest_unused(stored_renders(folder), limit_bytes, ()) + leftovers(folder)


def chosen_results(out: Path, name: str) -> list[Path]:
    """Return the results folders named ``NAME`` or ``NAME/DIGEST``. Raises UserError if there are
    none."""
    experiment, slash, digest = name.partition("/")
    if not EXPERIMENT_NAME.fullmatch(experiment) or (slash and not RUN_NAME.fullmatch(digest)):
        legal = "NAME or NAME/DIGEST, as tofpod ls results shows them"
        raise UserError(f"{name!r} is not the name of any results", legal=legal)
    parent = Path(out) / experiment
    refuse_links(parent, parent / digest)
    folders = [path for path in folders_in(parent, RUN_NAME) if digest in ("", path.name)]
    for folder in folders or [parent / digest]:
        if not _is_declared(folder):
            raise UserError(
                f"{folder}: is not a results folder", fix="see the list of tofpod ls results"
            )
    return folders


def oldest_results(out: Path, experiment: str, limit_bytes: int) -> list[Path]:
    """Return the results folders, of one experiment or ("") of all, to remove so that the rest
    fits the limit: those written longest ago first. Folders of running sweeps stay, but count.
    Raises UserError as `chosen_results` does for a named experiment."""
    if experiment:
        folders = chosen_results(out, experiment)
    else:
        parents = folders_in(out, EXPERIMENT_NAME)
        inside = [folder for parent in parents for folder in folders_in(parent, RUN_NAME)]
        folders = [folder for folder in inside if _is_declared(folder)]
    wholes = []
    for folder in folders:
        files = removable(folder)
        size_bytes = sum(file.size_bytes for file in files)
        # looking into a folder writes its locks
        times_s = [file.used_s for file in files if not LOCK_NAME.fullmatch(file.path.name)]
        written_s = max(times_s, default=0.0)
        wholes.append(StoredFile(folder, size_bytes, written_s))
    running = [folder for folder in folders if in_use(folder)]
    return [whole.path for whole in longest_unused(wholes, limit_bytes, running)]


def _is_declared(folder: Path) -> bool:
    """Return whether a folder holds a declaration, which every sweep writes first, and whose first
    line identifies tofpod."""
    declared = folder / EXPERIMENT.name
    return declared.is_file() and bounded_bytes(declared, TEXT_BYTES).startswith(
        b"# tofpod experiment "
    )


def removable(folder: Path) -> list[StoredFile]:
    """Return the files of a results folder that tofpod wrote, with locks last."""
    files = []
    for path in sorted(
        files_below(folder), key=lambda path: LOCK_NAME.fullmatch(path.name) is not None
    ):
        above = path.parent.relative_to(folder)
        name = UNFINISHED.sub(r"\1\2", path.name)
        own_files = {
            Path(): is_output(name, "results") or LOCK_NAME.fullmatch(name),
            Path(JOURNAL): SEGMENT_NAME.fullmatch(name),
        }.get(above, re.fullmatch(r"point-[0-9]{3,6}", str(above)) and is_output(name, "capture"))
        if own_files and not path.is_symlink():
            files.append(StoredFile(path, path.lstat().st_size, path.lstat().st_mtime))
    return files


def remove_empty(folder: Path) -> None:
    """Remove a results folder if nothing is left in it, and ``latest`` if it pointed to it."""
    for inner, _, _ in os.walk(folder, topdown=False):
        with contextlib.suppress(OSError):
            os.rmdir(inner)
    if not folder.exists() and latest_run(folder.parent) == folder.name:
        (folder.parent / LATEST).unlink()
    with contextlib.suppress(OSError):
        folder.parent.rmdir()
