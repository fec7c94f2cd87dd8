"""tshark, the decoder that is not ours: write what was sent to a file, read what it sees there."""

from __future__ import annotations

import json
import subprocess
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import dpkt

TYPE_4 = ("tc_nv.publisher", "tc_nv.count", "tc_nv.cycleindex")


def write_pcap(path: Path, frames: Iterable[bytes]) -> Path:
    """Write whole Ethernet frames, a millisecond apart, into a pcap file at *path*."""
    with path.open("wb") as file:
        writer = dpkt.pcap.Writer(file, snaplen=65535)
        for number, octets in enumerate(frames):
            writer.writepkt(octets, ts=1_700_000_000 + number / 1000)
    return path


def dissect(path: Path, *options: str) -> list[dict[str, Any]]:
    """Return the layers of each packet in a capture, as ``tshark -T json -x`` names their fields.

    Fields that occur several times in a layer are lists.  UDP and TCP checksums are not checked:
    local captures hold checksums that a network card would have filled in.
    """
    command = ["tshark", "-r", str(path), "-T", "json", "--no-duplicate-keys", "-n"]
    done = subprocess.run([*command, *options], capture_output=True, text=True, check=True)
    return [packet["_source"]["layers"] for packet in json.loads(done.stdout)]


def is_malformed(layers: dict[str, Any]) -> bool:
    """Whether tshark marked anything in the packet as malformed or as an error."""
    text = json.dumps(layers)
    return (
        '"_ws.malformed"' in text
        or '"_ws.short"' in text
        or '"_ws.expert.severity": "8388608"' in text
    )


def process_data(layers: dict[str, Any]) -> list[dict[str, Any]]:
    """Return each type-4 frame of a packet in the form of ``eap.appliance.decode``.

    A TCP packet may hold several; one that is cut by segments has none.
    """
    found = []
    for frame, content in zip(_listed(layers, "ecatf"), _listed(layers, "tc_nv"), strict=True):
        header = content["tc_nv.header"]
        variables = [
            value
            for name, values in content.items()
            if name.startswith("tc_nv.variable") or "Variable" in name
            for value in (values if isinstance(values, list) else [values])
        ]
        found.append((frame, header, variables))
    return found


def _listed(layers: dict[str, Any], name: str) -> list[Any]:
    value = layers.get(name, [])
    return value if isinstance(value, list) else [value]
