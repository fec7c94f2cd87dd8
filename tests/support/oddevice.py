"""Devices with an object dictionary, for commands that talk to one."""

from __future__ import annotations

from typing import Any

from msgspec.structs import replace

from eap.od.abort import SdoAbortError
from eap.od.dictionary import ObjectDictionary
from eap.od.model import RO, RW, RW_PREOP, WO, Access, Entry, OdObject, OdState, record, variable
from eap.ops.od import Content, EntryInfo, ObjectInfo


def mixer() -> ObjectDictionary:
    """Return a dictionary with something of everything."""
    return ObjectDictionary(
        [
            variable(0x1000, "Device type", "UDINT", RO, 0x03E81389),
            variable(0x1008, "Device name", "STRING(32)", RO, "mixer #1"),
            record(
                0x6000,
                "Tx variable 0",
                {
                    1: Entry("Value", "REAL", RO, 1.5),
                    4: Entry("Type name", "STRING(40)", RW_PREOP, "REAL"),
                    5: Entry("Name", "STRING(255)", RW_PREOP, 'speed "set" # 1'),
                    8: Entry("Default given", "BOOL", RW_PREOP, value=True),
                    9: Entry("Default", "REAL", RW_PREOP, 0.25),
                },
            ),
            OdObject(
                0x1A00,
                "TxPDO mapping 0",
                record(0, "", {}).code,
                {
                    0: Entry("SubIndex 000", "USINT", RW_PREOP, 1),
                    1: Entry("Mapping 1", "UDINT", RW_PREOP, 0x60000120),
                },
            ),
            record(
                0x8000,
                "TxFrame 0",
                {
                    1: Entry("Enabled", "BOOL", RW_PREOP, value=True),
                    3: Entry(
                        "Destination MAC", "BLOCK(6)", RW_PREOP, bytes.fromhex("010105040000")
                    ),
                    4: Entry(
                        "Destination NetID", "BLOCK(6)", RW_PREOP, bytes((127, 0, 1, 2, 2, 1))
                    ),
                    5: Entry("Destination IP", "BLOCK(4)", RW_PREOP, bytes((127, 0, 1, 2))),
                    6: Entry("Key", "BLOCK(3)", WO),
                    16: Entry("TxPD 1", "UINT", RW_PREOP, 0xD000),
                },
            ),
            record(0xD000, "TxPD 0", {7: Entry("Cycle time", "UDINT", RW_PREOP, 10000, unit=1)}),
            record(0xF200, "EAP control", {1: Entry("Requested state", "UINT", RW)}),
        ]
    )


class MemoryDevice:
    """An OdDevice that is a dictionary in PreOp."""

    def __init__(self, dictionary: ObjectDictionary, state: OdState = OdState.PREOP) -> None:
        self.dictionary = dictionary
        self.state = state
        self.written: list[tuple[int, int, bytes]] = []

    def objects(self) -> list[ObjectInfo]:
        return [_info(item) for item in self.dictionary]

    def describe(self, index: int) -> ObjectInfo:
        item = self.dictionary[index]
        entries = tuple(_entry(sub, entry) for sub, entry in item.entries.items())
        return replace(_info(item), entries=entries)

    def entry(self, index: int, subindex: int) -> EntryInfo | None:
        try:
            return _entry(subindex, self.dictionary.entry(index, subindex))
        except SdoAbortError:
            return None

    def read(self, index: int, subindex: int, *, complete: bool = False) -> bytes:
        if complete:
            return self.dictionary.upload_complete(index, subindex, self.state)
        return self.dictionary.upload(index, subindex, self.state)

    def write(self, index: int, subindex: int, octets: bytes, *, complete: bool = False) -> None:
        self.written.append((index, subindex, octets))
        if complete:
            self.dictionary.download_complete(index, subindex, octets, self.state)
        else:
            self.dictionary.download(index, subindex, octets, self.state)

    def contents(self) -> list[Content]:
        return [
            Content(_info(item), _entry(sub, entry), _octets(entry))
            for item in self.dictionary
            for sub, entry in item.entries.items()
        ]


def methods(device: MemoryDevice) -> dict[str, Any]:
    """Return the control methods that serve *device*."""

    def od_list(params: dict[str, Any]) -> Any:
        return _page([_object_row(item) for item in device.dictionary], params["first"])

    def od_describe(params: dict[str, Any]) -> Any:
        item = device.dictionary[params["index"]]
        rows = [_entry_row(sub, entry) for sub, entry in item.entries.items()]
        return _object_row(item) | {"entries": rows}

    def od_read(params: dict[str, Any]) -> Any:
        place = params["index"], params["subindex"]
        return {"data": device.read(*place, complete=params["complete"]).hex()}

    def od_write(params: dict[str, Any]) -> Any:
        place = params["index"], params["subindex"]
        device.write(*place, bytes.fromhex(params["data"]), complete=params["complete"])
        return {}

    def od_dump(params: dict[str, Any]) -> Any:
        rows = [od_describe({"index": item.index}) for item in device.dictionary]
        return _page(rows, params["first"])

    return {each.__name__: each for each in (od_list, od_describe, od_read, od_write, od_dump)}


def _info(item: OdObject) -> ObjectInfo:
    return ObjectInfo(item.index, item.name, item.code.name, item.max_subindex, _label(item))


def _label(item: OdObject) -> str:
    return next((str(e.value) for e in item.entries.values() if e.name == "Name"), "")


def _entry(subindex: int, entry: Entry) -> EntryInfo:
    return EntryInfo(subindex, entry.name, entry.kind, _access(entry), "us" if entry.unit else "")


def _access(entry: Entry) -> str:
    reads = "r" if entry.access & Access.READ_ANY else ""
    return reads + ("w" if entry.access & Access.WRITE_ANY else "")


def _octets(entry: Entry) -> bytes | None:
    return entry.octets if entry.access & Access.READ_ANY else None


def _object_row(item: OdObject) -> dict[str, Any]:
    return {
        "index": item.index,
        "name": item.name,
        "label": _label(item),
        "code": item.code.name,
        "max_subindex": item.max_subindex,
    }


def _entry_row(subindex: int, entry: Entry) -> dict[str, Any]:
    octets = _octets(entry)
    return {
        "subindex": subindex,
        "name": entry.name,
        "type": entry.kind.text,
        "bits": entry.kind.bit_length,
        "access": _access(entry),
        "rights": int(entry.access),
        "unit": "us" if entry.unit else "",
        "default": entry.default.hex(),
        "minimum": entry.minimum,
        "maximum": entry.maximum,
        "data": None if octets is None else octets.hex(),
    }


def _page(rows: list[dict[str, Any]], first: int) -> dict[str, Any]:
    """Return four objects at a time, so that there is more than one page."""
    chosen = [row for row in rows if row["index"] >= first]
    return {"objects": chosen[:4], "next": chosen[4]["index"] if chosen[4:] else None}
