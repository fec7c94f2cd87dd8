"""The fixed parts of an EEPROM image as records (ETG.2010)."""

from __future__ import annotations

from typing import Annotated

from eap.codec.wire import Scalar, WireStruct, bit, bits2, u8, u16, u32

i16 = Annotated[int, Scalar("h")]


class SiiFixed(WireStruct, frozen=True):
    """ETG.2010 table 2: the first 64 words; offsets and sizes of mailboxes are in octets."""

    pdi_control: u16 = 0
    pdi_configuration: u16 = 0
    sync_impulse: u16 = 0
    pdi_configuration2: u16 = 0
    alias: u16 = 0
    reserved: Annotated[bytes, Scalar("4s")] = bytes(4)
    checksum: u16 = 0
    vendor: u32 = 0
    product: u32 = 0
    revision: u32 = 0
    serial: u32 = 0
    execution_delay: u16 = 0
    port0_delay: u16 = 0
    port1_delay: u16 = 0
    reserved_delay: u16 = 0
    boot_receive_offset: u16 = 0
    boot_receive_size: u16 = 0
    boot_send_offset: u16 = 0
    boot_send_size: u16 = 0
    receive_offset: u16 = 0
    """Of the mailbox that the master writes."""
    receive_size: u16 = 0
    send_offset: u16 = 0
    send_size: u16 = 0
    protocols: u16 = 0
    reserved_words: Annotated[bytes, Scalar("66s")] = bytes(66)
    size: u16 = 0
    """KiBit of the EEPROM, less one."""
    version: u16 = 1


class SiiGeneral(WireStruct, frozen=True):
    """ETG.2010 table 9: names by string number, protocol details, E-bus current in mA."""

    group: u8 = 0
    image: u8 = 0
    order: u8 = 0
    name: u8 = 0
    reserved: u8 = 0
    coe_sdo: bit = 0
    coe_info: bit = 0
    coe_pdo_assign: bit = 0
    coe_pdo_configuration: bit = 0
    coe_startup_upload: bit = 0
    coe_complete_access: bit = 0
    coe_reserved: bits2 = 0
    foe: u8 = 0
    eoe: u8 = 0
    soe_channels: u8 = 0
    ds402_channels: u8 = 0
    sysman_class: u8 = 0
    flags: u8 = 0
    ebus_current: i16 = 0
    group_copy: u8 = 0
    reserved_octet: u8 = 0
    port_physics: u16 = 0
    """Four bits a port: 0 none, 1 MII, 3 E-bus."""
    physical_memory_address: u16 = 0
    reserved_tail: Annotated[bytes, Scalar("12s")] = bytes(12)


class SiiSyncManager(WireStruct, frozen=True):
    """ETG.2010 table 11; *type* 1 mailbox out, 2 mailbox in, 3 outputs, 4 inputs."""

    start: u16
    length: u16
    control: u8
    status: u8 = 0
    enable: u8 = 1
    type: u8 = 0


class SiiPdoHeader(WireStruct, frozen=True):
    """ETG.2010 table 14: a PDO, in front of its entries."""

    index: u16
    entries: u8 = 0
    sync_manager: u8 = 0
    synchronization: u8 = 0
    name: u8 = 0
    flags: u16 = 0


class SiiPdoEntry(WireStruct, frozen=True):
    """ETG.2010 table 14: one mapped entry; index 0 is padding."""

    index: u16
    subindex: u8
    name: u8 = 0
    data_type: u8 = 0
    bit_length: u8 = 0
    flags: u16 = 0


class SiiDc(WireStruct, frozen=True):
    """ETG.2010: one operation mode of distributed clocks; times in nanoseconds."""

    sync0_cycle: u32 = 0
    sync0_shift: u32 = 0
    sync1_shift: u32 = 0
    sync1_factor: i16 = 0
    assign_activate: u16 = 0
    sync0_factor: i16 = 0
    name: u8 = 0
    description: u8 = 0
    reserved: u32 = 0
