"""ESI files: raw, and the shipped ones with values changed; devices are built, or refused."""

from __future__ import annotations

import io
from contextlib import suppress
from pathlib import Path

from devicebus.esi.content import list_devices, load_device
from devicebus.sim.devices.build import build_slave
from devicebus.sim.spec import DeviceKind, SlaveSpec
from eap.codec.xmlstream import XmlError
from tools.fuzz.xmltexts import changed_values

_FILES = tuple(
    (Path(__file__).parents[3] / "config" / "esi" / name).read_bytes()
    for name in ("drive.xml", "modular.xml", "terminals.xml")
)


def fuzz_one(data: bytes) -> None:
    """A file is listed and its devices are loaded without an error; a build raises ValueError."""
    _use(data)
    for number, text in enumerate(_FILES):
        _use(changed_values(text, data[number:]))


def _use(xml: bytes) -> None:
    for listed in list_devices(io.BytesIO(xml)).devices:
        result = load_device(io.BytesIO(xml), listed)
        if result.device is None:
            if not result.findings:
                raise AssertionError("a device is refused without a reason")
            continue
        with suppress(ValueError, XmlError):
            build_slave(SlaveSpec(name="x", kind=DeviceKind.ESI), {}, result.device)
