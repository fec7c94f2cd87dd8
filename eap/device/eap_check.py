"""Check of a station's specification, read back from its dictionaries, as a whole.

The rules are those of a plant file (``eap.pd.rules``), as far as one station can break them; each
refusal names the object.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from itertools import chain
from typing import Any, NamedTuple

from eap.ids import Destination, InterfaceUri
from eap.od.profiles import eap1000 as profile
from eap.od.profiles.eap1000 import FrameEntry, Rx, Tx
from eap.pd import rules
from eap.pd.device import DeviceFault, FaultCode
from eap.pd.rules import Breach
from eap.pd.spec import (
    REQUESTER,
    EngineSource,
    RxPdSpec,
    StationSpec,
    TxFrameSpec,
    TxPdSpec,
    Writer,
)


class FoundRecord(NamedTuple):
    """A record with where it stands; of a TxPD with the Found of its frame."""

    port: str
    at: int
    """Index of its object."""
    record: Any
    frame: Any = None

    def fault(self, code: FaultCode, detail: str, subindex: int = 0) -> DeviceFault:
        """Make a fault about it."""
        return DeviceFault(code, detail, self.at, subindex, self.port)

    def refuse(self, breaches: Iterable[Breach]) -> None:
        """Raise a DeviceFault for the first of *breaches*, at the entry that it names."""
        for breach in breaches:
            raise fault_of(breach, self.at, self.port)


def fault_of(breach: Breach, index: int, port: str) -> DeviceFault:
    """Return the fault for *breach* at the object of *index*."""
    subindex = profile.row_of(index).subindex_of(breach.entry or breach.key)
    detail = f"{breach.message}; expected {breach.expected}"
    return DeviceFault(breach.code, detail, index, subindex, port)


def check_station(
    before: StationSpec,
    spec: StationSpec,
    frames: list[FoundRecord],
    pds: list[FoundRecord],
    subscriptions: list[FoundRecord],
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
    _check_unique(frames, FrameEntry.NAME, "frame")
    _check_unique(pds, Tx.NAME, "sent PD")
    _check_unique(subscriptions, Rx.NAME, "received PD")
    uris = {port.name: InterfaceUri.parse(port.interface) for port in spec.ports}
    for found in frames:
        found.refuse(_breaches_of_frame(found.record, uris[found.port]))
    for found in pds:
        found.refuse(_breaches_of_pd(found.record, found.frame.record, spec.cycle_us))
    for second, first in rules.doubles(((each.port, each.record.pd_id), each) for each in pds):
        detail = f"{second.record.pd_id} is that of {first.record.name} too"
        raise second.fault(FaultCode.PD_ID_TWICE, detail, Tx.PD_ID)
    _check_received(spec, subscriptions)
    _check_polls(pds, subscriptions)
    _check_station_needs(before, spec, subscriptions)


def _check_unique(found: Iterable[FoundRecord], subindex: int, what: str) -> None:
    for second, first in rules.doubles((each.record.name, each) for each in found):
        detail = f"{what} {first.record.name} is 0x{first.at:04X} of {first.port} already"
        raise second.fault(FaultCode.NAME_TWICE, detail, subindex)


def _breaches_of_frame(frame: TxFrameSpec, uri: InterfaceUri) -> Iterator[Breach]:
    is_answer = frame.destination == REQUESTER
    destination = None if is_answer else Destination.parse(frame.destination)
    return chain(
        rules.check_modulo(frame.name, frame.divider, frame.modulo or None),
        rules.check_answers(frame),
        chain.from_iterable(rules.check_frame_of(pd, frame) for pd in frame.pds),
        rules.check_monitoring(frame, destination, uri),
    )


def _breaches_of_pd(pd: TxPdSpec, frame: TxFrameSpec, cycle_us: int) -> Iterator[Breach]:
    trigger = pd.trigger
    return chain(
        rules.check_polled(pd),
        rules.check_triggers(pd),
        rules.check_modulo(pd.name, trigger.divider, trigger.modulo or None),
        rules.check_times(pd, frame, cycle_us),
    )


def _check_received(spec: StationSpec, subscriptions: Iterable[FoundRecord]) -> None:
    # Not the rule of the plant file: while a sender changes, its old and its new version are taken
    # side by side.
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
        each.refuse(rules.check_time_out(pd.name, pd.timeout_ms, spec.cycle_us))


def _check_polls(pds: list[FoundRecord], subscriptions: list[FoundRecord]) -> None:
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
    before: StationSpec, spec: StationSpec, subscriptions: Iterable[FoundRecord]
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
    for name in dict.fromkeys([*writers, *(link.source for link in before.links)]):
        if name not in now:
            raise DeviceFault(FaultCode.IN_USE, f"a source or a link needs {name}")
        if now[name].type != types.get(name, now[name].type):
            detail = f"{name} is {now[name].type}, a source or a link needs {types[name]}"
            raise DeviceFault(FaultCode.IN_USE, detail)
        if name in writers and (name in received or now[name].writer is not writers[name]):
            detail = f"{name} is filled by a source or a link"
            raise DeviceFault(FaultCode.WRITER, detail)
