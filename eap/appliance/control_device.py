"""The control protocol's words about EAP devices; docs/control.md is their description.

Octets are hexadecimal digits, specifications are JSON as ``export`` gives them.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal

import msgspec
from msgspec import Meta

from eap.appliance.control import Parameters
from eap.appliance.device_change import Plan
from eap.appliance.store import Configuration
from eap.device.difference import EntryChange
from eap.device.eap_state import StateResult
from eap.device.rollout import without_alternates
from eap.od.model import Access, Entry, OdObject
from eap.od.profiles import eap1000 as profile
from eap.od.profiles.table import UNITS
from eap.pd.device import DeviceFault, DeviceState
from eap.pd.spec import StationSpec

PAGE = 1 << 18
"""Octets of a list of objects from which on it goes on with another request."""

Index = Annotated[int, Meta(ge=0, le=0xFFFF)]
Subindex = Annotated[int, Meta(ge=0, le=0xFF)]
ListName = Literal["all", "rx", "tx", "backup", "settings"]
_UNIT_TEXTS = {code: text for text, code in UNITS.items()}


class TargetParameters(Parameters, frozen=True, kw_only=True):
    """Base of those that name a device: ``STATION`` (its first EAP port) or ``STATION/PORT``."""

    target: str


class OdListParameters(TargetParameters, frozen=True, kw_only=True):
    """``od_list``: of the objects from index *first* on."""

    list: ListName = "all"
    first: Index = 0


class OdDescribeParameters(TargetParameters, frozen=True, kw_only=True):
    """``od_describe``: as it is, or would be after a download to *subindex*."""

    index: Index
    subindex: Subindex | None = None


class OdReadParameters(TargetParameters, frozen=True, kw_only=True):
    """``od_read``: an entry, or with *complete* the object from there on."""

    index: Index
    subindex: Subindex
    complete: bool = False


class OdWriteParameters(OdReadParameters, frozen=True, kw_only=True):
    """``od_write``: likewise."""

    data: str


class OdDumpParameters(TargetParameters, frozen=True, kw_only=True):
    """``od_dump``: of the objects from index *first* on."""

    first: Index = 0


class RequestStateParameters(TargetParameters, frozen=True, kw_only=True):
    """``request_state``."""

    state: str


class StationParameters(Parameters, frozen=True, kw_only=True):
    """``export``."""

    station: str


class SpecParameters(StationParameters, frozen=True, kw_only=True):
    """``plan``."""

    spec: StationSpec


class ApplyParameters(SpecParameters, frozen=True, kw_only=True):
    """``apply``.

    All steps of one change of a plant have the same *cause*, later ones a greater.  *file* is the
    plant file, as an absolute path, if that is where *spec* is from.
    """

    cause: Annotated[str, Meta(max_length=64)] = ""
    file: str = ""


class RollbackParameters(StationParameters, frozen=True, kw_only=True):
    """``rollback``: to what ran before the last change; *spec* is that, or what runs now.

    Either may have other alternates.
    """

    spec: StationSpec | None = None


def object_row(item: OdObject, label: str) -> dict[str, Any]:
    """Return an object without its entries; *label* is the name of what it is about."""
    return {
        "index": item.index,
        "name": item.name,
        "label": label,
        "code": item.code.name,
        "max_subindex": item.max_subindex,
    }


def entry_row(subindex: int, entry: Entry) -> dict[str, Any]:
    """Return an entry without its value."""
    reads = "r" if entry.access & Access.READ_ANY else ""
    return {
        "subindex": subindex,
        "name": entry.name,
        "type": entry.kind.text,
        "bits": entry.kind.bit_length,
        "access": reads + ("w" if entry.access & Access.WRITE_ANY else ""),
        "rights": int(entry.access),
        "unit": _UNIT_TEXTS.get(entry.unit, ""),
        "default": entry.default.hex(),
        "minimum": entry.minimum,
        "maximum": entry.maximum,
    }


def state_document(status: StateResult) -> dict[str, Any]:
    """Return where a device stands, and why it is not where it was asked to."""
    return {"state": status.state.name, "error": status.fault and fault_document(status.fault)}


def fault_document(fault: DeviceFault) -> dict[str, Any]:
    """Return why a state was refused."""
    return {
        "code": int(fault.code),
        "text": fault.text,
        "port": fault.port,
        "index": fault.index,
        "subindex": fault.subindex,
    }


def change_row(port: str, change: EntryChange) -> dict[str, Any]:
    """Return a change of one entry."""
    return {
        "port": port,
        "index": change.index,
        "subindex": change.subindex,
        "name": change.name,
        "change": change.kind,
        "old": change.old,
        "new": change.new,
        "unit": _unit(change),
    }


def _unit(change: EntryChange) -> str:
    row = profile.row_of(change.index).row(change.subindex)
    return "" if row is None else row.unit


def plan_document(plan: Plan) -> dict[str, Any]:
    """Return what would change; writes that only make way for others are left out."""
    return {
        "changes": [change_row(*each) for each in plan.changes if not each[1].interim],
        "station": plan.station,
        "refused": plan.refused,
    }


def outcome_document(plan: Plan, fault: DeviceFault | None) -> dict[str, Any]:
    """Return what has changed, or why nothing has."""
    refused = plan.refused if fault is None else [fault.text]
    reason = "" if fault is None else fault.text
    is_ok = not refused
    found = plan_document(plan)
    results = [{**row, "ok": is_ok, "reason": reason} for row in found["changes"]]
    return {"ok": is_ok, "results": results, "station": plan.station, "refused": refused}


def spec_document(spec: StationSpec) -> dict[str, Any]:
    """Return a specification as JSON has it."""
    document: dict[str, Any] = msgspec.to_builtins(spec)
    return document


def export_document(
    spec: StationSpec, previous: Configuration | None, cause: str, undone: bool
) -> dict[str, Any]:
    """Return what a station runs, what it ran before the last change, and which that was."""
    return {
        "spec": spec_document(spec),
        "previous": previous and spec_document(without_alternates(previous.spec)),
        "cause": cause,
        "undone": undone,
    }


def state_of(word: str) -> int:
    """Return the number of a state; 0 for what is none, which the device refuses."""
    return DeviceState.__members__.get(word.upper(), 0)
