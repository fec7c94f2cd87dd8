"""The control protocol's words about mailbox gateways; docs/control.md describes them."""

from __future__ import annotations

from eap.appliance.control import Parameters


class GatewayParameters(Parameters, frozen=True, kw_only=True):
    """``gateway_start``, ``gateway_stop`` and ``gateway_status``."""

    station: str
    port: str = ""
    """A bus port; empty for all of the station."""
