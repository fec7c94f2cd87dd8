"""The frame header that all EtherCAT traffic shares, and the constants of its transports."""

from __future__ import annotations

from enum import IntEnum

from eap.codec.wire import WireStruct, bit, bits4, bits11

ETHERTYPE = 0x88A4
EAP_PORT = 0x88A4
"""UDP and TCP port 34980: the EtherType as a number (ETG.1005)."""

MAX_ETHERNET_FRAME = 1500
"""Bytes behind the Ethernet header, the two of the EtherCAT header included."""
MAX_UDP_FRAME = 1472
"""The same in one unfragmented UDP datagram."""


class FrameType(IntEnum):
    """Type of the data behind the header.  TwinCAT also sends the undocumented type 7 in scans."""

    DATAGRAM = 1
    AMS = 2
    RAW_IO = 3
    PROCESS_DATA = 4
    MAILBOX = 5


class EtherCatHeader(WireStruct, frozen=True):
    """ETG.1000.4: the two bytes behind EtherType 0x88A4, the UDP header or a TCP boundary."""

    length: bits11
    reserved: bit = 0
    type: bits4 = FrameType.PROCESS_DATA
