"""Control protocol: mailbox gateways.

The records of requests and answers, which server and client share; docs/control.md describes them.
"""

from __future__ import annotations

from typing import Literal

from eap.control.protocol import Document, Method, Parameters


class GatewayParameters(Parameters, frozen=True, kw_only=True):
    """``gateway_start``, ``gateway_stop`` and ``gateway_status``."""

    station: str
    port: str = ""
    """A bus port; empty for all of the station."""


class GatewaySettings(Document, frozen=True):
    """Settings of the plant file."""

    answer_ms: int
    silent: bool
    in_flight: int
    rate: int
    clients: int


class TransferRow(Document, frozen=True):
    """Transfer under way: address of the slave, and protocol."""

    address: int
    protocol: str


class GatewayClientRow(Document, frozen=True, kw_only=True):
    """Client of a gateway."""

    transport: str
    address: str
    requests: int
    repeated: int
    errors: int
    waiting: int
    transfers: list[TransferRow]


class MailboxFigures(Document, frozen=True, kw_only=True):
    """Requests to one mailbox in one protocol; address 0 is the master."""

    address: int
    protocol: str
    requests: int
    replies: int
    errors: dict[str, int]
    last_error: str
    mean_us: float | None
    slowest_us: float


class GatewayRow(Document, frozen=True, kw_only=True):
    """One gateway of an answer to all three methods."""

    station: str
    port: str
    served: list[str]
    state: Literal["running", "stopped"]
    turned_away: int
    settings: GatewaySettings
    clients: list[GatewayClientRow]
    slaves: list[MailboxFigures]


GATEWAY_START = Method("gateway_start", GatewayParameters, list[GatewayRow])
GATEWAY_STOP = Method("gateway_stop", GatewayParameters, list[GatewayRow])
GATEWAY_STATUS = Method("gateway_status", GatewayParameters, list[GatewayRow])
