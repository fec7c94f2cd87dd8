"""Control protocol by ADS, for clients on other hosts (own format).

A ReadWrite at the AMS port :data:`~eap.codec.ams.CONTROL_PORT` of a station's router has one
request of the control protocol as its data, a JSON object as on the control socket: in the group
CONTROL one that only reads, in the group CONFIGURE one about the configuration of a station,
compressed (RFC 1950), with its method as the index offset, so that access rules and audit see it.

The answer is that of the control socket behind an :class:`AnswerPart`; one that is longer than the
client accepts, or not there yet, is fetched in parts.  Variables are written as by any ADS client.

Clients and appliances of neighbouring releases work together: an answer may have fields that the
client does not know, and lack newer ones, which have defaults; ``hello`` says which methods there
are.
"""

from __future__ import annotations

import zlib
from enum import IntEnum

from eap.codec.ads import ConfigureOffset
from eap.codec.wire import WireStruct, u32
from eap.control.protocol import MAX_LINE, ErrorCode
from eap.errors import ControlError

MAX_REQUEST = 1 << 16
"""Bytes of a request that only reads."""
MAX_PACKED = 200_000
"""Bytes of a compressed request: AMS/TCP carries 256 KiB."""
PART = 60_000
"""Bytes of an answer that a client fetches at once: AMS/TCP carries 256 KiB."""
KEPT_S = 10.0
"""Time for which the rest of an answer is kept."""
READ_METHODS = frozenset(
    ("hello", "status", "pd_list", "variables", "read", "routes_list", "gateway_status")
)
"""Methods of the group CONTROL."""
CONFIGURE_METHODS = {each.name.lower(): each for each in ConfigureOffset}
"""Methods of the group CONFIGURE, and their offsets."""
METHODS = (*sorted(READ_METHODS), *CONFIGURE_METHODS)
"""All methods by ADS."""


class ControlOffset(IntEnum):
    """Index offset in the group CONTROL: operation."""

    REQUEST = 0
    """The data is a request."""
    PART = 1
    """The data is a :class:`PartRequest`."""


class AnswerPart(WireStruct, frozen=True):
    """Head of a part of an answer.

    *total* bytes has the whole, 0 if it is not there yet; *ticket* is 0 if this part is all.
    """

    ticket: u32
    total: u32


class PartRequest(WireStruct, frozen=True):
    """Request for the bytes of an answer from *position* on."""

    ticket: u32
    position: u32


def pack(line: bytes) -> bytes:
    """Return a request of the group CONFIGURE; raise ControlError if it is too long."""
    # The specification of a large station has more text than AMS/TCP carries at once.
    packed = zlib.compress(line, 6)
    if len(packed) > MAX_PACKED:
        reason = f"a compressed request by ADS has at most {MAX_PACKED} bytes, not {len(packed)}"
        raise ControlError(reason, code=ErrorCode.BUSY)
    return packed


def unpack(data: bytes) -> bytes:
    """Return the line of a request of the group CONFIGURE; raise ControlError if it is none."""
    reader = zlib.decompressobj()
    try:
        # Limited: a few bytes may decompress to any number.
        line = reader.decompress(data[:MAX_PACKED], MAX_LINE)
    except zlib.error as exc:
        raise ControlError(f"not compressed: {exc}", code=ErrorCode.BAD_REQUEST) from None
    # Either cut off, or longer than the limit: a part of a specification must not be applied.
    if not reader.eof:
        reason = f"a request has at most {MAX_LINE} bytes, {MAX_PACKED} of them compressed"
        raise ControlError(reason, code=ErrorCode.BAD_REQUEST)
    return line
