"""What the control protocol can be asked for about EAP devices: objects, states, configurations."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from functools import partial
from typing import Any, NamedTuple

import msgspec

from eap.appliance import control_device as words
from eap.appliance.control import ErrorCode, of_station, parameters
from eap.appliance.control_bus import to_octets
from eap.appliance.services.device.station_device import StationDevice
from eap.device.eap_dictionary import EapDictionary
from eap.device.router_dictionary import RouterDictionary
from eap.errors import ControlError
from eap.near import near
from eap.od.model import Access, OdObject
from eap.od.profiles import eap1000 as profile
from eap.od.profiles.router9000 import ROUTER

_FLAGS = {
    "rx": Access.RX_MAPPABLE,
    "tx": Access.TX_MAPPABLE,
    "backup": Access.BACKUP,
    "settings": Access.SETTINGS,
}


class DeviceMethods:
    """Answers for the devices of all stations of the appliance.

    Args:
        devices: By station.
        routers: What the routers of these stations are.
        plant_file: With which the appliance was started.
    """

    def __init__(
        self,
        devices: Mapping[str, StationDevice],
        routers: Mapping[str, RouterDictionary],
        plant_file: str,
    ) -> None:
        self._devices = devices
        self._routers = routers
        self._plant_file = plant_file

    def table(self) -> dict[str, Callable[[dict[str, Any]], Any]]:
        """Return the methods by name; results may have to be waited for.

        Raises:
            ControlError: (every method) there is no such target, or the parameters are wrong.
            SdoAbortError: (od_… methods) the dictionary refuses.
        """
        return {
            "od_list": self._list,
            "od_describe": self._describe,
            "od_read": self._read,
            "od_write": self._write,
            "od_dump": self._dump,
            "state": self._state,
            "request_state": self._request_state,
            "export": self._export,
            "plan": self._plan,
            "apply": self._apply,
            "rollback": self._roll_back,
        }

    def _list(self, params: dict[str, Any]) -> dict[str, Any]:
        wanted = parameters(params, words.OdListParameters)
        dictionary = self._find(wanted.target).dictionary
        flag = _FLAGS.get(wanted.list)
        chosen = (
            item
            for item in dictionary
            if flag is None or any(each.access & flag for each in item.entries.values())
        )
        return _page(chosen, wanted.first, partial(_object_row, dictionary))

    def _describe(self, params: dict[str, Any]) -> dict[str, Any]:
        wanted = parameters(params, words.OdDescribeParameters)
        dictionary = self._find(wanted.target).dictionary
        if isinstance(dictionary, EapDictionary):
            item = _existing_or_new(dictionary, wanted.index, wanted.subindex)
        else:
            item = dictionary[wanted.index]
        rows = [words.entry_row(*each) for each in item.entries.items()]
        return _object_row(dictionary, item) | {"entries": rows}

    def _read(self, params: dict[str, Any]) -> dict[str, Any]:
        wanted = parameters(params, words.OdReadParameters)
        found = self._find(wanted.target)
        read = found.dictionary.upload_complete if wanted.complete else found.dictionary.upload
        return {"data": read(wanted.index, wanted.subindex, found.device.od_state()).hex()}

    async def _write(self, params: dict[str, Any]) -> dict[str, Any]:
        wanted = parameters(params, words.OdWriteParameters)
        found = self._find(wanted.target)
        place, data = (wanted.index, wanted.subindex), to_octets(wanted.data)
        if isinstance(found.dictionary, EapDictionary):
            await found.device.download(found.port, *place, data, complete=wanted.complete)
        else:
            found.dictionary.download(*place, data, found.device.od_state())
        return {}

    def _dump(self, params: dict[str, Any]) -> dict[str, Any]:
        wanted = parameters(params, words.OdDumpParameters)
        found = self._find(wanted.target)
        dictionary, state = found.dictionary, found.device.od_state()

        def row(item: OdObject) -> dict[str, Any]:
            entries = [
                words.entry_row(subindex, entry)
                | {"data": entry.octets.hex() if entry.access & state.read_right else None}
                for subindex, entry in item.entries.items()
            ]
            return _object_row(dictionary, item) | {"entries": entries}

        return _page(dictionary, wanted.first, row)

    def _state(self, params: dict[str, Any]) -> dict[str, Any]:
        found = self._find(parameters(params, words.TargetParameters).target)
        return words.state_document(found.device.status)

    async def _request_state(self, params: dict[str, Any]) -> dict[str, Any]:
        wanted = parameters(params, words.RequestStateParameters)
        device = self._find(wanted.target).device
        return words.state_document(await device.request_state(words.state_of(wanted.state)))

    def _export(self, params: dict[str, Any]) -> dict[str, Any]:
        device = self._device(parameters(params, words.StationParameters).station)
        return words.export_document(device.spec, *device.last_change)

    async def _plan(self, params: dict[str, Any]) -> dict[str, Any]:
        wanted = parameters(params, words.SpecParameters)
        return words.plan_document(await self._device(wanted.station).plan(wanted.spec))

    async def _apply(self, params: dict[str, Any]) -> dict[str, Any]:
        wanted = parameters(params, words.ApplyParameters)
        is_own = bool(wanted.file) and wanted.file == self._plant_file
        change = self._device(wanted.station).apply(wanted.spec, wanted.cause, of_plant_file=is_own)
        return words.outcome_document(*await change)

    async def _roll_back(self, params: dict[str, Any]) -> dict[str, Any]:
        wanted = parameters(params, words.RollbackParameters)
        return words.outcome_document(*await self._device(wanted.station).roll_back(wanted.spec))

    def _device(self, station: str) -> StationDevice:
        return of_station(station, self._devices)

    def _find(self, target: str) -> _Target:
        """Return who is meant by a target; raise ControlError that says which there are."""
        station, _, port = target.partition("/")
        device = self._device(station)
        ports = list(device.dictionaries)
        if port == ROUTER and port not in ports:
            return _Target(device, port, self._routers[station])
        if not ports:
            reason = f"station {station} has no EAP port; the dictionary of its router is at"
            raise _unknown(f"{reason} {station}/{ROUTER}")
        port = port or ports[0]
        if port not in ports:
            known = f"its EAP ports are {', '.join(ports)}"
            raise _unknown(f"{target} has no dictionary; {known}{near(port, [*ports, ROUTER])}")
        return _Target(device, port, device.dictionaries[port])


class _Target(NamedTuple):
    """Whose dictionary is meant."""

    device: StationDevice
    port: str
    dictionary: EapDictionary | RouterDictionary


def _object_row(dictionary: EapDictionary | RouterDictionary, item: OdObject) -> dict[str, Any]:
    is_there = item.index in dictionary
    return words.object_row(item, dictionary.name_of(item.index) if is_there else "")


def _page(
    items: Iterable[OdObject], first: int, row: Callable[[OdObject], dict[str, Any]]
) -> dict[str, Any]:
    """Return as many rows as one answer may have, and where to go on."""
    rows: list[dict[str, Any]] = []
    room = words.PAGE
    for item in items:
        if item.index < first:
            continue
        if room <= 0:
            return {"objects": rows, "next": item.index}
        rows.append(row(item))
        room -= len(msgspec.json.encode(rows[-1]))
    return {"objects": rows, "next": None}


def _existing_or_new(dictionary: EapDictionary, index: int, subindex: int | None) -> OdObject:
    """Return the object at *index* with an entry at *subindex*, as a download would make them."""
    row = profile.find(index)
    if row is None or not (row.dynamic or index in dictionary):
        return dictionary[index]
    first = row.list_row.subindex if row.list_row else 0x100
    last = subindex if subindex is not None and first <= subindex <= row.last_subindex else 0
    if index not in dictionary:
        return dictionary.make_object(row, index, last=last)
    item = dictionary[index]
    if last in item.entries or not last:
        return item
    entries = {**item.entries, last: dictionary.make_object(row, index, last=last).entries[last]}
    return OdObject(index, item.name, item.code, entries, data_type=item.data_type)


def _unknown(reason: str) -> ControlError:
    return ControlError(reason, code=ErrorCode.UNKNOWN_NAME)
