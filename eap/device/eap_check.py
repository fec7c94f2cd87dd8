"""What a station's specification, read back from its dictionaries, has to be as a whole.

The rules are those of a plant file, as far as one station can break them; each refusal names the
object.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

from eap.device.fault import DeviceFault, FaultCode
from eap.ids import Destination, DestinationKind, InterfaceUri
from eap.od.profiles.eap1000keys import Frame, Rx, Tx
from eap.pd.spec import (
    REQUESTER,
    EngineSource,
    RxPdSpec,
    StationSpec,
    TxFrameSpec,
    TxPdSpec,
    Writer,
)

MIN_MONITOR_INTERVAL_MS = 100


class Found(NamedTuple):
    """A record with where it stands; of a TxPD with its frame."""

    port: str
    at: int
    """Index of its object."""
    record: Any
    frame: Any = None

    def fault(self, code: FaultCode, detail: str, subindex: int = 0) -> DeviceFault:
        """Make a fault about it."""
        return DeviceFault(code, detail, self.at, subindex, self.port)


def check_station(
    before: StationSpec,
    spec: StationSpec,
    frames: list[Found],
    pds: list[Found],
    subscriptions: list[Found],
) -> None:
    """Refuse what cannot run.

    Args:
        before: The station whose sources and links *spec* has.
        spec: What was read back.
        frames: Its TxFrames.
        pds: Its TxPDs.
        subscriptions: Its RxPDs.

    Raises:
        DeviceFault: for the first object that is wrong.
    """
    _check_unique(frames, Frame.NAME, "frame")
    _check_unique(pds, Tx.NAME, "sent PD")
    _check_unique(subscriptions, Rx.NAME, "received PD")
    schemes = {port.name: InterfaceUri.parse(port.interface).scheme for port in spec.ports}
    for found in frames:
        _check_frame(found)
        _check_monitoring(found, schemes[found.port])
    for found in pds:
        _check_triggers(found, spec.cycle_us)
    _check_ids(pds)
    _check_received(spec, subscriptions)
    _check_polls(pds, subscriptions)
    _check_station_needs(before, spec, subscriptions)


def _check_unique(found: Iterable[Found], subindex: int, what: str) -> None:
    seen: dict[str, Found] = {}
    for each in found:
        name = each.record.name
        if name in seen:
            first = seen[name]
            detail = f"{what} {name} is 0x{first.at:04X} of {first.port} already"
            raise each.fault(FaultCode.NAME_TWICE, detail, subindex)
        seen[name] = each


def _check_frame(found: Found) -> None:
    frame: TxFrameSpec = found.record
    if frame.modulo and frame.modulo >= frame.divider:
        detail = f"{frame.modulo} with divider {frame.divider}"
        raise found.fault(FaultCode.MODULO, detail, Frame.MODULO)
    answers = frame.destination == REQUESTER
    if answers and frame.divider:
        detail = "an answer leaves in the cycle that the request is taken in"
        raise found.fault(FaultCode.TRIGGERS, detail, Frame.DIVIDER)
    for pd in frame.pds:
        if bool(pd.poll_request) is not answers:
            who = "is sent by itself" if answers else "is polled"
            where = "who asks" if answers else frame.destination
            detail = f"{pd.name} {who}, the frame goes to {where}"
            raise found.fault(FaultCode.POLL, detail, Frame.ADDRESS_MODE)


def _check_monitoring(found: Found, scheme: str) -> None:
    frame: TxFrameSpec = found.record
    if frame.monitor_ip and (scheme != "ethernet" or not frame.monitor_interval_ms):
        detail = "an IP is for a monitored frame on Ethernet"
        raise found.fault(FaultCode.MONITORING, detail, Frame.MONITOR_IP)
    if not frame.monitor_interval_ms:
        return
    if frame.monitor_interval_ms < MIN_MONITOR_INTERVAL_MS:
        detail = f"every {frame.monitor_interval_ms} ms, at least {MIN_MONITOR_INTERVAL_MS}"
        raise found.fault(FaultCode.MONITORING, detail, Frame.MONITORING_INTERVAL)
    where = None if frame.destination == REQUESTER else Destination.parse(frame.destination)
    if where is None or where.is_group or where.kind is DestinationKind.TCP or scheme == "loop":
        detail = f"at {frame.destination}; only at one station, on Ethernet or UDP"
        raise found.fault(FaultCode.MONITORING, detail, Frame.MONITORING_INTERVAL)


def _check_triggers(found: Found, cycle_us: int) -> None:
    pd: TxPdSpec = found.record
    trigger, on_change = pd.trigger, pd.trigger.on_change
    if pd.poll_request and trigger != type(trigger)():
        detail = "a polled PD has no other trigger"
        raise found.fault(FaultCode.TRIGGERS, detail, Tx.POLL_REQUEST_RXPD)
    if trigger.cycle_us and trigger.divider:
        raise found.fault(FaultCode.TRIGGERS, "cycle time and divider", Tx.DIVIDER)
    if on_change is not None and (trigger.cycle_us or trigger.divider):
        raise found.fault(FaultCode.TRIGGERS, "on change and a fixed rhythm", Tx.ON_CHANGE)
    if on_change is not None and 0 < on_change.timeout_ms * 1000 < on_change.inhibit_us:
        detail = f"{on_change.timeout_ms} ms, changes at most every {on_change.inhibit_us} us"
        raise found.fault(FaultCode.TIME_OUT, detail, Tx.ON_CHANGE_TIMEOUT)
    if trigger.modulo and trigger.modulo >= trigger.divider:
        detail = f"{trigger.modulo} with divider {trigger.divider}"
        raise found.fault(FaultCode.MODULO, detail, Tx.MODULO)
    if trigger.cycle_us % cycle_us:
        detail = f"{trigger.cycle_us} us is no multiple of the device cycle, {cycle_us}"
        raise found.fault(FaultCode.CYCLE_TIME, detail, Tx.CYCLE_TIME)
    _check_gate(found, cycle_us)


def _check_gate(found: Found, cycle_us: int) -> None:
    """Refuse a PD that is due when its frame does not leave."""
    trigger, gate, modulo = found.record.trigger, found.frame.divider, found.frame.modulo
    step = trigger.divider or trigger.cycle_us // cycle_us
    if gate and step and (step % gate or trigger.modulo % gate != modulo):
        detail = f"every {step} cycles at {trigger.modulo}, {found.frame.name} every {gate} "
        subindex = Tx.DIVIDER if trigger.divider else Tx.CYCLE_TIME
        raise found.fault(FaultCode.GATE, f"{detail}at {modulo}", subindex)


def _check_ids(pds: Iterable[Found]) -> None:
    seen: dict[tuple[str, int], Found] = {}
    for each in pds:
        key = (each.port, each.record.pd_id)
        if key in seen:
            detail = f"{each.record.pd_id} is that of {seen[key].record.name} too"
            raise each.fault(FaultCode.PD_ID_TWICE, detail, Tx.PD_ID)
        seen[key] = each


def _check_received(spec: StationSpec, subscriptions: Iterable[Found]) -> None:
    seen: dict[tuple[str, str, int], list[RxPdSpec]] = {}
    taken: dict[str, str] = {}
    for each in subscriptions:
        pd: RxPdSpec = each.record
        for name in pd.variables:
            if name in taken:
                detail = f"variable {name}, by {taken[name]} too"
                raise each.fault(FaultCode.RECEIVED_TWICE, detail, Rx.PDO_INDEX)
            taken[name] = pd.name
        same = seen.setdefault((pd.port, pd.publisher, pd.pd_id), [])
        for other in same:
            if pd.ignore_version or other.ignore_version or pd.version == other.version:
                detail = f"id {pd.pd_id} of {pd.publisher or 'any publisher'}, by {other.name} too"
                raise each.fault(FaultCode.RECEIVED_TWICE, detail, Rx.PD_ID)
        same.append(pd)
        if 0 < pd.timeout_ms * 1000 < spec.cycle_us:
            detail = f"{pd.timeout_ms} ms, the device cycle is {spec.cycle_us} us"
            raise each.fault(FaultCode.TIME_OUT, detail, Rx.TIME_OUT)


def _check_polls(pds: list[Found], subscriptions: list[Found]) -> None:
    """Refuse requests that are not there, and those that are answers themselves."""
    sent = {(each.port, each.record.name): each.record for each in pds}
    received = {(each.port, each.record.name): each.record for each in subscriptions}
    for found, others, subindex in (
        *((each, received, Tx.POLL_REQUEST_RXPD) for each in pds),
        *((each, sent, Rx.POLL_REQUEST_TXPD) for each in subscriptions),
    ):
        request = found.record.poll_request
        if not request:
            continue
        other = others.get((found.port, request))
        if other is None:
            raise found.fault(FaultCode.POLL, f"{request} is not enabled", subindex)
        if other.poll_request:
            raise found.fault(FaultCode.POLL, f"{request} is an answer itself", subindex)
    for found in subscriptions:
        if found.record.poll_request and found.record.step:
            raise found.fault(FaultCode.POLL, "an answer has no fixed step", Rx.STEP)


def _check_station_needs(
    before: StationSpec, spec: StationSpec, subscriptions: Iterable[Found]
) -> None:
    """Refuse variables that sources and links of the station do not find as they need them."""
    now = {each.name: each for each in spec.variables}
    types = {each.name: each.type for each in before.variables}
    received = {name for each in subscriptions for name in each.record.variables}
    writers: dict[str, Writer] = {}
    for source in before.sources:
        is_engine = isinstance(source, EngineSource)
        writers[source.variable] = Writer.ENGINE if is_engine else Writer.SERVICES
    writers |= {link.target: Writer.ENGINE for link in before.links}
    needed: Mapping[str, None] = dict.fromkeys([*writers, *(link.source for link in before.links)])
    for name in needed:
        if name not in now:
            raise DeviceFault(FaultCode.IN_USE, f"a source or a link needs {name}")
        if now[name].type != types.get(name, now[name].type):
            detail = f"{name} is {now[name].type}, a source or a link needs {types[name]}"
            raise DeviceFault(FaultCode.IN_USE, detail)
        if name in writers and (name in received or now[name].writer is not writers[name]):
            detail = f"{name} is filled by a source or a link"
            raise DeviceFault(FaultCode.WRITER, detail)
