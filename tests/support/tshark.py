"""tshark, the decoder that is not ours: write what was sent to a file, read what it sees there."""

from __future__ import annotations

import json
import subprocess
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import dpkt


def write_pcap(path: Path, frames: Iterable[bytes]) -> Path:
    """Write whole Ethernet frames, a millisecond apart, into a pcap file at *path*."""
    with path.open("wb") as file:
        writer = dpkt.pcap.Writer(file, snaplen=65535)
        for number, octets in enumerate(frames):
            writer.writepkt(octets, ts=1_700_000_000 + number / 1000)
    return path


def dissect(path: Path) -> list[dict[str, Any]]:
    """Return what tshark sees in each packet of a capture that holds an EtherCAT frame.

    A packet is a dict of ``number``, ``transport``, ``type``, ``length``, ``malformed`` and the
    raw ``layers``; beside them ``publisher``, ``count``, ``cycle`` and ``pds`` (``id``,
    ``version``, ``length``, ``quality``, ``data``) in type 4, ``mailbox`` in type 5 and
    ``datagrams`` in type 1 (``command`` as a number).

    tshark puts no TCP stream together: it reads one frame at the start of each segment.  To have
    it read the frames of a stream that was cut otherwise, write them from ``iter_capture`` into a
    file of their own.
    """
    command = ["tshark", "-n", "-r", str(path), "-T", "json", "--no-duplicate-keys"]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    packets = [packet["_source"]["layers"] for packet in json.loads(done.stdout)]
    return [_fields(layers) for layers in packets if "ecatf" in layers]


def _fields(layers: dict[str, Any]) -> dict[str, Any]:
    names = layers["frame"]["frame.protocols"].split(":")
    fields = {
        "number": int(layers["frame"]["frame.number"]),
        "transport": next((name for name in ("udp", "tcp") if name in names), "ethernet"),
        "type": _number(layers["ecatf"]["ecatf.type"]),
        "length": _number(layers["ecatf"]["ecatf.length"]),
        "malformed": _is_malformed(layers),
        "layers": layers,
    }
    if content := layers.get("tc_nv"):
        fields |= _process_data(content)
    if content := layers.get("ecat_mailbox"):
        fields["mailbox"] = _mailbox(content)
    if content := layers.get("ecat"):
        items = [item for value in content.values() for item in _listed(value)]
        fields["datagrams"] = [_datagram(item) for item in items if "Header" in item]
    return fields


def _process_data(content: dict[str, Any]) -> dict[str, Any]:
    header = content["tc_nv.header"]
    return {
        "publisher": ".".join(str(octet) for octet in _octets(header["tc_nv.publisher"])),
        "count": _number(header["tc_nv.count"]),
        "cycle": _number(header["tc_nv.cycleindex"]),
        "pds": [
            {
                "id": _number(pd["tc_nv.varheader"]["tc_nv.id"]),
                "version": _number(pd["tc_nv.varheader"]["tc_nv.hash"]),
                "length": _number(pd["tc_nv.varheader"]["tc_nv.length"]),
                "quality": _number(pd["tc_nv.varheader"]["tc_nv.quality"]),
                "data": _octets(pd.get("tc_nv.data", "")).hex(),
            }
            for pd in _listed(content.get("tc_nv.variable_tree", []))
        ],
    }


def _mailbox(content: dict[str, Any]) -> dict[str, Any]:
    # Not the priority: Wireshark 4.0 reads it from the two lowest bits, which are the channel's.
    names = ("length", "address", "type", "counter")
    found = dict(_walk(content))
    return {name: _number(found[f"ecat_mailbox.{name}"]) for name in names}


def _datagram(content: dict[str, Any]) -> dict[str, Any]:
    names = {
        "command": "ecat.cmd",
        "index": "ecat.idx",
        "adp": "ecat.adp",
        "ado": "ecat.ado",
        "address": "ecat.lad",
        "length": "ecat.subframe.length",
        "wkc": "ecat.cnt",
    }
    found = dict(_walk(content))
    return {name: _number(found[key]) for name, key in names.items() if key in found}


def _is_malformed(layers: dict[str, Any]) -> bool:
    found = dict(_walk(layers))
    invalid = any(name.endswith(".invalid") for name in found)
    reserved = _number(layers["ecatf"].get("ecatf.reserved", "0")) != 0
    return invalid or reserved or bool({"_ws.malformed", "_ws.short"} & set(found))


def _walk(value: Any) -> Iterator[tuple[str, Any]]:
    if isinstance(value, list):
        for item in value:
            yield from _walk(item)
    elif isinstance(value, dict):
        for name, item in value.items():
            yield name, item
            yield from _walk(item)


def _listed(value: Any) -> list[Any]:
    return value if isinstance(value, list) else [value]


def _number(text: str) -> int:
    return int(text, 0)


def _octets(text: str) -> bytes:
    return bytes.fromhex(text.replace(":", ""))
