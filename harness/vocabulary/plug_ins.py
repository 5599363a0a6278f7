"""Finds built-in and plug-in detectors, cameras and others by name, without importing them."""

import importlib
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import lru_cache
from importlib.metadata import entry_points
from typing import Any

from harness.vocabulary.errors import UserError

OWN = "tofpod"  # name of the package with the built-in parts


@dataclass(frozen=True)
class Offer:
    """A name, its ``target`` (``module:attribute``, or a file for some built-in parts), and the
    package it is from."""

    name: str
    target: str
    package: str
    package_version: str

    @property
    def built_in(self) -> bool:
        """Return whether it comes with tofpod."""
        return self.package == OWN

    @property
    def origin(self) -> str:
        """The package and its version, for messages and tables."""
        return f"{self.package} {self.package_version}".strip()


@dataclass(frozen=True)
class PlugIns:
    """The names of an entry point group. ``noun`` is used in messages, ``fix`` is advice;
    ``built_in`` maps names."""

    group: str
    noun: str
    built_in: Callable[[], Mapping[str, str]]
    fix: str = ""

    def offers(self) -> tuple[Offer, ...]:
        """Return every offer, sorted by name; a name that two packages claim occurs twice."""
        return _offers(self.group, tuple(self.built_in().items()), tuple(sys.path))

    def names(self) -> tuple[str, ...]:
        """Return every known name once, sorted."""
        return tuple(sorted({offer.name for offer in self.offers()}))

    def offer(self, name: str) -> Offer:
        """Find the offer of a name. Raises UserError if the name is unknown (with the nearest
        name) or taken twice."""
        offers = [offer for offer in self.offers() if offer.name == name]
        if not offers:
            from harness.vocabulary.words import nearest

            nearest_name = nearest(name, self.names())
            message = f"there is no {self.noun} {name!r}" + (
                f"; did you mean {nearest_name!r}?" if nearest_name else ""
            )
            fix = self.fix or (
                f"install the package that offers it through the entry point group {self.group!r}"
            )
            raise UserError(message, legal=", ".join(self.names()), fix=fix)
        if len({offer.target for offer in offers}) > 1:
            origins = " and ".join(f"{offer.target} ({offer.origin})" for offer in offers)
            fix = "uninstall all of these packages but one, or rename an entry point"
            raise UserError(f"{len(offers)} {self.noun}s are called {name!r}: {origins}", fix=fix)
        return offers[0]

    def load(self, offer: Offer) -> Any:
        """Import and return an offer's attribute. Raises UserError if a plug-in fails; built-in
        parts must not fail."""
        module, _, attribute = offer.target.partition("[")[0].strip().partition(":")
        try:
            loaded: Any = importlib.import_module(module)
            for part in filter(None, attribute.split(".")):
                loaded = getattr(loaded, part)
            return loaded
        # whatever a foreign module does on import, even sys.exit(), the user must repair or
        # uninstall it
        except (Exception, SystemExit) as error:
            if offer.built_in:
                raise
            raise self.broken(
                offer, f"{type(error).__name__}: {error}", f"python -c 'import {module}'"
            ) from error

    def broken(self, offer: Offer, why: str, command: str = "") -> UserError:
        """Return the error for a plug-in that does not fit its group. ``command`` shows the user
        more."""
        fix = f"repair or uninstall the package {offer.package}" + (
            f"; `{command}` shows more" if command else ""
        )
        message = (
            f"{self.noun} {offer.name!r} ({offer.target}, of the package {offer.origin}) cannot "
            f"be loaded: {why}"
        )
        return UserError(message, fix=fix)


@lru_cache(maxsize=8)
def _offers(
    group: str, built_in: tuple[tuple[str, str], ...], _path: tuple[str, ...]
) -> tuple[Offer, ...]:
    """Return tofpod's own offers and the group's. Cached, since reading every installed package
    takes 7 ms."""
    from harness import __version__

    offers = [Offer(name, target, OWN, __version__) for name, target in built_in]
    for entry in entry_points(group=group):
        origin = entry.dist.name if entry.dist else entry.module
        version = entry.dist.version if entry.dist else ""
        offers.append(Offer(entry.name, entry.value, origin, version))
    return tuple(
        sorted(
            dict.fromkeys(offers), key=lambda offer: (offer.name, not offer.built_in, offer.package)
        )
    )
