"""Units. SI inside the program; millimetres, inches and degrees only in YAML, tables and reports, converted here."""

from __future__ import annotations

MM = 1e-3
"""Metres in a millimetre."""
INCH = 25.4e-3
"""Metres in an inch (exact by definition)."""
UW_CM2 = 1e-2
"""Watts per square metre in a microwatt per square centimetre."""
SPEED_OF_LIGHT_VACUUM = 299_792_458.0
"""m/s, exact by definition."""
REFRACTIVE_INDEX_AIR = 1.00027
"""Air at 850 nm, 20 C, 101 kPa (Ciddor 1996, rounded): +-1e-5 over indoor weather, 10 um at 1 m."""
SPEED_OF_LIGHT_AIR = SPEED_OF_LIGHT_VACUUM / REFRACTIVE_INDEX_AIR
"""m/s in indoor air."""
