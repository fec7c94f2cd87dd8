"""Checks of what stations send: references, destinations, triggers and the size of frames."""

from __future__ import annotations

from msgspec.structs import replace

from eap.codec import pdo
from eap.codec.pd import FIRST_PD, PdHeader
from eap.config.check_address import check_address, check_monitoring
from eap.config.check_ports import check_names
from eap.config.destination import EXPECTED, resolve
from eap.config.finding import Report, one_of
from eap.config.index import Index
from eap.config.structs import Frame, Publish, Station
from eap.near import near
from eap.pd import rules
from eap.pd.device import FaultCode
from eap.pd.spec import REQUESTER, PortKind


def check_publish(index: Index, report: Report) -> None:
    """Report every frame and TxPD that cannot be sent as described."""
    for station in index.plant.stations:
        check_names(((f.at, f.name) for f in station.frames), "frame", report)
        check_names(((p.at, p.name) for p in station.publish), "PD", report)
        for frame in station.frames:
            check_port_reference(index, report, station, frame.at, frame.port)
            _check_frame(index, report, station, frame)
        for pd in station.publish:
            _check_pd(index, report, station, pd)
    _check_ids(index, report)


def check_port_reference(
    index: Index, report: Report, station: Station, at: str, name: str
) -> None:
    """Report a *name* at *at* that is no EAP port of *station*."""
    known = [port.name for port in station.ports if port.kind is PortKind.EAP]
    if name in known or name in report.broken:
        return
    if (station.name, name) in index.ports:
        report.add(f"{at}.port", f"port {name} is a bus port", one_of(known))
    else:
        message = f"station {station.name} has no port {name!r}{near(name, known)}"
        report.add(f"{at}.port", message, one_of(known))


def _check_frame(index: Index, report: Report, station: Station, frame: Frame) -> None:
    report.add_breaches(frame.at, rules.check_modulo(frame.name, frame.divider, frame.modulo))
    pds = [pd for pd in station.publish if pd.frame == frame.name]
    known = {each.name for each in station.frames}
    if not pds and not report.broken and all(pd.frame in known for pd in station.publish):
        expected = f"a PD under publish with frame: {frame.name}"
        report.add(frame.at, f"frame {frame.name!r} carries no PD", expected)
    uri = index.uris.get((station.name, frame.port))
    if uri is None or index.eap_port(station, frame.port) is None:
        return
    try:
        destination = None if frame.to == REQUESTER else resolve(frame.to, uri, index)
    except ValueError as exc:
        if not set(frame.to.split("/")) & report.broken and uri.scheme in EXPECTED:
            message = f"destination of frame {frame.name!r}: {exc}"
            report.add(f"{frame.at}.to", message, EXPECTED[uri.scheme])
        return
    check_address(index, report, (station, frame), destination)
    check_monitoring(report, frame, destination, uri)
    size = FIRST_PD
    for pd in pds:
        sent = index.sent.get((station.name, pd.name))
        kinds = index.types(sent) if sent else None
        size += PdHeader.SIZE + (pdo.layout(kinds).size if kinds else 0)
    kind = None if destination is None else destination.kind
    if size > (budget := rules.frame_budget(uri.scheme, kind)):
        message = f"frame {frame.name!r} has {size} octets with its {len(pds)} PDs"
        expected = f"at most {budget} to {destination or 'who asks'} (more frames carry more)"
        report.add(frame.at, message, expected)


def _check_pd(index: Index, report: Report, station: Station, pd: Publish) -> None:
    known = [frame.name for frame in station.frames]
    if pd.frame not in known and pd.frame not in report.broken:
        message = f"station {station.name} has no frame {pd.frame!r}{near(pd.frame, known)}"
        report.add(f"{pd.at}.frame", message, one_of(known))
    if not pd.variables and f"{pd.at}.variables[0]" not in report.lines:
        report.add(f"{pd.at}.variables", f"PD {pd.name!r} has no variables", "at least one")
    for position, name in enumerate(pd.variables):
        if index.type_text(station, name) is None and not is_unread(index, report, station, name):
            names = index.names(station)
            message = f"station {station.name} has no variable {name!r}{near(name, names)}"
            report.add(f"{pd.at}.variables[{position}]", message, one_of(names))
    _check_triggers(index, report, station, pd)


def is_unread(index: Index, report: Report, station: Station, name: str) -> bool:
    """Tell whether *name* may belong to something that was reported already."""
    if name in report.broken:
        return True
    if any(name.startswith(f"{port}.") for port in index.unread_buses(station)):
        return True
    return any(
        name.startswith(f"{subscription.name}.") and not index.publishers(subscription)
        for subscription in station.subscribe
        if subscription.variables is None
    )


def _check_triggers(index: Index, report: Report, station: Station, pd: Publish) -> None:
    spec, frame = pd.spec(), index.frames.get((station.name, pd.frame))
    report.add_breaches(pd.at, rules.check_modulo(pd.name, pd.divider, pd.modulo))
    report.add_breaches(pd.at, rules.check_triggers(spec))
    for key in ("timeout_ms", "inhibit_us"):
        value = getattr(pd.on_change, key, 0)
        if not 0 <= value <= 0xFFFF_FFFF:
            expected = "0 (off) to 4294967295"
            report.add(f"{pd.at}.on_change.{key}", f"{key} is {value}", expected)
    if pd.modulo is not None and not pd.divider:
        spec = replace(spec, trigger=replace(spec.trigger, modulo=0))  # reported above
    gate = None if frame is None else frame.spec(frame.to)
    for breach in rules.check_times(spec, gate, index.cycle_us(station)):
        message = breach.message
        if breach.code is FaultCode.GATE and frame is not None:
            message += f" (line {report.line_of(f'{frame.at}.divider')})"
        report.add(f"{pd.at}.{breach.key}", message, breach.expected)


def _check_ids(index: Index, report: Report) -> None:
    ids = (((sent.port.net_id, sent.pd.id), sent) for sent in index.sent.values())
    for sent, first in rules.doubles(ids):
        message = f"PD id {sent.pd.id} is used twice by publisher {sent.port.net_id}"
        message += f" (first in line {report.line_of(f'{first.pd.at}.id')})"
        report.add(f"{sent.pd.at}.id", message, "an id of its own for each PD")
