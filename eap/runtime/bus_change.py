"""Words for the changes of buses: settings of the port, and of each slave by its name."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import NamedTuple

import msgspec

from eap.codec.soe import Idn
from eap.ids import NetId, ObjectId
from eap.od.slave_config import (
    BY_SERIAL,
    ID_REGISTER,
    US,
    OpMode,
    SdoWrite,
    SlaveConfig,
)
from eap.pd.handover import restarting_buses
from eap.pd.spec import (
    BusPortSpec,
    BusSlaveSpec,
    EoeSpec,
    GatewaySpec,
    PortKind,
    PortSpec,
    StationSpec,
)

_NONE = "none"
_LONGEST = 60
"""Characters of a value."""
_OF_PORT = (
    "target", "clocks", "lock_cycle", "sync_lead_us", "frame_timeout_us", "frame_retries",
)  # fmt: skip
"""Keys of a bus port that its master is started with."""


def describe_bus_changes(old: StationSpec, new: StationSpec) -> Iterator[str]:
    """Yield the effect on each bus that changes, and what changes there, a line each."""
    before = {port.name: port for port in old.ports if port.kind is PortKind.BUS}
    after = {port.name: port for port in new.ports if port.kind is PortKind.BUS}
    restarting = restarting_buses(old, new)
    for name in before.keys() - after.keys():
        yield f"{name}: removed, its slaves go to INIT"
    for name, port in after.items():
        bus, was = port.bus or BusPortSpec(), before.get(name)
        if was is None:
            yield f"{name}: added at {port.interface}, {len(bus.slaves)} slaves go to {bus.target}"
            continue
        old_bus = was.bus or BusPortSpec()
        if name in restarting:
            yield f"{name} restarts: its slaves go to INIT, and to {bus.target} again"
        elif opening_of(was) != opening_of(port):
            yield f"{name}: its gateway and ADS ports are opened again, its slaves go on"
        yield from _differences(name, _of_services(was), _of_services(port))
        if name in restarting:
            if old.cycle_us != new.cycle_us and bus.has_sync:
                yield f"{name}: cycle_us {old.cycle_us} -> {new.cycle_us}"
            yield from _differences(name, _of_port(was), _of_port(port))
            yield from _slave_changes(name, old_bus, bus)


def _slave_changes(port: str, old: BusPortSpec, new: BusPortSpec) -> Iterator[str]:
    before = {slave.name: slave for slave in old.slaves}
    after = {slave.name: slave for slave in new.slaves}
    yield from (f"{port}.{name}: removed" for name in before if name not in after)
    for name, slave in after.items():
        if name not in before:
            kind = "optional, " if slave.config.optional else ""
            yield f"{port}.{name}: added, {kind}station address {slave.station}"
        else:
            yield from _differences(f"{port}.{name}", _of_slave(before[name]), _of_slave(slave))


def _differences(where: str, old: Mapping[str, str], new: Mapping[str, str]) -> Iterator[str]:
    for label in dict.fromkeys((*old, *new)):
        was, becomes = old.get(label, _NONE), new.get(label, _NONE)
        if was != becomes:
            yield f"{where}: {label} {_shortened(was)} -> {_shortened(becomes)}"


def _shortened(text: str) -> str:
    return text if len(text) <= _LONGEST else f"{text[:_LONGEST]}…"


def _of_port(port: PortSpec) -> dict[str, str]:
    bus = port.bus or BusPortSpec()
    found = {"interface": str(port.interface), "redundant": bus.redundant or _NONE}
    if bus.simulated:
        found["simulated slaves"] = f"version {bus.simulated[:8]}"
    return found | {key: str(getattr(bus, key)) for key in _OF_PORT}


class BusOpening(NamedTuple):
    """Values of a bus port for which, if one changes, its services are opened anew."""

    net_id: NetId
    own_port: int
    is_full: bool
    is_padded: bool
    eoe: EoeSpec | None


def opening_of(port: PortSpec) -> BusOpening:
    """Return these values of a bus port."""
    gateway = port.gateway or GatewaySpec()
    return BusOpening(port.net_id, gateway.port, gateway.full, gateway.padded, port.eoe)


def _of_services(port: PortSpec) -> dict[str, str]:
    """Return what services adds to a bus beside its gateway, whose settings have own lines."""
    eoe = port.eoe
    interface = _NONE if eoe is None else f"{eoe.interface} {eoe.address}".strip()
    found = {"net_id": str(port.net_id), "eoe": interface}
    if eoe is not None:
        found["eoe connects"] = "all" if eoe.connects_all else "named slaves"
    for slave in () if eoe is None else eoe.slaves:
        found[f"eoe of {slave.slave}"] = slave.ip or "connected"
    return found


def _of_slave(slave: BusSlaveSpec) -> dict[str, str]:
    """Return all that is expected of a slave and configured there, as texts by their names."""
    config = slave.config
    revision = _NONE if slave.revision is None else config.revision_rule.describe(slave.revision)
    found = {
        "station address": str(slave.station),
        "vendor": f"0x{slave.vendor:08X}",
        "product": f"0x{slave.product:08X}",
        "revision": revision,
        "serial": str(slave.serial or _NONE),
        "alias": str(slave.alias or _NONE),
    }
    for side, entries in (("outputs", slave.outputs), ("inputs", slave.inputs)):
        found[side] = ", ".join(_entry(e.index, e.subindex, e.bit_length) for e in entries) or _NONE
    return found | _of_config(config)


def _of_config(config: SlaveConfig) -> dict[str, str]:
    found = {
        "optional": str(config.optional).lower(),
        "group": config.group or _NONE,
        "identification": _identification(config.identification),
        "SYNC": _sync(config.sync),
        "PDO assignment": "fixed" if config.fixed_pdos else "written",
    }
    for manager, pdos in config.assignment.items():
        found[f"PDOs of sync manager {manager}"] = ", ".join(f"0x{pdo:04X}" for pdo in pdos)
    for pdo, entries in config.mapping.items():
        texts = (_entry(each.index, each.subindex, each.bit_length) for each in entries)
        found[f"mapping of 0x{pdo:04X}"] = ", ".join(texts)
    for key, settings in (("watchdog", config.watchdogs), ("timeouts", config.timeouts)):
        for name, value in msgspec.structs.asdict(settings).items():
            found[f"{key}.{name}"] = _NONE if value is None else str(value)
    for write in config.writes:
        if isinstance(write, SdoWrite):
            target = str(ObjectId(write.index, write.subindex)) + " complete" * write.complete
        else:
            target = f"{Idn.of(write.idn)}" + (f" of drive {write.drive}" if write.drive else "")
        for transition in write.at:
            label = f"start-up write {transition} {target}"
            # An object may be written more than once in one transition: the order counts.
            earlier = f"{found[label]}, " if label in found else ""
            found[label] = earlier + (write.data.hex(" ") or "empty")
    return found


def _entry(index: int, subindex: int, bits: int) -> str:
    return f"{ObjectId(index, subindex)}/{bits}" if index else f"0/{bits}"


def _identification(register: int) -> str:
    names = {BY_SERIAL: "serial", ID_REGISTER: "id"}
    return names.get(register, f"0x{register:04X}")


def _sync(mode: OpMode | None) -> str:
    """Return an operation mode of the clock in words."""
    if mode is None or not mode.activate >> 8:
        return "off"
    times = {
        "cycle0": mode.cycle0_ns, "shift0": mode.shift0_ns,
        "cycle1": mode.cycle1_ns, "shift1": mode.shift1_ns,
    }  # fmt: skip
    factors = {
        "factor0": mode.factor0, "shift factor": mode.shift0_factor, "factor1": mode.factor1,
    }  # fmt: skip
    shown = [f"{name} {ns / US:g} us" for name, ns in times.items() if ns]
    shown += [f"{name} {factor}" for name, factor in factors.items() if factor]
    return f"0x{mode.activate:04X} ({', '.join(shown)})"
