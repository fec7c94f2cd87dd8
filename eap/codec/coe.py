"""CoE messages: the header in front of every service, and emergencies (CANopen over EtherCAT).

SDOs are in :mod:`eap.codec.sdo`, SDO information in :mod:`eap.codec.sdoinfo`; a PDO service is the
header and the PDO.
"""

from __future__ import annotations

from enum import IntEnum
from typing import Annotated

from eap.codec.wire import Bits, Buffer, Scalar, WireStruct, bits3, u8, u16


class CoeService(IntEnum):
    """ETG.1000.6, CoE header: what a message is."""

    EMERGENCY = 1
    SDO_REQUEST = 2
    SDO_RESPONSE = 3
    TX_PDO = 4
    RX_PDO = 5
    TX_PDO_REMOTE_REQUEST = 6
    RX_PDO_REMOTE_REQUEST = 7
    SDO_INFORMATION = 8


class CoeHeader(WireStruct, frozen=True):
    """ETG.1000.6: the two octets behind the mailbox header; *number* is that of a PDO, else 0."""

    number: Annotated[int, Bits(9)] = 0
    reserved: bits3 = 0
    service: Annotated[CoeService, Bits(4, CoeService)] = CoeService.SDO_REQUEST


class Emergency(WireStruct, frozen=True):
    """ETG.1000.6: what a slave reports unasked; *error_code* 0 takes an error back."""

    error_code: u16
    error_register: u8 = 0
    data: Annotated[bytes, Scalar("5s")] = bytes(5)


def decode_message(data: Buffer) -> tuple[CoeHeader, memoryview]:
    """Return header and body of the data of a mailbox message.

    Raises:
        TruncatedError: it is shorter than the header.
        MalformedError: nobody knows the service.
    """
    return CoeHeader.decode(data), memoryview(data)[CoeHeader.SIZE :]


def encode_message(service: CoeService, body: Buffer, *, number: int = 0) -> bytes:
    """Return the data of a mailbox message."""
    head = CoeHeader(number, service=service).encode() if number else _PLAIN_HEADERS[service]
    return head + body


_PLAIN_HEADERS = [bytes((0, number << 4)) for number in range(16)]
"""By service, without a number."""
