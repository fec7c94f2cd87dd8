"""Records of an EtherCAT network information (ENI): the slaves of one bus."""

from __future__ import annotations

from collections.abc import Mapping

import msgspec

from eap.codec.xmlstream import XmlElement
from eap.od.slave_config import IdnWrite, MappedObject, SdoWrite


class EniSyncManager(msgspec.Struct, frozen=True, kw_only=True):
    """Sync manager of a slave; *size* in bytes, 0 if the file does not say."""

    start: int
    control: int
    size: int = 0
    is_enabled: bool = True
    is_output: bool
    is_mailbox: bool = False
    pdos: tuple[int, ...] | None = None
    """PDOs that it has; None if the file does not say."""
    bits: int | None = None
    """Bits that its FMMU maps; None without one."""


class EniSync(msgspec.Struct, frozen=True, kw_only=True):
    """SYNC0 and SYNC1; times in nanoseconds."""

    activate: int | None
    """Registers 0x0980 and 0x0981; None if no command writes them."""
    cycle0_ns: int
    cycle1_ns: int
    shift_ns: int


class EniSlave(msgspec.Struct, frozen=True, kw_only=True):
    """One slave.

    Attributes:
        name: As in the file.
        line: In the file.
        address: Station address; 0 if the file has none.
        vendor: Vendor ID.
        product: Product code.
        revision: Revision.
        serial: Serial number; 0 for any.
        type: Type of the device, EL2004; may be empty.
        managers: Sync managers by number.
        pdos: Elements RxPdo and TxPdo.
        bootstrap: Mailboxes of the state BOOT as the EEPROM has them; empty without one.
        protocols: Protocols of its mailbox, in lower case.
        writes: Start-up writes, without those of PDOs.
        refused: Start-up commands that are not clear, in words.
        assigns: PDO assignment that is written by SDO.
        mapping: PDO mapping that is written by SDO.
        has_clock: It has a distributed clock.
        sync: Its SYNC0 and SYNC1; None without.
        timeouts: Of state changes, by keys of a bus file.
        previous: Port and station address of the slave before.
        group: Hot-connect group; empty for none.
        members: Slaves of that group.
        identification: Register and value by which the group is found; None for none.
        by_vendor: It has the settings of its vendor's description, not of an ENI file.
        any_revision: The file checks vendor and product, but not the revision.
        output_bits: Bits that it takes; 0 if the file does not say.
        input_bits: Bits that it gives.
    """

    name: str
    line: int
    address: int
    vendor: int
    product: int
    revision: int
    serial: int = 0
    type: str = ""
    managers: Mapping[int, EniSyncManager] = {}
    pdos: tuple[XmlElement, ...] = ()
    bootstrap: bytes = b""
    protocols: frozenset[str] = frozenset()
    writes: tuple[SdoWrite | IdnWrite, ...] = ()
    refused: tuple[str, ...] = ()
    assigns: Mapping[int, tuple[int, ...]] = {}
    mapping: Mapping[int, tuple[MappedObject, ...]] = {}
    has_clock: bool = False
    sync: EniSync | None = None
    timeouts: Mapping[str, int] = {}
    previous: tuple[str, int] | None = None
    group: str = ""
    members: int = 1
    identification: tuple[int, int] | None = None
    by_vendor: bool = False
    any_revision: bool = False
    output_bits: int = 0
    input_bits: int = 0


class EniVariable(msgspec.Struct, frozen=True):
    """Variable of the process image; its offset orders it among those of its slave."""

    name: str
    type: str
    bits: int
    offset: int
    is_output: bool


class EniBus(msgspec.Struct, frozen=True, kw_only=True):
    """The bus of one file, in the order of the file."""

    file: str
    name: str = ""
    slaves: tuple[EniSlave, ...] = ()
    variables: tuple[EniVariable, ...] = ()
    cycle_us: int = 0
    """Shortest cycle; 0 if the file does not say."""
