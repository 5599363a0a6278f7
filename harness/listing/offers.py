"""Detectors and cameras, tofpod's own and those that installed packages offer, with all that can be set of each."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from harness.vocabulary.errors import UserError
from harness.vocabulary.plug_ins import Offer, PlugIns

if TYPE_CHECKING:
    from harness.vocabulary.config import Config
    from harness.vocabulary.declaration.shape import Declared

Row = Mapping[str, Any]


@dataclass(frozen=True)
class Offers:
    """One kind of thing. ``facts`` of a name that can be loaded; ``text`` of these facts for a table; ``settable`` of a
    name: path, value, and what is legal or where the value comes from."""

    plug_ins: Callable[[], PlugIns]
    facts: Callable[[str], Row]
    text: Callable[[Row], tuple[str, ...]]
    settable: Callable[[str], list[dict[str, Any]]]
    settable_title: str

    def rows(self) -> list[Row]:
        """One row per offer; what cannot be used has ``broken``, which says why, and ``fix``."""
        return [self._row(offer) for offer in self.plug_ins().offers()]

    def _row(self, offer: Offer) -> Row:
        try:
            return {**_origin(offer), **self.facts(offer.name)}
        except UserError as mistake:
            return _broken(offer, mistake)
        except (Exception, SystemExit) as error:
            if offer.built_in:
                raise
            return _broken(offer, self.plug_ins().broken(offer, f"{type(error).__name__}: {error}"))

    def shown(self, name: str) -> Row:
        """One row with all that can be set. Raises UserError where the name is unknown, taken twice or broken."""
        row = {**_origin(self.plug_ins().offer(name)), **self.facts(name)}
        return {**row, self.settable_title: self.settable(name)}

    def cells(self, row: Row) -> tuple[str, ...]:
        """The row as text."""
        head = (row["name"], f"{row['package']} {row['package_version']}".strip())
        return (*head, f"broken: {row['broken']}") if "broken" in row else (*head, *self.text(row))


def _broken(offer: Offer, mistake: UserError) -> Row:
    return {**_origin(offer), "broken": mistake.message, "fix": mistake.fix}


def _origin(offer: Offer) -> Row:
    return {"name": offer.name, "package": offer.package, "package_version": offer.package_version}


def _detectors() -> PlugIns:
    from detectors import DETECTORS

    return DETECTORS


def _detector_facts(name: str) -> Row:
    """Version (None where it is not known without settings), what it is in one line, whether it tests the harness."""
    import inspect

    from detectors import detector_type, load_detector

    kind = detector_type(name)
    try:
        version = load_detector(name, {}).version
    except UserError:
        version = None
    about = (inspect.getdoc(kind) or "").strip().partition("\n")[0]
    return {"version": version, "about": about, "tests_the_harness": bool(getattr(kind, "tests_the_harness", False))}


def _detector_text(row: Row) -> tuple[str, ...]:
    mark = "(tests the harness, finds no damage) " if row["tests_the_harness"] else ""
    version = "" if row["version"] is None else f"version {row['version']}"
    return (version, f"{mark}{row['about']}")


def _detector_settings(name: str) -> list[dict[str, Any]]:
    """Every setting with its default. Of a setting that is one of several kinds, those of the default's kind."""
    from pydantic import ValidationError

    from detectors import detector_type
    from harness.vocabulary.declaration.shape import Declared

    settings_type: type[Config] = detector_type(name).settings_type
    try:
        defaults = settings_type().to_data()
    except ValidationError as error:
        lacking = ", ".join(".".join(map(str, one["loc"])) for one in error.errors())
        raise UserError(f"detector {name!r} has settings without a default: {lacking}") from error
    declared = Declared(settings_type, defaults, {})
    return [
        {"path": ".".join(path), "value": value, "about": _legal(declared, path)} for path, value in _leaves(defaults)
    ]


def _legal(declared: Declared, path: tuple[str, ...]) -> str:
    """Legal values of a setting; all kinds of a setting that chooses a kind."""
    from harness.vocabulary.declaration.shape import kinds_of, legal_at

    around = kinds_of(declared.at(path[:-1]) or {})
    if around is not None and around[0] == path[-1]:
        return "one of " + ", ".join(around[1])
    return legal_at(declared.at(path)) or ""


def _leaves(data: Mapping[str, Any], path: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], Any]]:
    for key, value in data.items():
        if isinstance(value, dict) and value:
            yield from _leaves(value, (*path, key))
        else:
            yield (*path, key), value


def _cameras() -> PlugIns:
    from scenes.sensor.camera import CAMERAS

    return CAMERAS


def _camera_facts(name: str) -> Row:
    """Title, grid, limits of range and wavelength."""
    from math import isfinite

    from scenes.sensor.camera import load_camera

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


def _camera_text(row: Row) -> tuple[str, ...]:
    near, far = row["nearest_m"], row["farthest_m"]
    reach = f"from {near:.4g} m" if far is None else f"{near:.4g} to {far:.4g} m"
    return (f"{row['columns']} x {row['rows']} px", reach, f"{row['wavelength_nm']:.4g} nm", row["title"])


def _camera_numbers(name: str) -> list[dict[str, Any]]:
    """Every number of the camera's file with its tag and source."""
    from harness.vocabulary.declaration.shape import get
    from scenes.sensor.camera import load_camera, number_paths

    data = load_camera(name).to_data()
    numbers = {path: get(data, tuple(path.split("."))) for path in number_paths(data)}
    return [
        {"path": path, "value": one["value"], "about": f"{one['tag']}: {one['source']}"}
        for path, one in numbers.items()
    ]


OFFERS = {
    "detectors": Offers(_detectors, _detector_facts, _detector_text, _detector_settings, "settings"),
    "cameras": Offers(_cameras, _camera_facts, _camera_text, _camera_numbers, "numbers"),
}
