"""Plant files: raw, and a valid one with lines and values changed."""

from __future__ import annotations

import tempfile
from pathlib import Path

from eap.runtime.plantfile import load_plant
from tools.fuzz.messages import cut

_LINES = (Path(__file__).parents[3] / "config" / "demo.yaml").read_bytes().splitlines(keepends=True)
_HOSTILE = (
    b"", b"-1", b"0", b"1e400", b"99999999999999999999", b"[]", b"{}", b"~", b"&a [*a]", b"!!map x",
    b"'", b"\t", b"*x", b"0.0.0.0.0.0", b"udp://[::1]", b"BLOCK(99999999)", b"../../etc/passwd",
    b"\x00", b"\xff\xfe", b"\xe2\x80\xa8",
)  # fmt: skip


def fuzz_one(data: bytes) -> None:
    """A plant is read, or the findings say why not."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "plant.yaml")
        for content in (data, _changed(data)):
            path.write_bytes(content)
            result = load_plant(path)
            if result.plant is None and not result.findings:
                raise AssertionError("a plant file is refused without a reason")


def _changed(data: bytes) -> bytes:
    """Change lines of the demo: their values, or their place."""
    lines = list(_LINES)
    for piece in cut(data):
        if len(piece) > 2:
            at = int.from_bytes(piece[:2], "little") % len(lines)
            key, colon, _ = lines[at].partition(b":")
            if piece[2] & 0x80:
                lines[at] = lines[piece[2] % len(lines)]
            elif piece[2] & 0x40:
                lines[at] = piece[3:] + b"\n"
            else:
                lines[at] = key + colon + b" " + _HOSTILE[piece[2] % len(_HOSTILE)] + b"\n"
    return b"".join(lines)
