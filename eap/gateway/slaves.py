"""Slaves behind a gateway, read from the dictionary of its master (ETG.1510)."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from typing import NamedTuple

from devicebus.errors import BusError, MailboxRefusedError, MailboxTimeoutError
from devicebus.mailbox import coe_client
from devicebus.mailbox.conversation import Conversation
from devicebus.mailbox.protocol import MailboxSizes
from eap.gateway.requests import VIRTUAL_BIT
from eap.od.abort import SdoAbortError

NO_DICTIONARY = (SdoAbortError, MailboxRefusedError, MailboxTimeoutError)
"""Errors of a master that has no dictionary, or is silent at address 0."""


class MasterSlave(NamedTuple):
    """Slave as the master's dictionary describes it."""

    station: int
    name: str
    vendor: int
    product: int
    revision: int
    serial: int
    to_slave: int
    to_master: int
    al_status: int
    protocols: int | None = None
    """Bits as in its EEPROM, None if the dictionary ends before them."""


def read_slaves() -> Conversation[list[MasterSlave]]:
    """Read the slaves from the master's dictionary (address 0)."""
    count = int.from_bytes((yield from coe_client.upload(0xF020, 0)), "little")
    slaves = []
    for number in range(count):
        found = yield from _read_slave(number)
        slaves.append(found)
    return slaves


def _read_slave(number: int) -> Conversation[MasterSlave]:
    index = 0x8000 + number
    values = {}
    for subindex in (1, 5, 6, 7, 8, 33, 34):
        octets = yield from coe_client.upload(index, subindex)
        values[subindex] = int.from_bytes(octets, "little")
    name = yield from coe_client.upload(index, 3)
    state = yield from coe_client.upload(0xA000 + number, 1)
    protocols = None
    # Objects of other masters may end before subindex 39.
    with suppress(SdoAbortError):
        protocols = int.from_bytes((yield from coe_client.upload(index, 39)), "little")
    return MasterSlave(
        station=values[1],
        name=name.rstrip(b"\0").decode(errors="replace"),
        vendor=values[5],
        product=values[6],
        revision=values[7],
        serial=values[8],
        to_slave=values[33],
        to_master=values[34],
        al_status=int.from_bytes(state, "little"),
        protocols=protocols,
    )


def read_sizes(address: int) -> Conversation[MailboxSizes]:
    """Read the mailbox sizes of one slave from the master's dictionary (address 0).

    Raises:
        BusError: the master knows no such slave, or the slave has no mailbox.
        MailboxTimeoutError, MailboxRefusedError, SdoAbortError: the master has no dictionary.
    """
    try:
        slaves = yield from read_slaves()
    except NO_DICTIONARY as exc:
        exc.add_note(
            f"the mailbox of slave {address} has to be known, and the master does not tell it: put"
            f" its sizes into mailboxes[{address}]"
        )
        raise
    return sizes_of(slaves, address)


def sizes_of(slaves: Sequence[MasterSlave], address: int) -> MailboxSizes:
    """Return the mailboxes of a slave; raise BusError if it has none or is unknown."""
    for slave in slaves:
        if slave.station in {address, address & ~VIRTUAL_BIT}:
            if not slave.to_slave:
                raise BusError(f"slave {address} ({slave.name}) has no mailbox in its state")
            return MailboxSizes(slave.to_slave, slave.to_master)
    known = ", ".join(f"{slave.station} ({slave.name})" for slave in slaves) or "none"
    raise BusError(f"unknown slave {address}; known slaves: {known}")
