"""Methods of the control protocol about EAP devices: objects, states, configurations."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import Any, NamedTuple, TypeVar

import msgspec

from eap.control import device as records
from eap.control.bus import to_octets
from eap.control.protocol import ErrorCode, WriteOrigin, of_station
from eap.device.eap_dictionary import EapDictionary
from eap.device.live_dictionaries import RouterDictionary
from eap.errors import ControlError
from eap.od.model import Access, OdObject
from eap.od.profiles import eap1000 as profile
from eap.od.profiles.router9000 import ROUTER
from eap.services.device.station_device import StationDevice
from eap.suggest import suggest

RowT = TypeVar("RowT")

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
        deny_control: Returns the reason that a user of a bridge may not change the state of a
            station, empty if it may.
    """

    def __init__(
        self,
        devices: Mapping[str, StationDevice],
        routers: Mapping[str, RouterDictionary],
        plant_file: str,
        deny_control: Callable[[str, WriteOrigin], str] = lambda *_: "",
    ) -> None:
        self._devices = devices
        self._routers = routers
        self._plant_file = plant_file
        self._deny_control = deny_control

    def table(self) -> dict[str, Callable[[dict[str, Any]], Any]]:
        """Return the methods by name; results may have to be waited for.

        Raises:
            ControlError: (every method) there is no such target, or the parameters are wrong.
            SdoAbortError: (od_… methods) the dictionary refuses.
        """
        return dict(
            (
                records.OD_LIST.served_by(self._list),
                records.OD_DESCRIBE.served_by(self._describe),
                records.OD_READ.served_by(self._read),
                records.OD_WRITE.served_by(self._write),
                records.OD_DUMP.served_by(self._dump),
                records.STATE.served_by(self._state),
                records.REQUEST_STATE.served_by(self._request_state),
                records.EXPORT.served_by(self._export),
                records.PLAN.served_by(self._plan),
                records.APPLY.served_by(self._apply),
                records.ROLLBACK.served_by(self._roll_back),
            )
        )

    def _list(self, wanted: records.OdListParameters) -> records.ObjectPage:
        dictionary = self._find(wanted.target).dictionary
        flag = _FLAGS.get(wanted.list)
        chosen = (
            item
            for item in dictionary
            if flag is None or any(each.access & flag for each in item.entries.values())
        )
        return records.ObjectPage(
            *_page(
                chosen,
                wanted.first,
                lambda item: records.object_row(item, _label(dictionary, item)),
            )
        )

    def _describe(self, wanted: records.OdDescribeParameters) -> records.DescribedObject:
        dictionary = self._find(wanted.target).dictionary
        if isinstance(dictionary, EapDictionary):
            item = _existing_or_new(dictionary, wanted.index, wanted.subindex)
        else:
            item = dictionary[wanted.index]
        return records.described_object(item, _label(dictionary, item))

    def _read(self, wanted: records.OdReadParameters) -> records.EntryData:
        found = self._find(wanted.target)
        read = found.dictionary.upload_complete if wanted.complete else found.dictionary.upload
        return records.EntryData(read(wanted.index, wanted.subindex, found.device.od_state()).hex())

    async def _write(self, wanted: records.OdWriteParameters) -> records.EmptyAnswer:
        found = self._find(wanted.target)
        place, data = (wanted.index, wanted.subindex), to_octets(wanted.data)
        if isinstance(found.dictionary, EapDictionary):
            await found.device.download(found.port, *place, data, complete=wanted.complete)
        else:
            found.dictionary.download(*place, data, found.device.od_state())
        return records.EmptyAnswer()

    def _dump(self, wanted: records.OdDumpParameters) -> records.DumpPage:
        found = self._find(wanted.target)
        dictionary, right = found.dictionary, found.device.od_state().read_right
        return records.DumpPage(
            *_page(
                dictionary,
                wanted.first,
                lambda item: records.dumped_object(item, _label(dictionary, item), right),
            )
        )

    def _state(self, wanted: records.TargetParameters) -> records.StateAnswer:
        return records.state_answer(self._find(wanted.target).device.status)

    async def _request_state(self, wanted: records.RequestStateParameters) -> records.StateAnswer:
        device = self._find(wanted.target).device
        if (origin := wanted.origin) is not None:
            station = wanted.target.partition("/")[0]
            if why := self._deny_control(station, origin):
                raise ControlError(f"station {station}: {why}", code=ErrorCode.REFUSED)
        return records.state_answer(await device.request_state(records.state_of(wanted.state)))

    def _export(self, wanted: records.StationParameters) -> records.RunningSpec:
        device = self._device(wanted.station)
        return records.running_spec(device.spec, *device.last_change)

    async def _plan(self, wanted: records.SpecParameters) -> records.PlanAnswer:
        return records.plan_answer(await self._device(wanted.station).plan(wanted.spec))

    async def _apply(self, wanted: records.ApplyParameters) -> records.ApplyAnswer:
        is_own = bool(wanted.file) and wanted.file == self._plant_file
        change = self._device(wanted.station).apply(wanted.spec, wanted.cause, of_plant_file=is_own)
        return records.apply_answer(*await change)

    async def _roll_back(self, wanted: records.RollbackParameters) -> records.ApplyAnswer:
        return records.apply_answer(*await self._device(wanted.station).roll_back(wanted.spec))

    def _device(self, station: str) -> StationDevice:
        return of_station(station, self._devices)

    def _find(self, target: str) -> _Target:
        """Return the device and dictionary of a target; raise ControlError with the known ones."""
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
            raise _unknown(f"{target} has no dictionary; {known}{suggest(port, [*ports, ROUTER])}")
        return _Target(device, port, device.dictionaries[port])


class _Target(NamedTuple):
    """Dictionary that a target names, with its device."""

    device: StationDevice
    port: str
    dictionary: EapDictionary | RouterDictionary


def _label(dictionary: EapDictionary | RouterDictionary, item: OdObject) -> str:
    return dictionary.name_of(item.index) if item.index in dictionary else ""


def _page(
    items: Iterable[OdObject], first: int, row: Callable[[OdObject], RowT]
) -> tuple[list[RowT], int | None]:
    """Return as many rows as one answer may have, and the index at which it goes on."""
    rows: list[RowT] = []
    budget = records.PAGE
    for item in items:
        if item.index < first:
            continue
        # The last row may exceed the page: the longest line has room for 32 pages.
        if budget <= 0:
            return rows, item.index
        rows.append(row(item))
        budget -= len(msgspec.json.encode(rows[-1]))
    return rows, None


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
