"""PDO assignment and PDO mapping of a slave (ETG.1000.6).

Simple slaves have them in the EEPROM only.  Slaves with CoE have them in objects, which the master
reads and may write: 0x1C10 and following for the assignment, 0x1600 and 0x1A00 and following for
the mapping.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from types import MappingProxyType
from typing import NamedTuple

import msgspec

from devicebus.errors import BusError, MailboxProtocolError
from devicebus.mailbox import coe_client
from devicebus.mailbox.conversation import Conversation
from devicebus.mailbox.protocol import MailboxSizes
from devicebus.wire.sii import VIRTUAL, Sii, SiiPdo, SiiSyncManager
from eap.ids import ObjectId
from eap.od.abort import SdoAbortError
from eap.od.slave_config import SlaveConfig

ASSIGNMENT = 0x1C10
"""Assignment object of sync manager 0; those of the others follow."""
MAX_ENTRIES = 254
OUTPUTS, INPUTS = 3, 4
"""Sync manager types of outputs and inputs."""
_WRITES = 0x04


class PdoEntry(msgspec.Struct, frozen=True):
    """Mapped entry; index 0 is padding."""

    index: int
    subindex: int
    bit_length: int
    name: str = ""
    data_type: int = 0


class Pdo(msgspec.Struct, frozen=True):
    """PDO with its mapped entries in order."""

    index: int
    entries: tuple[PdoEntry, ...]


class ProcessDataChannel(NamedTuple):
    """Sync manager of process data with its PDOs."""

    number: int
    start: int
    control: int
    is_output: bool
    pdos: tuple[Pdo, ...]
    fixed_size: int = 0
    """Size in bytes without PDOs."""
    is_virtual: bool = False
    """True if the FMMU maps registers: no sync manager is set up."""

    @property
    def size(self) -> int:
        """Octets."""
        bits = sum(entry.bit_length for pdo in self.pdos for entry in pdo.entries)
        return (bits + 7) // 8 if self.pdos else self.fixed_size


def channels_from_sii(
    sii: Sii, assignment: Mapping[int, Sequence[int]] = MappingProxyType({})
) -> tuple[ProcessDataChannel, ...]:
    """Return the process data sync managers with their PDOs.

    Those are the PDOs that *assignment* gives a sync manager, else those that the EEPROM assigns.

    Raises BusError for a PDO that the EEPROM does not have.
    """
    return tuple(
        ProcessDataChannel(
            number,
            manager.start,
            manager.control,
            is_output,
            tuple(_pdos_of(sii, number, assignment.get(number), is_output=is_output)),
            manager.length if manager.enable & 1 and number not in assignment else 0,
            bool(manager.enable & VIRTUAL),
        )
        for number, manager in enumerate(sii.sync_managers)
        if (is_output := _is_output(manager)) is not None
    )


def _pdos_of(
    sii: Sii, number: int, assigned: Sequence[int] | None, *, is_output: bool
) -> Iterator[Pdo]:
    known = sii.rx_pdos if is_output else sii.tx_pdos
    if assigned is None:
        # PDOs of other values (0xFF) are not assigned by default.
        yield from (_pdo(sii, each) for each in known if each.header.sync_manager == number)
        return
    by_index = {each.header.index: each for each in known}
    for index in assigned:
        if index not in by_index:
            has = ", ".join(f"0x{each:04X}" for each in by_index) or "none"
            raise BusError(
                f"PDO 0x{index:04X} cannot be assigned to sync manager {number}: the EEPROM has"
                f" {has}"
            )
        yield _pdo(sii, by_index[index])


def read_channels(sii: Sii) -> Conversation[tuple[ProcessDataChannel, ...]]:
    """Read the PDO assignment and mapping of a slave with CoE.

    A sync manager without these objects has the PDOs of the EEPROM.

    Raises:
        MailboxProtocolError: an answer is no valid list.
        MailboxTimeoutError: the slave does not answer.
    """
    known = channels_from_sii(sii)
    texts = {
        (entry.index, entry.subindex): entry
        for channel in known
        for pdo in channel.pdos
        for entry in pdo.entries
    }
    asks_names = bool(sii.general and sii.general.coe_info)
    channels = []
    for channel in known:
        try:
            indexes = yield from _read_list(ASSIGNMENT + channel.number, 2)
            pdos = []
            for index in indexes:
                mapped = yield from _read_list(index, 4)
                pdos.append(Pdo(index, tuple(_entry(number, texts) for number in mapped)))
        except SdoAbortError:
            # No assignment object: the slave's PDOs are fixed, as the EEPROM has them.
            channels.append(channel)
            continue
        if asks_names:
            pdos = yield from _with_names(pdos)
        channels.append(channel._replace(pdos=tuple(pdos), fixed_size=0))
    return tuple(channels)


def write_configuration(config: SlaveConfig, sizes: MailboxSizes) -> Conversation[None]:
    """Write PDO mapping and assignment to a slave in PREOP.

    A list that the slave does not let write is no error if it is the wanted one.

    Raises:
        SdoAbortError: the slave refuses a value.
    """
    # Without assigned PDOs first: a slave refuses to change the mapping of an assigned one.
    remapped = [
        manager
        for manager, pdos in config.assignment.items()
        if any(pdo in config.mapping for pdo in pdos)
    ]
    for manager in remapped:
        with suppress(SdoAbortError):  # a fixed assignment is checked below
            yield from coe_client.download(ASSIGNMENT + manager, 0, b"\0", sizes)
    for pdo, entries in config.mapping.items():
        numbers = [each.index << 16 | each.subindex << 8 | each.bit_length for each in entries]
        yield from _write_list(pdo, numbers, 4, sizes)
    for manager, pdos in config.assignment.items():
        yield from _write_list(ASSIGNMENT + manager, pdos, 2, sizes)


def _is_output(manager: SiiSyncManager) -> bool | None:
    if manager.type in {OUTPUTS, INPUTS}:
        return manager.type == OUTPUTS
    # An EEPROM without types has 0: then mode and direction of the control byte decide.
    is_buffered = manager.control & 3 == 0
    if manager.type == 0 and is_buffered and manager.length:
        return bool(manager.control & _WRITES)
    return None


def _pdo(sii: Sii, pdo: SiiPdo) -> Pdo:
    return Pdo(
        pdo.header.index,
        tuple(
            PdoEntry(
                each.index, each.subindex, each.bit_length, sii.string(each.name), each.data_type
            )
            for each in pdo.entries
        ),
    )


def _entry(number: int, texts: Mapping[tuple[int, int], PdoEntry]) -> PdoEntry:
    index, subindex, bits = number >> 16, number >> 8 & 0xFF, number & 0xFF
    known = texts.get((index, subindex))
    # Index 0 is padding and has no name.
    if known is None or not index:
        return PdoEntry(index, subindex, bits)
    return PdoEntry(index, subindex, bits, known.name, known.data_type)


def _with_names(pdos: Sequence[Pdo]) -> Conversation[list[Pdo]]:
    named = []
    for pdo in pdos:
        entries: tuple[PdoEntry, ...] = ()
        for entry in pdo.entries:
            entries += ((yield from _with_name(entry)),)
        named.append(Pdo(pdo.index, entries))
    return named


def _with_name(entry: PdoEntry) -> Conversation[PdoEntry]:
    if entry.name or not entry.index:
        return entry
    try:
        text = yield from coe_client.entry_description(entry.index, entry.subindex, 0)
    except (SdoAbortError, MailboxProtocolError):
        return entry
    return PdoEntry(entry.index, entry.subindex, entry.bit_length, text.name, text.data_type)


def _read_list(index: int, size: int) -> Conversation[list[int]]:
    octets = yield from coe_client.upload(index, 0)
    count = int.from_bytes(octets, "little")
    if len(octets) not in {1, 2} or count > MAX_ENTRIES:
        raise MailboxProtocolError(
            f"{ObjectId(index)} is {octets.hex()}, expected a count up to {MAX_ENTRIES}"
        )
    numbers = []
    for subindex in range(1, count + 1):
        octets = yield from coe_client.upload(index, subindex)
        if len(octets) != size:
            raise MailboxProtocolError(
                f"{ObjectId(index, subindex)} has {len(octets)} bytes, expected {size}"
            )
        numbers.append(int.from_bytes(octets, "little"))
    return numbers


def _write_list(
    index: int, numbers: Sequence[int], size: int, sizes: MailboxSizes
) -> Conversation[None]:
    # Subindex 0 is cleared first: entries of a mapping or assignment are writable only then, and
    # the new count makes them valid.
    try:
        yield from coe_client.download(index, 0, b"\0", sizes)
    except SdoAbortError:
        if (yield from _read_list(index, size)) != list(numbers):
            raise
        return  # fixed, and as wanted
    for subindex, number in enumerate(numbers, 1):
        yield from coe_client.download(index, subindex, number.to_bytes(size, "little"), sizes)
    yield from coe_client.download(index, 0, bytes((len(numbers),)), sizes)
