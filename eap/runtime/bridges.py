"""Status of bridges: each writes its own to a file of the appliance's folder, services reads it.

So a bridge needs no request to report, and its status is there while services restarts.
"""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import msgspec

from eap.runtime.folder import ApplianceInfo


class PeerStatus(msgspec.Struct, kw_only=True):
    """State of one of several systems that a bridge connects to.

    Attributes:
        name: Its name in the plant file.
        url: Its address.
        is_up: True while it is connected.
        reason: Why it is not, or why a value cannot be read or written.
        since: Unix time of the latest change of *is_up*.
        connects: Times that it was connected.
        reads: Rounds in which all values were read.
        writes: Values written.
        values: Values that are read and written.
        failed: Those of them that cannot be, for the *reason*.
        span_us: Duration of the last round.
    """

    name: str
    url: str = ""
    is_up: bool = False
    reason: str = ""
    since: float = 0.0
    connects: int = 0
    reads: int = 0
    writes: int = 0
    values: int = 0
    failed: int = 0
    span_us: int = 0


class BridgeStatus(msgspec.Struct, kw_only=True):
    """Present state of a bridge, and its counters since the process began.

    Attributes:
        pid: Process that wrote it.
        peer: URL of the server that it connects to, or at which it listens.
        is_up: True while it is connected, or listens.
        reason: Why it is not.
        since: Unix time of the latest change of *is_up* or *reason*.
        clients: Connections to it; None of a bridge that connects to a server itself.
        sent: Values that it passed on from the plant.
        received: Writes that clients requested.
        refused: Those of them that were not done.
        dropped: Values and requests that it left out because the other side was too slow.
        peers: Systems that it connects to, if there are several.
    """

    pid: int = 0
    peer: str = ""
    is_up: bool = False
    reason: str = ""
    since: float = 0.0
    clients: int | None = None
    sent: int = 0
    received: int = 0
    refused: int = 0
    dropped: int = 0
    peers: list[PeerStatus] = []


_DECODER = msgspec.json.Decoder(BridgeStatus)


class BridgeFile:
    """File with the status of the bridge *name* in the *folder* of its appliance."""

    def __init__(self, folder: Path, name: str) -> None:
        self._path = folder / f"{name}.bridge"

    def write(self, status: BridgeStatus) -> None:
        """Replace the status in one step; a full disk keeps the one before."""
        temporary = self._path.with_suffix(".new")
        with suppress(OSError):
            temporary.write_bytes(msgspec.json.encode(status))
            temporary.replace(self._path)

    def read(self) -> BridgeStatus | None:
        """Return the status, None if there is none."""
        try:
            return _DECODER.decode(self._path.read_bytes())
        except (OSError, ValueError):
            return None


def read_bridges(folder: Path, info: ApplianceInfo) -> dict[str, BridgeStatus]:
    """Return the status of the bridges that run, by the names of their processes."""
    found = {}
    for name, process in info.extras.items():
        status = BridgeFile(folder, name).read()
        if status is not None and status.pid == process.pid:
            found[name] = status
    return found


def bridge_findings(plant: str, bridges: Mapping[str, BridgeStatus]) -> list[dict[str, Any]]:
    """Return the bridges that are not connected, or that lose values, as findings of ``status``."""
    return [row for name, each in bridges.items() for row in _findings(f"{plant} {name}", each)]


def _findings(where: str, status: BridgeStatus) -> list[dict[str, Any]]:
    rows = []
    if not status.is_up and status.reason:
        what = f"no connection to {status.peer}: {status.reason}"
        advice = "the plant runs without it; it tries again by itself"
        rows.append(_row("warning", where, what, advice, status.since))
    for peer in status.peers:
        at = f"{where} {peer.name}"
        if not peer.is_up and peer.reason:
            what = f"no connection to {peer.url or peer.name}: {peer.reason}"
            advice = "its variables have their substitutes; it tries again by itself"
            rows.append(_row("warning", at, what, advice, peer.since))
        elif peer.failed:
            what = f"{peer.failed} of {peer.values} values fail: {peer.reason}"
            rows.append(_row("warning", at, what, "correct the address in the plant file", None))
    if status.dropped:
        what = f"{status.dropped} values dropped: {status.peer} is too slow"
        rows.append(_row("info", where, what, "", None))
    if status.refused:
        what = f"{status.refused} of {status.received} writes refused; the audit has the reasons"
        rows.append(_row("info", where, what, "", None))
    return rows


def _row(severity: str, where: str, what: str, advice: str, since: float | None) -> dict[str, Any]:
    return {
        "severity": severity, "where": where, "what": what, "advice": advice, "since": since,
    }  # fmt: skip
