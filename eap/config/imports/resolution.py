"""Connections between imported stations: destinations, publishers, and peers made for a project.

A peer is the other side of a project.  It receives everything that the project sends to it, and
sends everything that the project expects from it.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TypeAlias

import msgspec

from eap.config.imports.records import ImportOutcome, ImportReport
from eap.config.imports.stations import (
    PlannedFrame,
    PlannedPd,
    PlannedPort,
    PlannedStation,
    PlannedSubscription,
    PlannedVariable,
    UniqueNames,
    is_group_address,
    made_up_net_id,
)
from eap.ids import InterfaceUri, NetId

_MIN_TIMEOUT_MS = 100
_ALL = "all", ""
"""Target of the frame for what several stations expect."""
_UDP_GROUP = "239.88.164.1"
_SHARED = "Several stations expect these PDs: their subscribers take them from this group."
_Owner: TypeAlias = tuple[PlannedStation, PlannedPort]
_Sent: TypeAlias = dict[str | tuple[str, str, int], tuple[PlannedFrame, PlannedPd]]


def with_peers(
    stations: Sequence[PlannedStation], name: str, interfaces: Iterator[InterfaceUri]
) -> list[PlannedStation]:
    """Return *stations* and a peer for each controller that they exchange PDs with.

    Args:
        stations: The imported ones.
        name: Of the first peer; the others have a number behind it.
        interfaces: Yields the interfaces of the peers.
    """
    known = _owners(stations)
    groups: dict[bytes, None] = {}
    for station in stations:
        for net_id in _partners(station):
            if net_id not in known:
                groups[bytes(net_id[:4])] = None
    names = UniqueNames(station.name for station in stations)
    peers = [
        _peer(stations, group, names.take(name), next(interfaces), is_first=not number)
        for number, group in enumerate(groups or {b"": None})
    ]
    return [_from_any(station, peers[0]) for station in stations] + peers


def resolve(
    stations: Sequence[PlannedStation], to: str, report: ImportReport
) -> list[PlannedStation]:
    """Return *stations* with destinations and publishers; what has none becomes a comment.

    Args:
        stations: All of them.
        to: Destination of frames that have none; may be empty.
        report: Takes a note on each publisher and subscriber.
    """
    known = _owners(stations)
    done = []
    for station in stations:
        ports = {port.name: port for port in station.ports}
        frames = [
            _resolve_frame(each, station, ports[each.port], known, to) for each in station.frames
        ]
        done.append(msgspec.structs.replace(station, frames=tuple(frames)))
    # Frames first: a subscription needs to know whether its publisher is a comment.
    known, sent = _owners(done), _sent(done)
    done = [
        msgspec.structs.replace(
            station,
            subscriptions=tuple(
                _resolve_source(each, known, sent) for each in station.subscriptions
            ),
        )
        for station in done
    ]
    for station in done:
        _note(station, report)
    return done


def _owners(stations: Sequence[PlannedStation]) -> dict[NetId, _Owner]:
    found: dict[NetId, _Owner] = {}
    for station in stations:
        for port in station.ports:
            for net_id in (port.net_id, *port.known_as):
                found.setdefault(net_id, (station, port))
        if station.ports:
            found.setdefault(station.net_id, (station, station.ports[0]))
    return found


def _partners(station: PlannedStation) -> Iterator[NetId]:
    for frame in station.frames:
        if frame.target is not None and not frame.reasons:
            yield frame.target
    for each in station.subscriptions:
        if each.publisher is not None and not each.reasons:
            yield each.publisher


def _resolve_frame(
    frame: PlannedFrame,
    station: PlannedStation,
    port: PlannedPort,
    known: dict[NetId, _Owner],
    to: str,
) -> PlannedFrame:
    if frame.to:
        return frame
    replace = msgspec.structs.replace
    owner = known.get(frame.target) if frame.target else None
    if owner is not None and owner[0].name != station.name:
        place = f"{owner[0].name}/{owner[1].name}"
        remark = f"in the project to {frame.target}"
        if port.scheme != "ethernet" or owner[1].mac or _sends_to_group(*owner):
            return replace(frame, to=place, remarks=(*frame.remarks, remark))
        reason = f"the MAC address of {place} is not known: give that port its mac"
        return replace(frame, to=place, reasons=(*frame.reasons, reason))
    if to:
        remark = f"in the project {_wanted(frame)}: the destination is that of --to"
        return replace(frame, to=to, monitor_ms=0, remarks=(*frame.remarks, remark))
    if frame.target is not None and port.scheme == "ethernet" and owner is None:
        remark = "the MAC address is learned from the frames of that controller"
        return replace(frame, to=str(frame.target), remarks=(*frame.remarks, remark))
    reason = (
        f"in the project {_wanted(frame)}, which {port.interface} cannot reach; give another"
        " --address, or a destination with --to"
    )
    if not frame.target and not frame.wanted:
        reason = "the file does not say where it sends to; give a destination with --to"
    return replace(frame, reasons=(*frame.reasons, reason))


def _wanted(frame: PlannedFrame) -> str:
    if frame.wanted:
        return frame.wanted
    return f"to {frame.target}" if frame.target else "without a destination"


def _sends_to_group(station: PlannedStation, port: PlannedPort) -> bool:
    return any(
        frame.port == port.name and not frame.reasons and is_group_address(frame.to)
        for frame in station.frames
    )


def _sent(stations: Sequence[PlannedStation]) -> _Sent:
    """Return all PDs that are sent, by station, port and ID, and by ``STATION/PD``."""
    found: _Sent = {}
    for station in stations:
        for frame in station.frames:
            for pd in frame.pds:
                found.setdefault((station.name, frame.port, pd.id), (frame, pd))
                found.setdefault(f"{station.name}/{pd.name}", (frame, pd))
    return found


def _resolve_source(
    subscription: PlannedSubscription, known: dict[NetId, _Owner], sent: _Sent
) -> PlannedSubscription:
    replace = msgspec.structs.replace
    if subscription.reasons:
        return subscription
    if source := subscription.source:
        is_off = source in sent and sent[source][0].reasons
        reasons = (f"{source}, its publisher, is a comment",) if is_off else ()
        return replace(subscription, reasons=reasons)
    owner = known.get(subscription.publisher) if subscription.publisher else None
    if owner is None:
        return replace(subscription, remarks=(*subscription.remarks, *_readings(subscription)))
    station, port = owner
    match = sent.get((station.name, port.name, subscription.id))
    if match is None:
        return replace(subscription, reasons=(f"{station.name} sends no PD {subscription.id}",))
    frame, pd = match
    source = f"{station.name}/{pd.name}"
    reason = ""
    if frame.reasons:
        reason = f"{source}, its publisher, is a comment"
    elif pd.variable.type != subscription.variable.type:
        reason = f"{source} is {pd.variable.type}, not {subscription.variable.type}"
    remark = f"in the project from {subscription.publisher}, PD {subscription.id}"
    return replace(
        subscription,
        source=source,
        version=pd.version,
        reasons=(reason,) if reason else (),
        remarks=(*subscription.remarks, remark),
    )


def _readings(subscription: PlannedSubscription) -> Iterator[str]:
    """Yield the comment on the other NetID that the publisher may send as its own."""
    if subscription.publisher is None:
        return
    head, tail = subscription.publisher[:4], subscription.publisher[4:]
    # TwinCAT gives a system ….1.1, and its first device ….2.1.
    is_system = tail == b"\1\1"
    other = NetId(bytes(head) + (b"\2\1" if is_system else b"\1\1"))
    owner = "system" if is_system else "device"
    yield (
        f"publisher: {other} instead if its frames carry that; the project has the NetID of the"
        f" {owner}"
    )


def _from_any(station: PlannedStation, peer: PlannedStation) -> PlannedStation:
    """Return *station* with subscriptions to any publisher taken from *peer*."""
    sent = {pd.id: pd for frame in peer.frames for pd in frame.pds}
    subscriptions = tuple(
        msgspec.structs.replace(each, source=f"{peer.name}/{sent[each.id].name}")
        if each.publisher is None and not each.reasons and each.id in sent
        else each
        for each in station.subscriptions
    )
    return msgspec.structs.replace(station, subscriptions=subscriptions)


def _peer(
    stations: Sequence[PlannedStation],
    group: bytes,
    name: str,
    uri: InterfaceUri,
    *,
    is_first: bool,
) -> PlannedStation:
    """Return the peer that has the NetIDs which begin with *group*."""
    expected = [
        each.publisher
        for station in stations
        for each in station.subscriptions
        if each.publisher is not None and each.publisher[:4] == group and not each.reasons
    ]
    system = NetId(group + b"\1\1") if group else made_up_net_id(uri)
    device = NetId(bytes(system[:4]) + b"\2\1")
    net_id = expected[0] if expected else device
    port = PlannedPort(
        name="eap0",
        interface=str(uri),
        net_id=net_id,
        known_as=frozenset((system, device)),
    )
    variables = UniqueNames()
    # By ID: a PD that several stations expect is sent once.
    takers: dict[int, list[tuple[str, PlannedSubscription]]] = {}
    for station in stations:
        for each in station.subscriptions:
            is_any = each.publisher is None and is_first
            if not each.reasons and not each.source and (each.publisher == net_id or is_any):
                takers.setdefault(each.id, []).append((station.name, each))
    by_target: dict[tuple[str, str], list[PlannedSubscription]] = {}
    for taken in takers.values():
        targets = {(station_name, each.port) for station_name, each in taken}
        target = targets.pop() if len(targets) == 1 else _ALL
        by_target.setdefault(target, []).append(taken[0][1])
    names = UniqueNames()
    frames = []
    for target, wanted in by_target.items():
        remarks: tuple[str, ...] = ()
        if port.scheme == "ethernet":
            # Other ports learn the MAC address of this one by it.
            to = "multicast"
        elif target == _ALL:
            to, remarks = _UDP_GROUP, (_SHARED,)
        else:
            to = "/".join(target)
        pds = tuple(
            PlannedPd(
                name=names.take(each.name),
                id=each.id,
                version=each.version,
                variable=PlannedVariable(variables.take(each.name), each.variable.type),
            )
            for each in wanted
        )
        frames.append(
            PlannedFrame(
                name=names.take(f"to-{target[0]}"),
                port="eap0",
                to=to,
                pds=pds,
                remarks=remarks,
            )
        )
    return PlannedStation(
        name=name,
        net_id=device if net_id == system else system,
        cycle_us=stations[0].cycle_us,
        ports=(port,),
        frames=tuple(frames),
        subscriptions=tuple(_peer_subscriptions(stations, group, variables, is_first=is_first)),
        remarks=(
            "The other side: it receives what the imported stations send, and sends the rest.",
        ),
    )


def _peer_subscriptions(
    stations: Sequence[PlannedStation], group: bytes, variables: UniqueNames, *, is_first: bool
) -> Iterator[PlannedSubscription]:
    names = UniqueNames()
    for station in stations:
        for frame in station.frames:
            is_for_group = is_group_address(frame.to) and is_first
            is_own = frame.target is not None and frame.target[:4] == group
            if frame.reasons or not (is_for_group or is_own):
                continue
            period_us = station.cycle_us * frame.divider
            for pd in frame.pds:
                timeout_ms = 5 * max(period_us, pd.cycle_us) // 1000
                yield PlannedSubscription(
                    name=names.take(pd.name, station.name),
                    port="eap0",
                    source=f"{station.name}/{pd.name}",
                    id=pd.id,
                    version=pd.version,
                    variable=PlannedVariable(
                        variables.take(pd.variable.name, station.name), pd.variable.type
                    ),
                    timeout_ms=max(_MIN_TIMEOUT_MS, timeout_ms),
                )


def _note(station: PlannedStation, report: ImportReport) -> None:
    """Note the outcome for each publisher and subscriber of a project."""
    for frame in station.frames:
        if frame.origin is not None:
            ids = ", ".join(str(pd.id) for pd in frame.pds) or "none"
            _note_one(frame, f"sends PD {ids} to {frame.to}", "not sent", report)
    for each in station.subscriptions:
        if each.origin is not None:
            source = each.source or (str(each.publisher) if each.publisher else "any publisher")
            _note_one(each, f"receives PD {each.id} of {source}", "not received", report)


def _note_one(
    planned: PlannedFrame | PlannedSubscription, taken: str, refused: str, report: ImportReport
) -> None:
    origin = planned.origin
    if origin is None:
        return
    if planned.reasons:
        message = f"{refused}: {'; '.join(planned.reasons)}"
        report.note(origin.file, origin.line, origin.item, ImportOutcome.COMMENT, message)
        return
    report.note(origin.file, origin.line, origin.item, ImportOutcome.TAKEN, taken)
    for remark in planned.remarks:
        if "unknown setting" in remark:
            report.note(origin.file, origin.line, origin.item, ImportOutcome.WARNING, remark)
