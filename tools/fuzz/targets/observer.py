"""Packets as ``eapctl discover`` takes them: no exception, nothing uncounted, bounded tables."""

from __future__ import annotations

from eap.ops.discover import ObserverFeed, discovered
from eap.pd.observer import MAX_PDS, ObservedPath

_PATH = ObservedPath("udp", "10.0.0.1", "10.0.0.2")
_ROWS_EVERY = 500
"""Inputs between two looks at all rows, which take longer than the packets."""


class _World:
    """The discovery that all inputs go to; begun anew when it is full."""

    def __init__(self) -> None:
        self.discovery = ObserverFeed()
        self.inputs = 0


_WORLD = _World()


def fuzz_one(data: bytes) -> None:
    """Take *data* as a packet, and as a frame whose path is known."""
    discovery = _WORLD.discovery
    observer = discovery.observer
    _WORLD.inputs += 1
    tci = len(data) & 0x1FFF if len(data) & 1 else 0
    discovery.receive_packet(memoryview(data), _WORLD.inputs * 1_000_000, tci)
    before = observer.frames + observer.malformed + sum(observer.other_types.values())
    observer.receive_frame(data, _WORLD.inputs * 1_000_000, _PATH)
    if observer.frames + observer.malformed + sum(observer.other_types.values()) != before + 1:
        raise AssertionError("neither taken nor counted")
    if len(observer.pds) > MAX_PDS:
        raise AssertionError(f"{len(observer.pds)} PDs are kept")
    if _WORLD.inputs % _ROWS_EVERY == 0:
        discovered(discovery, ())
        _WORLD.discovery = ObserverFeed()
