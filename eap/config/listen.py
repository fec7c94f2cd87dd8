"""Addresses at which servers of a plant file listen, and the role of clients without a user."""

from __future__ import annotations

from ipaddress import ip_address
from typing import NamedTuple

from eap.ams.spec import Role
from eap.config.opcua_sections import OpcUaSection
from eap.config.web_sections import ServerSection


class Listen(NamedTuple):
    """Address of a server."""

    host: str
    port: int

    @property
    def is_loopback(self) -> bool:
        """True if only programs of this host reach it."""
        return ip_address(self.host).is_loopback

    @property
    def is_any(self) -> bool:
        """True for all addresses of this host."""
        return ip_address(self.host).is_unspecified

    def url(self, scheme: str) -> str:
        """Return the address for a browser."""
        host = "localhost" if self.is_any else self.host
        return f"{scheme}://{f'[{host}]' if ':' in host else host}:{self.port}/"


def parse_listen(text: str) -> Listen:
    """Read ``ADDRESS:PORT``; raise ValueError if it is none."""
    host, separator, number = text.rpartition(":")
    if not separator or not number.isdecimal() or not 0 < int(number) < 65536:
        raise ValueError(f"{text!r} is not an address with a port (1 to 65535)")
    host = host[1:-1] if host.startswith("[") and host.endswith("]") else host
    try:
        return Listen(str(ip_address(host)), int(number))
    except ValueError:
        raise ValueError(f"{host!r} is not an IP address") from None


def role_of_anonymous(server: ServerSection | OpcUaSection) -> Role | None:
    """Return the role of clients without a user; None if they have to log in.

    Programs of this host may do everything by ADS, too, unless a rule denies it.
    """
    has_proxy = isinstance(server, ServerSection) and server.proxy is not None
    if server.anonymous is not None or server.users or has_proxy:
        return server.anonymous
    return Role.ENGINEER
