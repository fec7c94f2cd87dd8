"""Units as OPC UA names them: codes of UNECE Recommendation 20 (OPC 10000-8, EUInformation)."""

from __future__ import annotations

from typing import Final

NAMESPACE: Final = "http://www.opcfoundation.org/UA/units/un/cefact"

_CODES: Final = {
    "%": "P1", "‰": "NX", "1/min": "RPM", "rpm": "RPM", "1/s": "C97", "Hz": "HTZ", "kHz": "KHZ",
    "MHz": "MHZ", "m": "MTR", "mm": "MMT", "cm": "CMT", "µm": "4H", "um": "4H", "km": "KMT",
    "m/s": "MTS", "mm/s": "C16", "m/min": "2X", "km/h": "KMH", "m/s²": "MSK", "m/s2": "MSK",
    "s": "SEC", "ms": "C26", "µs": "B98", "us": "B98", "ns": "C47", "min": "MIN", "h": "HUR",
    "d": "DAY", "°C": "CEL", "degC": "CEL", "C": "CEL", "K": "KEL", "°F": "FAH", "degF": "FAH",
    "V": "VLT", "mV": "2Z", "kV": "KVT", "A": "AMP", "mA": "4K", "kA": "B22", "W": "WTT",
    "kW": "KWT", "MW": "MAW", "mW": "C31", "Wh": "WHR", "kWh": "KWH", "MWh": "MWH", "VA": "D46",
    "kVA": "KVA", "var": "D44", "kvar": "KVR", "J": "JOU", "kJ": "KJO", "Ohm": "OHM", "Ω": "OHM",
    "F": "FAR", "H": "81", "T": "D33", "N": "NEW", "kN": "B47", "Nm": "NU", "Pa": "PAL",
    "kPa": "KPA", "MPa": "MPA", "bar": "BAR", "mbar": "MBR", "kg": "KGM", "g": "GRM", "mg": "MGM",
    "t": "TNE", "kg/h": "E93", "kg/s": "KGS", "l": "LTR", "L": "LTR", "ml": "MLT", "m³": "MTQ",
    "m3": "MTQ", "l/min": "L2", "l/h": "E32", "l/s": "G51", "m³/h": "MQH", "m3/h": "MQH",
    "m²": "MTK", "m2": "MTK", "rad": "C81", "°": "DD", "deg": "DD", "rad/s": "2A", "dB": "2N",
    "lx": "LUX", "cd": "CDL", "lm": "LUM", "mol": "C34", "ppm": "59", "pH": "Q30",
}  # fmt: skip
"""Code of each unit, by the texts that plant files have for it."""


def unit_id(unit: str) -> int | None:
    """Return the UnitId of a unit; None if it is not known.

    It is the characters of the code as bytes of a number, the first one highest.
    """
    code = _CODES.get(unit)
    return None if code is None else int.from_bytes(code.encode(), "big")
