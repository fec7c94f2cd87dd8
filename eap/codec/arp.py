"""ARP messages for IPv4 on Ethernet (RFC 826), and the probe that claims no address (RFC 5227)."""

from __future__ import annotations

import struct
from ipaddress import IPv4Address
from typing import NamedTuple, Self

from eap.codec.wire import Buffer
from eap.errors import MalformedError, TruncatedError
from eap.ids import MacAddr

ETHERTYPE_ARP = 0x0806
REQUEST = 1
REPLY = 2
# An answer to this address enters no table under a wrong one.
NO_ADDRESS = IPv4Address(0)
"""The sender of a probe."""
NO_MAC = MacAddr(bytes(6))

_LAYOUT = struct.Struct("!HHBBH6s4s6s4s")
SIZE = _LAYOUT.size
"""Bytes of a message; padding of the frame may follow."""

_HARDWARE = (1, 6)  # some bridges write 6, IEEE 802, and mean the same addresses
_IPV4 = 0x0800


class ArpMessage(NamedTuple):
    """RFC 826: ARP message; *operation* may be unknown."""

    operation: int
    sender_mac: MacAddr
    sender: IPv4Address
    target_mac: MacAddr
    target: IPv4Address

    @classmethod
    def probe(cls, sender_mac: MacAddr, target: IPv4Address) -> Self:
        """Return a probe for *target* by a host without an address (RFC 5227 2.1)."""
        return cls(REQUEST, sender_mac, NO_ADDRESS, NO_MAC, target)

    @classmethod
    def decode(cls, data: Buffer, offset: int = 0) -> Self:
        """Read one message; what follows is ignored.

        Raises:
            TruncatedError: it does not fit.
            MalformedError: it is about other addresses than those of Ethernet and IPv4.
        """
        try:
            hardware, protocol, *sizes, operation, sender_mac, sender, target_mac, target = (
                _LAYOUT.unpack_from(data, offset)
            )
        except struct.error:
            there = max(0, len(data) - offset)
            raise TruncatedError(
                f"needs {SIZE} bytes, but {there} follow", layout="ArpMessage", offset=offset
            ) from None
        if hardware not in _HARDWARE or protocol != _IPV4 or sizes != [6, 4]:
            raise MalformedError(
                f"hardware {hardware}, protocol {protocol:#06x}, sizes {sizes}; "
                "expected 1, 0x0800, [6, 4]",
                layout="ArpMessage",
                offset=offset,
            )
        return cls(
            operation,
            MacAddr(sender_mac),
            IPv4Address(sender),
            MacAddr(target_mac),
            IPv4Address(target),
        )

    def encode(self) -> bytes:
        """Return the 28 bytes behind the Ethernet header."""
        return _LAYOUT.pack(
            _HARDWARE[0],
            _IPV4,
            6,
            4,
            self.operation,
            self.sender_mac,
            self.sender.packed,
            self.target_mac,
            self.target.packed,
        )

    @property
    def is_probe(self) -> bool:
        """True if the message is a probe for the target address (RFC 5227 2.1.1)."""
        return self.operation == REQUEST and self.sender == NO_ADDRESS

    @property
    def shows_sender(self) -> bool:
        """True if a host with the sender's two addresses sent it: a reply, request or announcement.

        A group address, or none at all, belongs to no host.
        """
        return (
            self.operation in {REQUEST, REPLY}
            and self.sender != NO_ADDRESS
            and not self.sender_mac.is_group
            and self.sender_mac != NO_MAC
        )
