"""Scapy layers of EtherCAT frames of type 4 (process data) and type 5 (mailbox).

The independent referee of ``eap.codec``: written from the layouts alone, sharing no line with it.
Importing this module binds the layers to EtherType 0x88A4 and to UDP and TCP port 34980, so that

    >>> from tools.scapy_layers import *
    >>> sniff(offline="line.pcap", session=TCPSession)

shows them; TCPSession cuts TCP streams into frames (scapy 2.8 loses its place when two frames end
in one segment and a third begins).  Building fills in the lengths and the count.
Scapy is GPL-2.0: nothing that is installed imports this.
"""

from __future__ import annotations

from typing import Any

from scapy.fields import (
    BitEnumField,
    BitField,
    FieldLenField,
    LEShortField,
    PacketListField,
    StrFixedLenField,
    StrLenField,
    XByteField,
)
from scapy.layers.inet import TCP, UDP
from scapy.layers.l2 import Dot1Q, Ether
from scapy.packet import Packet, bind_layers

__all__ = ["EtherCatFrame", "Mailbox", "ProcessData", "ProcessDataUnit"]

ETHERTYPE = PORT = 0x88A4
FRAME_TYPES = {1: "datagrams", 2: "AMS", 3: "raw I/O", 4: "process data", 5: "mailbox"}
PROTOCOLS = {0: "error", 1: "AoE", 2: "EoE", 3: "CoE", 4: "FoE", 5: "SoE", 15: "VoE"}
HEADER_SIZE = 2


class NetIdField(StrFixedLenField):
    """Six octets shown with dots between them."""

    def __init__(self, name: str, default: bytes) -> None:
        super().__init__(name, default, length=6)

    def i2repr(self, _packet: Packet | None, value: bytes) -> str:
        """Show the way an AMS NetID is written."""
        return ".".join(map(str, value))


class EtherCatFrame(Packet):
    """The two octets in front of all EtherCAT traffic; what lies behind *length* is padding."""

    name = "EtherCAT"
    fields_desc = [  # noqa: RUF012  scapy wants a list
        BitEnumField("type", 4, 4, FRAME_TYPES, tot_size=-2),
        BitField("reserved", 0, 1),
        BitField("length", None, 11, end_tot_size=-2),
    ]

    def post_build(self, own: bytes, payload: bytes) -> bytes:
        """Fill in the length unless it is given."""
        if self.length is None:
            word = int.from_bytes(own, "little") & ~0x7FF | len(payload)
            own = word.to_bytes(HEADER_SIZE, "little")
        return own + payload

    def extract_padding(self, rest: bytes) -> tuple[bytes, bytes]:
        """Cut the frame's content from what follows it."""
        return rest[: self.length], rest[self.length :]

    @classmethod
    def tcp_reassemble(cls, data: bytes, _metadata: object, _session: object) -> Packet | None:
        """Return the first frame of a TCP stream once it is whole; the rest is its padding."""
        if len(data) < HEADER_SIZE:
            return None
        length = int.from_bytes(data[:HEADER_SIZE], "little") & 0x7FF
        return cls(data) if len(data) >= HEADER_SIZE + length else None


class ProcessDataUnit(Packet):
    """One PD in a frame of type 4."""

    name = "PD"
    fields_desc = [  # noqa: RUF012  scapy wants a list
        LEShortField("id", 0),
        LEShortField("version", 0),
        FieldLenField("length", None, length_of="data", fmt="<H"),
        LEShortField("quality", 0),
        StrLenField("data", b"", length_from=lambda pd: pd.length),
    ]

    def extract_padding(self, rest: bytes) -> tuple[bytes, bytes]:
        """Leave all that follows to the next PD."""
        return b"", rest


class ProcessData(Packet):
    """The content of a frame of type 4."""

    name = "EAP process data"
    fields_desc = [  # noqa: RUF012  scapy wants a list
        NetIdField("publisher", bytes(6)),
        FieldLenField("count", None, count_of="pds", fmt="<H"),
        LEShortField("cycle", 0),
        XByteField("reserved", 0),
        XByteField("eap_sm", 0),
        PacketListField("pds", [], ProcessDataUnit, count_from=lambda frame: frame.count),
    ]


class Mailbox(Packet):
    """The header of a mailbox message; its protocol's octets are the payload."""

    name = "EtherCAT mailbox"
    fields_desc = [  # noqa: RUF012  scapy wants a list
        LEShortField("length", None),
        LEShortField("address", 0),
        BitField("priority", 0, 2),
        BitField("channel", 0, 6),
        BitField("reserved", 0, 1),
        BitField("counter", 0, 3),
        BitEnumField("type", 0, 4, PROTOCOLS),
    ]

    def post_build(self, own: bytes, payload: bytes) -> bytes:
        """Fill in the length unless it is given."""
        if self.length is None:
            own = len(payload).to_bytes(2, "little") + own[2:]
        return own + payload

    def extract_padding(self, rest: bytes) -> tuple[bytes, bytes]:
        """Cut the message from what follows it."""
        return rest[: self.length], rest[self.length :]


def _bind() -> None:
    lower: tuple[tuple[Any, dict[str, int]], ...] = (
        (Ether, {"type": ETHERTYPE}),
        (Dot1Q, {"type": ETHERTYPE}),
        (UDP, {"dport": PORT}),
        (UDP, {"sport": PORT}),
        (TCP, {"dport": PORT}),
        (TCP, {"sport": PORT}),
    )
    for layer, fields in lower:
        bind_layers(layer, EtherCatFrame, **fields)
    bind_layers(EtherCatFrame, ProcessData, type=4)
    bind_layers(EtherCatFrame, Mailbox, type=5)


_bind()
