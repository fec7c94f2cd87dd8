"""Checks of what stations send: references, destinations, triggers and the size of frames."""

from __future__ import annotations

from eap.codec import pdo
from eap.codec.pd import FIRST_PD, PdHeader
from eap.config.check_address import check_address, check_monitoring
from eap.config.check_ports import check_names
from eap.config.destination import EXPECTED, frame_budget, resolve
from eap.config.finding import Report, one_of
from eap.config.index import Index
from eap.config.structs import Frame, Publish, Station
from eap.near import near
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
    _check_modulo(frame, report)
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
    budget = frame_budget(destination, uri)
    if size > budget:
        message = f"frame {frame.name!r} has {size} octets with its {len(pds)} PDs"
        expected = f"at most {budget} to {destination or 'who asks'} (more frames carry more)"
        report.add(frame.at, message, expected)


def _check_modulo(section: Frame | Publish, report: Report) -> None:
    if section.modulo is None:
        return
    path = f"{section.at}.modulo"
    if section.divider is None:
        report.add(path, f"{section.name!r} has a modulo but no divider", "both or none")
    elif section.modulo >= section.divider:
        message = f"modulo {section.modulo} of {section.name!r} never comes up"
        report.add(path, message, f"less than the divider, {section.divider}")


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
    _check_triggers(pd, report)
    _check_times(index, report, station, pd)


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


def _check_triggers(pd: Publish, report: Report) -> None:
    _check_modulo(pd, report)
    if pd.cycle_us is not None and pd.divider is not None:
        message = f"PD {pd.name!r} has a cycle_us and a divider"
        report.add(f"{pd.at}.divider", message, "one of the two")
    if pd.on_change is None:
        return
    for key, value in (("cycle_us", pd.cycle_us), ("divider", pd.divider)):
        if value is not None:
            message = f"PD {pd.name!r} is sent on change and has a {key}"
            report.add(f"{pd.at}.{key}", message, "on_change.timeout_ms for sending it again")
    for key in ("timeout_ms", "inhibit_us"):
        value = getattr(pd.on_change, key)
        if not 0 <= value <= 0xFFFF_FFFF:
            expected = "0 (off) to 4294967295"
            report.add(f"{pd.at}.on_change.{key}", f"{key} is {value}", expected)
    timeout_us = pd.on_change.timeout_ms * 1000
    if 0 < timeout_us < pd.on_change.inhibit_us:
        message = f"PD {pd.name!r} is to be sent again before changes may be"
        expected = f"timeout_ms of at least {-(-pd.on_change.inhibit_us // 1000)}"
        report.add(f"{pd.at}.on_change.timeout_ms", message, expected)


def _check_times(index: Index, report: Report, station: Station, pd: Publish) -> None:
    cycle = index.cycle_us(station)
    if pd.cycle_us is not None and pd.cycle_us % cycle:
        below = max(pd.cycle_us // cycle, 1) * cycle
        expected = f"{below} or {below + cycle}" if below < pd.cycle_us else str(below)
        message = f"cycle_us {pd.cycle_us} of PD {pd.name!r} is no multiple of the device cycle"
        report.add(f"{pd.at}.cycle_us", f"{message}, {cycle}", expected)
        return
    frame = index.frames.get((station.name, pd.frame))
    if frame is None or frame.divider is None:
        return
    gate, gate_modulo = frame.divider, frame.modulo or 0
    if pd.cycle_us is not None:
        key, step, modulo = "cycle_us", pd.cycle_us // cycle, 0
    elif pd.divider is not None:
        key, step, modulo = "divider", pd.divider, pd.modulo or 0
    else:
        return
    frame_is = f"frame {frame.name!r} leaves only every {gate} cycles (line "
    frame_is += f"{report.line_of(f'{frame.at}.divider')})"
    if step % gate:
        message = f"PD {pd.name!r} is due every {step} cycles, but {frame_is}"
        multiple = gate * cycle if key == "cycle_us" else gate
        report.add(f"{pd.at}.{key}", message, f"a multiple of {multiple}")
    elif modulo % gate != gate_modulo:
        message = f"PD {pd.name!r} is due at {modulo} of {step} cycles, but {frame_is}"
        expected = f"a modulo that leaves {gate_modulo} when divided by {gate}"
        report.add(f"{pd.at}.{'modulo' if pd.modulo is not None else key}", message, expected)


def _check_ids(index: Index, report: Report) -> None:
    first: dict[tuple[str, int], str] = {}
    for sent in index.sent.values():
        key = (sent.port.net_id, sent.pd.id)
        path = f"{sent.pd.at}.id"
        if key in first:
            line = report.line_of(first[key])
            message = f"PD id {sent.pd.id} is used twice by publisher {sent.port.net_id}"
            report.add(path, f"{message} (first in line {line})", "an id of its own for each PD")
        else:
            first[key] = path
