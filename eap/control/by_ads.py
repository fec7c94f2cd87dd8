"""Control protocol by ADS: requests that only read, for clients on other hosts (own format).

A ReadWrite at the AMS port :data:`~eap.codec.ams.CONTROL_PORT` of a station's router, with the
group CONTROL, has one request of the control protocol as its data, a JSON object as on the control
socket.  The answer is that of the control socket behind an :class:`AnswerPart`; one that is longer
than the client accepts is fetched in parts.  Variables are written as by any ADS client.
"""

from __future__ import annotations

from enum import IntEnum

from eap.codec.wire import WireStruct, u32

MAX_REQUEST = 1 << 16
"""Bytes of a request."""
PART = 60_000
"""Bytes of an answer that a client fetches at once: AMS/TCP carries 256 KiB."""
KEPT_S = 10.0
"""Time for which the rest of an answer is kept."""
READ_METHODS = frozenset(
    ("hello", "status", "pd_list", "variables", "read", "routes_list", "gateway_status")
)
"""Methods that other hosts may call."""


class ControlOffset(IntEnum):
    """Index offset: operation."""

    REQUEST = 0
    """The data is a request."""
    PART = 1
    """The data is a :class:`PartRequest`."""


class AnswerPart(WireStruct, frozen=True):
    """Head of a part of an answer; *total* bytes has the whole, *ticket* is 0 if this is all."""

    ticket: u32
    total: u32


class PartRequest(WireStruct, frozen=True):
    """Request for the bytes of an answer from *position* on."""

    ticket: u32
    position: u32
