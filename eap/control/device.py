"""Control protocol: EAP devices and routers, their dictionaries, states and configurations.

The records of requests and answers, which server and client share; docs/control.md describes them.
Bytes are hexadecimal digits, specifications are JSON as ``export`` gives them.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal

from msgspec import UNSET, Meta, UnsetType

from eap.ams.spec import RoutingSpec
from eap.control.protocol import Document, Method, Parameters, WriteOrigin
from eap.device.configuration import EntryChange
from eap.device.eap_state import StateResult
from eap.device.rollout import without_alternates
from eap.od.model import Access, Entry, OdObject
from eap.od.profiles import eap1000 as profile
from eap.od.profiles.table import UNITS
from eap.pd.device import DeviceFault, DeviceState
from eap.pd.spec import StationSpec
from eap.runtime.device_change import Plan
from eap.runtime.store import Configuration

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
    """``od_write``: writes an entry, or with *complete* the object from there on."""

    data: str


class OdDumpParameters(TargetParameters, frozen=True, kw_only=True):
    """``od_dump``: of the objects from index *first* on."""

    first: Index = 0


class RequestStateParameters(TargetParameters, frozen=True, kw_only=True):
    """``request_state``; *origin* is the author, if a program requests it for a user."""

    state: str
    origin: WriteOrigin | None = None


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
    """``rollback``: to the specification before the last change; *spec* is that or the running one.

    Either may have other alternates.
    """

    spec: StationSpec | None = None


class RoutingPlanParameters(StationParameters, frozen=True, kw_only=True):
    """``routing_plan``: changes that *routing* would bring."""

    routing: RoutingSpec


class RoutingApplyParameters(RoutingPlanParameters, frozen=True, kw_only=True):
    """``routing_apply``; *cause* as in ``apply``."""

    cause: Annotated[str, Meta(max_length=64)] = ""


class ListedObject(Document, frozen=True, kw_only=True):
    """Object without its entries; *label* is the name of the frame, PD or port described by it."""

    index: int
    name: str
    label: str
    code: str
    max_subindex: int


class DescribedEntry(Document, frozen=True, kw_only=True):
    """Entry without its value."""

    subindex: int
    name: str
    type: str
    bits: int
    access: str
    rights: int
    unit: str
    default: str
    minimum: int | float | None
    maximum: int | float | None


class EntryContent(DescribedEntry, frozen=True, kw_only=True):
    """Entry with its bytes, None if they cannot be read."""

    data: str | None


class DescribedObject(ListedObject, frozen=True, kw_only=True):
    """Answer to ``od_describe``."""

    entries: list[DescribedEntry]


class DumpedObject(ListedObject, frozen=True, kw_only=True):
    """Object of an answer to ``od_dump``."""

    entries: list[EntryContent]


class ObjectPage(Document, frozen=True):
    """Answer to ``od_list``; *next* is the index at which it goes on, None at the end."""

    objects: list[ListedObject]
    next: int | None


class DumpPage(Document, frozen=True):
    """Answer to ``od_dump``; *next* as in ``od_list``."""

    objects: list[DumpedObject]
    next: int | None


class EntryData(Document, frozen=True):
    """Answer to ``od_read``."""

    data: str


class EmptyAnswer(Document, frozen=True):
    """Answer without content."""


class StateError(Document, frozen=True):
    """Reason why a state was refused; the object that it is about where a station refuses."""

    code: int
    text: str
    port: str | UnsetType = UNSET
    index: int | UnsetType = UNSET
    subindex: int | UnsetType = UNSET


class StateAnswer(Document, frozen=True):
    """State of a device, None if it does not answer, and why it is not the requested one."""

    state: str | None
    error: StateError | None


class TargetState(Document, frozen=True):
    """``eapctl state``."""

    target: str
    state: str | None
    error: StateError | None


class ObjectChange(Document, frozen=True, kw_only=True):
    """Change of one entry."""

    port: str
    index: int
    subindex: int
    name: str
    change: str
    old: str
    new: str
    unit: str


class ChangeResult(ObjectChange, frozen=True, kw_only=True):
    """Change of one entry that was tried."""

    ok: bool
    reason: str


class PlanAnswer(Document, frozen=True):
    """Answer to ``plan``: changes of objects, of the station beside them, and refusals."""

    changes: list[ObjectChange]
    station: list[str]
    refused: list[str]


class ApplyAnswer(Document, frozen=True):
    """Answer to ``apply`` and ``rollback``."""

    ok: bool
    results: list[ChangeResult]
    station: list[str]
    refused: list[str]


class RunningSpec(Document, frozen=True):
    """Answer to ``export``.

    Attributes:
        spec: Specification that the station runs.
        previous: The one before the last change, alternates aside; None if there was none.
        cause: Name of that change; those of later ones sort behind.
        undone: Whether it was taken back.
    """

    spec: StationSpec
    previous: StationSpec | None = None
    cause: str = ""
    undone: bool = False


class RunningRouting(Document, frozen=True, kw_only=True):
    """Answer to ``routing_export``: configuration of the router of a station.

    Attributes:
        routing: Routes of the plant file, rules, users, brokers.
        previous: Before the last change; None if there was none.
        cause: Name of that change.
        undone: Whether it was taken back.
    """

    routing: RoutingSpec
    previous: RoutingSpec | None = None
    cause: str = ""
    undone: bool = False


class RoutingDifference(Document, frozen=True, kw_only=True):
    """Changes of a router, a line for each, and refusals: those that need a new start."""

    changes: list[str]
    refused: list[str]


OD_LIST = Method("od_list", OdListParameters, ObjectPage)
OD_DESCRIBE = Method("od_describe", OdDescribeParameters, DescribedObject)
OD_READ = Method("od_read", OdReadParameters, EntryData)
OD_WRITE = Method("od_write", OdWriteParameters, EmptyAnswer)
OD_DUMP = Method("od_dump", OdDumpParameters, DumpPage)
STATE = Method("state", TargetParameters, StateAnswer)
REQUEST_STATE = Method("request_state", RequestStateParameters, StateAnswer)
EXPORT = Method("export", StationParameters, RunningSpec)
PLAN = Method("plan", SpecParameters, PlanAnswer)
APPLY = Method("apply", ApplyParameters, ApplyAnswer)
ROLLBACK = Method("rollback", RollbackParameters, ApplyAnswer)
ROUTING_EXPORT = Method("routing_export", StationParameters, RunningRouting)
ROUTING_PLAN = Method("routing_plan", RoutingPlanParameters, RoutingDifference)
ROUTING_APPLY = Method("routing_apply", RoutingApplyParameters, RoutingDifference)
ROUTING_ROLLBACK = Method("routing_rollback", StationParameters, RoutingDifference)


def object_row(item: OdObject, label: str) -> ListedObject:
    """Return an object without its entries."""
    return ListedObject(
        index=item.index,
        name=item.name,
        label=label,
        code=item.code.name,
        max_subindex=item.max_subindex,
    )


def described_object(item: OdObject, label: str) -> DescribedObject:
    """Return an object with its entries."""
    return DescribedObject(
        index=item.index,
        name=item.name,
        label=label,
        code=item.code.name,
        max_subindex=item.max_subindex,
        entries=[DescribedEntry(**_entry_fields(*each)) for each in item.entries.items()],
    )


def dumped_object(item: OdObject, label: str, read_right: Access) -> DumpedObject:
    """Return an object with its entries and the bytes of those that *read_right* may read."""
    return DumpedObject(
        index=item.index,
        name=item.name,
        label=label,
        code=item.code.name,
        max_subindex=item.max_subindex,
        entries=[
            EntryContent(
                **_entry_fields(subindex, entry),
                data=entry.octets.hex() if entry.access & read_right else None,
            )
            for subindex, entry in item.entries.items()
        ],
    )


def _entry_fields(subindex: int, entry: Entry) -> dict[str, Any]:
    reads = "r" if entry.access & Access.READ_ANY else ""
    return {
        "subindex": subindex,
        "name": entry.name,
        "type": entry.kind.text,
        "bits": entry.kind.bit_length,
        "access": reads + ("w" if entry.access & Access.WRITE_ANY else ""),
        # Beside the short form for people: ETG.1000.6 has rights for each state.
        "rights": int(entry.access),
        "unit": _UNIT_TEXTS.get(entry.unit, ""),
        "default": entry.default.hex(),
        "minimum": entry.minimum,
        "maximum": entry.maximum,
    }


def state_answer(status: StateResult) -> StateAnswer:
    """Return the state of a device, and why it is not the requested one."""
    fault = status.fault
    if fault is None:
        return StateAnswer(status.state.name, None)
    error = StateError(int(fault.code), fault.text, fault.port, fault.index, fault.subindex)
    return StateAnswer(status.state.name, error)


def plan_answer(plan: Plan) -> PlanAnswer:
    """Return the changes of a plan; writes that only make way for others are left out."""
    changes = [ObjectChange(**_change_fields(*each)) for each in plan.changes if _is_final(*each)]
    return PlanAnswer(changes, plan.station, plan.refused)


def apply_answer(plan: Plan, fault: DeviceFault | None) -> ApplyAnswer:
    """Return the changes that were made, or why none was."""
    refused = plan.refused if fault is None else [fault.text]
    # All or nothing: what refuses one entry refuses every one.
    reason = "" if fault is None else fault.text
    results = [
        ChangeResult(**_change_fields(*each), ok=not refused, reason=reason)
        for each in plan.changes
        if _is_final(*each)
    ]
    return ApplyAnswer(not refused, results, plan.station, refused)


def _is_final(port: str, change: EntryChange) -> bool:
    # Called with the pair as plans have it.
    del port
    return not change.interim


def _change_fields(port: str, change: EntryChange) -> dict[str, Any]:
    row = profile.row_of(change.index).row(change.subindex)
    return {
        "port": port,
        "index": change.index,
        "subindex": change.subindex,
        "name": change.name,
        "change": change.kind,
        "old": change.old,
        "new": change.new,
        "unit": "" if row is None else row.unit,
    }


def running_spec(
    spec: StationSpec, previous: Configuration | None, cause: str, undone: bool
) -> RunningSpec:
    """Return the specification that runs, the one before the last change, and that change."""
    # Alternates are of the change itself: nobody has configured them.
    before = None if previous is None else without_alternates(previous.spec)
    return RunningSpec(spec, before, cause, undone)


def state_of(word: str) -> int:
    """Return the number of a state; 0 for what is none, which the device refuses."""
    # The device refuses it, so that the message is the same for every front end.
    return DeviceState.__members__.get(word.upper(), 0)
