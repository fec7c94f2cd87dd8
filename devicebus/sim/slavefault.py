"""Faults inside one slave, as functions of slave, description, time, and whether it begins."""

from __future__ import annotations

from collections.abc import Callable

from devicebus.mailbox.coe_server import CoeServer
from devicebus.mailbox.foe_server import FoeServer
from devicebus.sim.devices.objects import parse_entry
from devicebus.sim.faultydictionary import FaultyDictionary
from devicebus.sim.slave import Slave
from devicebus.sim.spec import FaultKind, FaultSpec
from devicebus.wire.alstatus import AlState, AlStatusCode
from eap.codec.mailbox import MailboxType
from eap.od.abort import AbortCode


def _mailbox(slave: Slave, spec: FaultSpec, now_ns: int, on: bool) -> None:
    del spec, now_ns
    slave.esc.channels[0].is_stuck = on


def _foe(slave: Slave, spec: FaultSpec, now_ns: int, on: bool) -> None:
    del now_ns
    mailbox = slave.device.mailbox
    server = mailbox.protocols.get(MailboxType.FOE) if mailbox else None
    if isinstance(server, FoeServer):
        server.packet_time_ns = 1000 * spec.delay_us if on else 0


def _sdo(slave: Slave, spec: FaultSpec, now_ns: int, on: bool) -> None:
    del now_ns
    dictionary = slave.device.dictionary
    if isinstance(dictionary, FaultyDictionary):
        index, _ = parse_entry(spec.object)
        dictionary.aborts.pop(index, None)
        if on:
            dictionary.aborts[index] = spec.code or AbortCode.GENERAL


def _emergency(slave: Slave, spec: FaultSpec, now_ns: int, on: bool) -> None:
    """Report an error code, and with the end of the fault that there is none any more."""
    del now_ns
    mailbox = slave.device.mailbox
    server = mailbox.protocols.get(MailboxType.COE) if mailbox else None
    if isinstance(server, CoeServer):
        server.send_emergency(spec.code & 0xFFFF if on else 0, int(on))


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
    FaultKind.EMERGENCY: _emergency,
    FaultKind.AL_ERROR: _al_error,
    FaultKind.REFUSE: _refuse,
    FaultKind.DRIFT: _drift,
}
