"""XML files with some of their values replaced by hostile ones."""

from __future__ import annotations

import re

from tools.fuzz.messages import cut

_VALUE = re.compile(rb'(?<=[>"])[^<>"\n]+(?=[<"])')
_HOSTILE = (
    b"", b"0", b"-1", b"#x0", b"#xFFFF", b"#x1A00", b"65535", b"4294967295", b"9999999999999999999",
    b"#xZZ", b"true", b"BOOL", b"ARRAY [0..65000] OF LREAL", b"STRING(60000)", b"&lt;&#0;", b"\xff",
)  # fmt: skip


def changed_values(text: bytes, data: bytes) -> bytes:
    """Return *text* with values and attributes replaced, at places that *data* names."""
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
