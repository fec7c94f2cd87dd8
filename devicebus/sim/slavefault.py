"""Faults inside one slave, as functions of slave, description, time, and whether it begins."""

from __future__ import annotations

from collections.abc import Callable

from devicebus.mailbox.coe_server import CoeServer
from devicebus.mailbox.foe_server import FoeServer
from devicebus.sim.devices.drive import Axes
from devicebus.sim.devices.pdoobjects import TX_PDO
from devicebus.sim.faultydictionary import FaultyDictionary
from devicebus.sim.slave import Slave
from devicebus.sim.spec import FaultKind, FaultSpec
from devicebus.wire.alstatus import AlState, AlStatusCode
from eap.codec.mailbox import MailboxType
from eap.ids import ObjectId
from eap.od.abort import AbortCode


def _mailbox(slave: Slave, spec: FaultSpec, now_ns: int, on: bool) -> None:
    del spec, now_ns
    slave.esc.channels[0].is_stuck = on


def _foe(slave: Slave, spec: FaultSpec, now_ns: int, on: bool) -> None:
    """Be busy with every message, or refuse every request with a code."""
    del now_ns
    mailbox = slave.device.mailbox
    server = mailbox.protocols.get(MailboxType.FOE) if mailbox else None
    if isinstance(server, FoeServer):
        server.packet_time_ns = 1000 * spec.delay_us if on else 0
        server.refuses = spec.code if on else 0


def _sdo(slave: Slave, spec: FaultSpec, now_ns: int, on: bool) -> None:
    del now_ns
    dictionary = slave.device.dictionary
    if isinstance(dictionary, FaultyDictionary):
        index, _ = ObjectId.parse(spec.object)
        dictionary.aborts.pop(index, None)
        if on:
            dictionary.aborts[index] = spec.code or AbortCode.GENERAL


def _emergency(slave: Slave, spec: FaultSpec, now_ns: int, on: bool) -> None:
    """Report an error code, and with the end of the fault that there is none any more.

    The axis of a drive fails besides, until it is reset.
    """
    del now_ns
    device = slave.device
    code = spec.code & 0xFFFF if on else 0
    drives = device.behaviour.drives if isinstance(device.behaviour, Axes) else ()
    if code and spec.axis < len(drives):
        drives[spec.axis].fail(code)
    else:
        device.report_error(code, axis=spec.axis)


def _tx_pdo(slave: Slave, spec: FaultSpec, now_ns: int, on: bool) -> None:
    """Send a TxPDO through the mailbox that nobody asked for."""
    del now_ns
    mailbox = slave.device.mailbox
    server = mailbox.protocols.get(MailboxType.COE) if mailbox else None
    index, _ = ObjectId.parse(spec.object)
    data = slave.device.process_data.read_pdo(index)
    if on and isinstance(server, CoeServer) and data is not None:
        server.send_tx_pdo(index - TX_PDO, data)


def _eeprom(slave: Slave, spec: FaultSpec, now_ns: int, on: bool) -> None:
    """Slow the EEPROM down; without a delay it acknowledges nothing."""
    del now_ns
    eeprom = slave.esc.eeprom
    eeprom.extra_ns = 1000 * spec.delay_us if on else 0
    eeprom.is_broken = on and not spec.delay_us


def _al_error(slave: Slave, spec: FaultSpec, now_ns: int, on: bool) -> None:
    del now_ns
    if on:
        slave.fail(spec.code or AlStatusCode.UNSPECIFIED)


def _refuse(slave: Slave, spec: FaultSpec, now_ns: int, on: bool) -> None:
    del now_ns
    state = AlState[spec.state]
    slave.refuses.pop(state, None)
    if on:
        slave.refuses[state] = spec.code or AlStatusCode.UNSPECIFIED


def _drift(slave: Slave, spec: FaultSpec, now_ns: int, on: bool) -> None:
    drift_ppm = spec.drift_ppm if on else slave.esc.settings.drift_ppm
    slave.esc.clock.set_drift(drift_ppm, now_ns)


SLAVE_FAULTS: dict[FaultKind, Callable[[Slave, FaultSpec, int, bool], None]] = {
    FaultKind.MAILBOX: _mailbox,
    FaultKind.FOE: _foe,
    FaultKind.SDO: _sdo,
    FaultKind.EEPROM: _eeprom,
    FaultKind.EMERGENCY: _emergency,
    FaultKind.TX_PDO: _tx_pdo,
    FaultKind.AL_ERROR: _al_error,
    FaultKind.REFUSE: _refuse,
    FaultKind.DRIFT: _drift,
}
