"""Which albedo counts: declarations hold those at 850 nm, and others where a camera works elsewhere."""

from __future__ import annotations

from typing import Any

from harness.vocabulary.errors import UserError
from scenes.target.custom import TargetConfig, WavelengthConfig

NEAR_NM = 20.0
"""An albedo holds this far around its wavelength: reflectances of wood and paint change by a per cent or two over it in
the near infrared (a guess), less than what the albedo itself is known to."""


def at_wavelength(config: TargetConfig, wavelength_nm: float) -> TargetConfig:
    """The declaration with the nearest albedos to that wavelength as its ``albedo_850``, and no others.

    Raises UserError where the declaration has none for it, or lacks one of its surfaces.
    """
    near = [one for one in config.other_wavelengths if abs(one.wavelength_nm - wavelength_nm) <= NEAR_NM]
    at_850 = abs(wavelength_nm - 850.0)
    if at_850 <= NEAR_NM and all(at_850 <= abs(one.wavelength_nm - wavelength_nm) for one in near):
        return config.model_copy(update={"other_wavelengths": ()})
    if not near:
        known = sorted({850.0, *(one.wavelength_nm for one in config.other_wavelengths)})
        raise UserError(
            f"the target has no albedo at {wavelength_nm:g} nm",
            legal=f"a camera within {NEAR_NM:g} nm of {', '.join(f'{nm:g}' for nm in known)} nm",
            fix=f"declare other_wavelengths: [{{wavelength_nm: {wavelength_nm:g}, board: ..., tape: ..., ...}}]",
        )
    return _with_albedos(config, min(near, key=lambda one: abs(one.wavelength_nm - wavelength_nm)))


def _with_albedos(config: TargetConfig, albedos: WavelengthConfig) -> TargetConfig:
    room = config.room
    there = {
        "tape": bool(config.tapes),
        "backing": config.backing is not None,
        "floor": room is not None and room.floor_below_lens_m is not None,
        "back_wall": room is not None and room.back_wall_distance_m is not None,
    }
    lacking = [name for name, exists in there.items() if exists and getattr(albedos, name) is None]
    if lacking:
        raise UserError(
            f"other_wavelengths: at {albedos.wavelength_nm:g} nm there is no albedo for {', '.join(lacking)}",
            legal="an albedo for every surface that the target has",
        )
    changed: dict[str, Any] = {
        "other_wavelengths": (),
        "material": config.material.model_copy(update={"albedo_850": albedos.board}),
        "tapes": tuple(tape.model_copy(update={"albedo_850": albedos.tape}) for tape in config.tapes),
    }
    if config.backing is not None:
        changed["backing"] = config.backing.model_copy(update={"albedo_850": albedos.backing})
    if room is not None:
        named = {"floor_albedo_850": albedos.floor, "back_wall_albedo_850": albedos.back_wall}
        changed["room"] = room.model_copy(update={key: value for key, value in named.items() if value is not None})
    return config.model_copy(update=changed)
