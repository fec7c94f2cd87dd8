"""The registers of an EtherCAT slave controller (ETG.1000.4, and the ESC's data sheet)."""

from __future__ import annotations

from enum import IntEnum

from eap.codec.wire import WireStruct, bit, bits2, bits3, bits4, u8, u16, u32


class Register(IntEnum):
    """Register addresses; for one per port, FMMU or sync manager the address of the first."""

    TYPE = 0x0000
    FEATURES = 0x0008
    STATION_ADDRESS = 0x0010
    STATION_ALIAS = 0x0012
    DL_CONTROL = 0x0100
    DL_STATUS = 0x0110
    AL_CONTROL = 0x0120
    AL_STATUS = 0x0130
    AL_STATUS_CODE = 0x0134
    PDI_CONTROL = 0x0140
    ESC_CONFIGURATION = 0x0141
    ECAT_EVENT_MASK = 0x0200
    AL_EVENT_MASK = 0x0204
    ECAT_EVENT = 0x0210
    AL_EVENT = 0x0220
    RX_ERROR = 0x0300
    FORWARDED_RX_ERROR = 0x0308
    PROCESSING_UNIT_ERROR = 0x030C
    PDI_ERROR = 0x030D
    LOST_LINK = 0x0310
    WATCHDOG_DIVIDER = 0x0400
    WATCHDOG_PDI = 0x0410
    WATCHDOG_PROCESS_DATA = 0x0420
    WATCHDOG_STATUS = 0x0440
    WATCHDOG_COUNTER = 0x0442
    EEPROM_CONFIGURATION = 0x0500
    EEPROM_PDI_ACCESS = 0x0501
    EEPROM_CONTROL = 0x0502
    EEPROM_ADDRESS = 0x0504
    EEPROM_DATA = 0x0508
    FMMU = 0x0600
    SYNC_MANAGER = 0x0800
    DC_RECEIVE_TIME = 0x0900
    DC_SYSTEM_TIME = 0x0910
    DC_RECEIVE_TIME_ECAT = 0x0918
    DC_SYSTEM_TIME_OFFSET = 0x0920
    DC_SYSTEM_TIME_DELAY = 0x0928
    DC_SYSTEM_TIME_DIFFERENCE = 0x092C
    DC_SPEED_START = 0x0930
    DC_SPEED_DIFFERENCE = 0x0932
    DC_SYSTEM_TIME_FILTER = 0x0934
    DC_SPEED_FILTER = 0x0935
    DC_CYCLIC_UNIT = 0x0980
    DC_ACTIVATION = 0x0981
    DC_PULSE_LENGTH = 0x0982
    DC_ACTIVATION_STATUS = 0x0984
    DC_START_TIME = 0x0990
    DC_NEXT_SYNC1 = 0x0998
    DC_SYNC0_CYCLE = 0x09A0
    DC_SYNC1_CYCLE = 0x09A4
    MEMORY = 0x1000


class AlControl(WireStruct, frozen=True):
    """ETG.1000.6: AL control, the state that the master requests, at 0x0120."""

    state: bits4
    acknowledge: bit = 0
    identification: bit = 0
    reserved: bits2 = 0
    reserved_high: u8 = 0


class AlStatus(WireStruct, frozen=True):
    """ETG.1000.6: AL status and AL status code, the six bytes at 0x0130."""

    state: bits4
    error: bit = 0
    identification: bit = 0
    reserved: bits2 = 0
    reserved_high: u8 = 0
    reserved_word: u16 = 0
    code: u16 = 0


class DlStatus(WireStruct, frozen=True):
    """ETG.1000.4: links, loops and communication of the four ports, at 0x0110."""

    pdi_operational: bit = 0
    pdi_watchdog: bit = 0
    enhanced_link_detection: bit = 0
    reserved: bit = 0
    link: bits4 = 0
    """Bit n: physical link at port n."""
    loop0: bit = 0
    communication0: bit = 0
    loop1: bit = 0
    communication1: bit = 0
    loop2: bit = 0
    communication2: bit = 0
    loop3: bit = 0
    communication3: bit = 0


class SyncManager(WireStruct, frozen=True):
    """ETG.1000.4: one sync manager channel, eight bytes from 0x0800 on."""

    start: u16
    length: u16
    mode: bits2 = 0
    """0 buffered (three buffers), 2 mailbox."""
    direction: bits2 = 0
    """0 the master reads, 1 the master writes."""
    ecat_interrupt: bit = 0
    pdi_interrupt: bit = 0
    watchdog: bit = 0
    reserved: bit = 0
    status: u8 = 0
    enable: bit = 0
    repeat: bit = 0
    reserved_activate: bits4 = 0
    latch: bits2 = 0
    pdi_disable: bit = 0
    repeat_acknowledge: bit = 0
    reserved_pdi_low: bits3 = 0
    reserved_pdi_high: bits3 = 0


class SmStatus(IntEnum):
    """Bits of a sync manager's status byte."""

    WRITE_INTERRUPT = 0x01
    READ_INTERRUPT = 0x02
    MAILBOX_FULL = 0x08


class Fmmu(WireStruct, frozen=True):
    """ETG.1000.4: one fieldbus memory management unit, sixteen bytes from 0x0600 on.

    SII categories number the directions the other way round: 1 outputs, 2 inputs.
    """

    logical_start: u32
    length: u16
    logical_start_bit: u8 = 0
    logical_end_bit: u8 = 7
    physical_start: u16 = 0
    physical_start_bit: u8 = 0
    type: u8 = 0
    """Bit 0: the master reads (inputs); bit 1: the master writes (outputs)."""
    activate: u8 = 0
    reserved: u8 = 0
    reserved_word: u16 = 0


FMMU_READ = 1
FMMU_WRITE = 2


class EepromControl(WireStruct, frozen=True):
    """ETG.1000.4: SII control and status, at 0x0502."""

    write_enable: bit = 0
    reserved: bits4 = 0
    emulation: bit = 0
    read_eight: bit = 0
    """Reads give eight bytes instead of four."""
    two_byte_address: bit = 0
    command: bits3 = 0
    """1 read, 2 write, 4 reload."""
    crc_error: bit = 0
    loading: bit = 0
    command_error: bit = 0
    write_enable_error: bit = 0
    busy: bit = 0


class EepromCommand(IntEnum):
    """Values of EepromControl.command; any other combination of its bits is an error."""

    NONE = 0
    READ = 1
    WRITE = 2
    RELOAD = 4


class AlEvent(IntEnum):
    """Bits of the AL event register, at 0x0220; SM n has bit 8 + n."""

    AL_CONTROL = 0x01
    DC_LATCH = 0x02
    SYNC0 = 0x04
    SYNC1 = 0x08
    SM_ACTIVATION = 0x10
    EEPROM = 0x20
    WATCHDOG = 0x40
    SM0 = 0x100
