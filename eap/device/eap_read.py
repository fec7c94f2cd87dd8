"""From the objects of a station's EAP ports back to its specification: what the engine is to run.

This is the check of PreOp to SafeOp (ETG.1005): all references are followed, and whatever cannot
run is refused with the object that it is about.  What is not enabled is left out.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from msgspec.structs import replace

from eap.device.eap_check import Found, check_station
from eap.device.eap_content import COUNTED, bus_variables
from eap.device.eap_dictionary import EapDictionary
from eap.device.eap_records import PortReader
from eap.device.fault import FaultCode
from eap.device.pdlayout import types_of
from eap.od.profiles.eap1000keys import (
    Configured,
    Var,
)
from eap.pd.spec import RxPdSpec, StationSpec, VariableSpec


def read_back(station: StationSpec, dictionaries: Mapping[str, EapDictionary]) -> StationSpec:
    """Return what *station* is with its EAP ports as *dictionaries* say.

    What stood in *station* keeps its place, new things come behind; so what was filled from a
    specification reads back as that specification.

    Args:
        station: Ports, buses, sources, links, and alternates of RxPDs, which are in no dictionary.
        dictionaries: By name of the port; EAP ports that are missing here send and receive nothing.

    Raises:
        DeviceFault: it cannot run.
    """
    ports = [port for port in station.ports if port.name in dictionaries]
    readers = [PortReader(dictionaries[port.name]) for port in ports]
    found_ports = {reader.name: reader.port() for reader in readers}
    cycle_us, phase_us = _times(station, readers)
    variables = _variables(station, readers)
    frames = [Found(r.name, *pair) for r in readers for pair in r.frames()]
    pds = [Found(r.name, index, pd, frame) for r in readers for index, pd, frame in r.sent]
    subscriptions = [Found(r.name, *pair) for r in readers for pair in r.subscriptions()]
    spec = replace(
        station,
        cycle_us=cycle_us,
        phase_us=phase_us,
        ports=tuple(found_ports.get(port.name, port) for port in station.ports),
        variables=_in_order(variables, station.variables),
        frames=_in_order([each.record for each in frames], station.frames),
        subscriptions=_in_order([each.record for each in subscriptions], station.subscriptions),
    )
    check_station(station, spec, frames, pds, subscriptions)
    return _with_alternates(spec, station)


def _with_alternates(spec: StationSpec, station: StationSpec) -> StationSpec:
    """Return *spec* with the alternates of those RxPDs that are laid out as *station* has them."""
    types = types_of(station)
    known = {_expected(pd, types): pd.alternates for pd in station.subscriptions if pd.alternates}
    if not known:
        return spec
    types = types_of(spec)
    pds = (replace(pd, alternates=known.get(_expected(pd, types), ())) for pd in spec.subscriptions)
    return replace(spec, subscriptions=tuple(pds))


def _expected(pd: RxPdSpec, types: Mapping[str, str]) -> tuple[object, ...]:
    variables = tuple((name, types[name]) for name in pd.variables)
    return pd.name, pd.port, pd.publisher, pd.pd_id, pd.version, variables


def _in_order(records: list[Any], before: tuple[Any, ...]) -> tuple[Any, ...]:
    places = {each.name: place for place, each in enumerate(before)}
    return tuple(sorted(records, key=lambda each: places.get(each.name, len(places))))


def _times(station: StationSpec, readers: list[PortReader]) -> tuple[int, int]:
    """Return device cycle and phase, which all ports have to agree on."""
    found = [reader.times() for reader in readers] or [(station.cycle_us, station.phase_us)]
    for reader, times in zip(readers, found, strict=False):
        if times != found[0]:
            detail = f"{times[0]} us at {times[1]}, but {found[0][0]} at {found[0][1]} on another"
            subindex = Configured.DEVICE_CYCLE_TIME
            raise reader.fault(FaultCode.CYCLE_TIME, f"{detail} port", COUNTED, subindex)
        if times[1] >= times[0]:
            detail = f"phase {times[1]} us is not within the cycle of {times[0]}"
            raise reader.fault(FaultCode.CYCLE_TIME, detail, COUNTED, Configured.PHASE)
    return found[0]


def _variables(station: StationSpec, readers: list[PortReader]) -> list[VariableSpec]:
    """Return the variables of all ports and of the buses; equal ones of several ports are one."""
    on_bus = bus_variables(station)
    merged = {each.name: each for each in station.variables if each.name in on_bus}
    for reader in readers:
        own: set[str] = set()
        for index, variable in reader.variables():
            if variable.name in own or merged.get(variable.name, variable) != variable:
                elsewhere = "" if variable.name in own else ", and differs there"
                detail = f"{variable.name} exists in the station{elsewhere}"
                raise reader.fault(FaultCode.NAME_TWICE, detail, index, Var.NAME)
            own.add(variable.name)
            merged[variable.name] = variable
    return list(merged.values())
