"""ESI files: raw, and the shipped ones with values changed; devices are built, or refused."""

from __future__ import annotations

import io
import re
from contextlib import suppress
from pathlib import Path

from devicebus.esi.content import list_devices, load_device
from devicebus.sim.devices.build import build_slave
from devicebus.sim.spec import DeviceKind, SlaveSpec
from eap.codec.xmlstream import XmlError
from tools.fuzz.messages import cut

_FILES = tuple(
    (Path(__file__).parents[3] / "config" / "esi" / name).read_bytes()
    for name in ("drive.xml", "modular.xml", "terminals.xml")
)
_VALUE = re.compile(rb'(?<=[>"])[^<>"\n]+(?=[<"])')
_HOSTILE = (
    b"", b"0", b"-1", b"#x0", b"#xFFFF", b"#x1A00", b"65535", b"4294967295", b"9999999999999999999",
    b"#xZZ", b"true", b"BOOL", b"ARRAY [0..65000] OF LREAL", b"STRING(60000)", b"&lt;&#0;", b"\xff",
)  # fmt: skip


def fuzz_one(data: bytes) -> None:
    """A file is listed and its devices are loaded without an error; a build raises ValueError."""
    _use(data)
    for number, text in enumerate(_FILES):
        _use(_changed(text, data[number:]))


def _changed(text: bytes, data: bytes) -> bytes:
    """Replace values of *text* by hostile ones, at places that *data* names."""
    places = list(_VALUE.finditer(text))
    chosen: dict[int, bytes] = {}
    for piece in cut(data):
        if len(piece) > 2:
            at = int.from_bytes(piece[:2], "little") % len(places)
            hostile = piece[3:] if piece[2] & 0x10 else _HOSTILE[piece[2] % len(_HOSTILE)]
            chosen[at] = hostile
    parts = []
    end = 0
    for at, value in sorted(chosen.items()):
        parts += [text[end : places[at].start()], value]
        end = places[at].end()
    return b"".join([*parts, text[end:]])


def _use(xml: bytes) -> None:
    for listed in list_devices(io.BytesIO(xml)).devices:
        result = load_device(io.BytesIO(xml), listed)
        if result.device is None:
            if not result.findings:
                raise AssertionError("a device is refused without a reason")
            continue
        with suppress(ValueError, XmlError):
            build_slave(SlaveSpec(name="x", kind=DeviceKind.ESI), {}, result.device)
