"""Section of the key ``opcua`` of a plant file: the OPC UA server; docs/opcua.md explains it."""

from __future__ import annotations

from enum import StrEnum
from typing import Annotated, ClassVar

import msgspec
from msgspec import Meta

from eap.ams.spec import Role
from eap.config.structs import Section
from eap.config.users import AccountSection


class ChannelSecurity(StrEnum):
    """Security policy of channels."""

    NONE = "None"
    """Neither signed nor encrypted."""
    BASIC256SHA256 = "Basic256Sha256"
    AES256SHA256RSAPSS = "Aes256Sha256RsaPss"


class ClientTrust(StrEnum):
    """Certificates of clients that may open a channel with security."""

    TRUSTED = "trusted"
    """Those in the folder ``trusted``, and those that a certificate there has issued."""
    ANY = "any"
    """Every one that is valid."""


class RangeSection(Section, frozen=True, kw_only=True):
    """Smallest and largest value of a variable in operation."""

    low: float = msgspec.field(name="min")
    high: float = msgspec.field(name="max")


class OpcUaSection(Section, frozen=True, kw_only=True):
    """OPC UA server.

    *certificate* and *key* are paths from the plant file on, and *ranges* are by variable.
    """

    listen: str = "127.0.0.1:4840"
    variables: tuple[str, ...] = ("*/*",)
    operators: tuple[str, ...] = ()
    period_ms: Annotated[int, Meta(ge=10, le=60_000)] = 100
    security: tuple[ChannelSecurity, ...] = ()
    clients: ClientTrust = ClientTrust.TRUSTED
    certificate: str = ""
    key: str = ""
    users: tuple[AccountSection, ...] = ()
    anonymous: Role | None = None
    ranges: dict[str, RangeSection] = msgspec.field(default_factory=dict)

    SHORT: ClassVar[str] = "listen"
    KEY: ClassVar[str] = "opcua"
    """Key of the plant file that it is."""
