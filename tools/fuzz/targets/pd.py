"""Frames of type 4."""

from __future__ import annotations

from eap.codec.pd import iter_pds
from eap.errors import CodecError


def fuzz_one(data: bytes) -> None:
    """Read every PD; only CodecError may pass."""
    try:
        for header, payload in iter_pds(data):
            if len(payload) != header.length:
                raise AssertionError(f"{len(payload)} octets, the header says {header.length}")
    except CodecError:
        pass
