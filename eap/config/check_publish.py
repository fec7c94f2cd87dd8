"""Checks of what stations send: references, destinations, triggers, sizes and polls.

Of polled exchange: each answer has a request and a way back, without chains and loops.  A request
is a PD that is sent by itself, an answer one that is sent for a request only.  An answer that is a
request again would make the traffic of one station depend on that of two others.
"""

from __future__ import annotations

from msgspec.structs import replace

from eap.codec import pdo
from eap.codec.pd import FIRST_PD, PdHeader
from eap.config.check_ports import check_names
from eap.config.destination import EXPECTED, check_address, check_monitoring, resolve
from eap.config.finding import FindingReport, one_of
from eap.config.index import Index, SentPd
from eap.config.structs import FrameSection, PublishSection, StationSection, SubscribeSection
from eap.pd import rules
from eap.pd.device import FaultCode
from eap.pd.spec import REQUESTER, PortKind
from eap.suggest import suggest


def check_publish(index: Index, report: FindingReport) -> None:
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
    index: Index, report: FindingReport, station: StationSection, at: str, name: str
) -> None:
    """Report a *name* at *at* that is no EAP port of *station*."""
    known = [port.name for port in station.ports if port.kind is PortKind.EAP]
    if name in known or name in report.broken:
        return
    if (station.name, name) in index.ports:
        report.add(f"{at}.port", f"port {name} is a bus port", one_of(known))
    else:
        message = f"station {station.name} has no port {name!r}{suggest(name, known)}"
        report.add(f"{at}.port", message, one_of(known))


def _check_frame(
    index: Index, report: FindingReport, station: StationSection, frame: FrameSection
) -> None:
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


def _check_pd(
    index: Index, report: FindingReport, station: StationSection, pd: PublishSection
) -> None:
    known = [frame.name for frame in station.frames]
    if pd.frame not in known and pd.frame not in report.broken:
        message = f"station {station.name} has no frame {pd.frame!r}{suggest(pd.frame, known)}"
        report.add(f"{pd.at}.frame", message, one_of(known))
    if not pd.variables and f"{pd.at}.variables[0]" not in report.lines:
        report.add(f"{pd.at}.variables", f"PD {pd.name!r} has no variables", "at least one")
    for position, name in enumerate(pd.variables):
        if index.type_text(station, name) is None and not is_unread(index, report, station, name):
            names = index.names(station)
            message = f"station {station.name} has no variable {name!r}{suggest(name, names)}"
            report.add(f"{pd.at}.variables[{position}]", message, one_of(names))
    _check_triggers(index, report, station, pd)


def is_unread(index: Index, report: FindingReport, station: StationSection, name: str) -> bool:
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


def _check_triggers(
    index: Index, report: FindingReport, station: StationSection, pd: PublishSection
) -> None:
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


def _check_ids(index: Index, report: FindingReport) -> None:
    ids = (
        ((sent.port.net_id, sent.pd.id), sent) for sent in index.sent.values() if sent.port.net_id
    )
    for sent, first in rules.doubles(ids):
        message = f"PD id {sent.pd.id} is used twice by publisher {sent.port.net_id}"
        message += f" (first in line {report.line_of(f'{first.pd.at}.id')})"
        report.add(f"{sent.pd.at}.id", message, "an id of its own for each PD")


_PUSHED = "a request that is sent by itself"
_ONE_PORT = "one port for both: an answer goes back as its request came"


def check_polls(index: Index, report: FindingReport) -> None:
    """Report every request and answer that do not find each other."""
    for station in index.plant.stations:
        for frame in station.frames:
            _check_poll_frame(report, station, frame)
        for pd in station.publish:
            if pd.poll:
                report.add_breaches(pd.at, rules.check_polled(pd.spec()))
                _check_answer(index, report, station, pd)
        for subscription in station.subscribe:
            if subscription.poll:
                _check_question(index, report, station, subscription)
            else:
                _check_unasked(index, report, subscription)


def _check_poll_frame(report: FindingReport, station: StationSection, frame: FrameSection) -> None:
    spec, line = frame.spec(frame.to), report.line_of(f"{frame.at}.to")
    report.add_breaches(frame.at, rules.check_answers(spec))
    for pd in station.publish:
        if pd.frame == frame.name:
            report.add_breaches(pd.at, rules.check_frame_of(pd.spec(), spec, f"line {line}"))


def _check_answer(
    index: Index, report: FindingReport, station: StationSection, pd: PublishSection
) -> None:
    path = f"{pd.at}.poll"
    request = index.subscription(station, pd.poll)
    if request is None:
        if pd.poll not in report.broken:
            known = [each.name for each in station.subscribe]
            message = f"station {station.name} has no subscription {pd.poll!r}"
            report.add(path, message + suggest(pd.poll, known), one_of(known))
        return
    frame = index.frames.get((station.name, pd.frame))
    if frame is not None and frame.port != request.port:
        message = f"PD {pd.name!r} leaves port {frame.port}, but {request.name!r} arrives at "
        message += f"{request.port} (line {report.line_of(f'{request.at}.port')})"
        report.add(path, message, _ONE_PORT)
    sent = index.sent.get((station.name, pd.name))
    chain = [] if sent is None else _chain(index, sent)
    if len(chain) > 1 and chain[0] == chain[-1]:
        message = f"polls go in a circle: {', '.join(each.label for each in chain)}"
        report.add(path, message, _PUSHED)
    elif len(chain) > 1:
        message = f"PD {pd.name!r} answers {chain[1].label}, which is polled itself "
        message += f"(line {report.line_of(f'{chain[1].pd.at}.poll')})"
        report.add(path, message, _PUSHED)
    elif request.poll:
        message = f"PD {pd.name!r} answers {request.name!r}, which is an answer itself "
        message += f"(line {report.line_of(f'{request.at}.poll')})"
        report.add(path, message, _PUSHED)


def _chain(index: Index, sent: SentPd) -> list[SentPd]:
    """Return the polled PDs from *sent* to what it answers, and on; a circle ends as it began."""
    chain = [sent]
    while True:
        last = chain[-1]
        request = index.subscription(last.station, last.pd.poll)
        requests = [] if request is None else index.publishers(request)
        polled = next((each for each in requests if each.pd.poll), None)
        if polled is None:
            return chain
        if polled in chain:
            return [*chain, polled]
        chain.append(polled)


def _check_question(
    index: Index, report: FindingReport, station: StationSection, subscription: SubscribeSection
) -> None:
    path, name = f"{subscription.at}.poll", subscription.poll
    own = index.sent.get((station.name, name))
    if own is None:
        known = [pd.name for pd in station.publish]
        if name not in report.broken and name not in known:  # else its frame or port was reported
            message = f"station {station.name} publishes no {name!r}{suggest(name, known)}"
            report.add(path, message, one_of(known))
        return
    if own.port.name != subscription.port:
        message = f"{subscription.name!r} arrives at port {subscription.port}, but {name!r} "
        message += f"leaves {own.port.name} (line {report.line_of(f'{own.frame.at}.port')})"
        report.add(path, message, _ONE_PORT)
    publishers = index.publishers(subscription)
    for sent in publishers:
        _check_asked(index, report, subscription, sent, own)
    if own.pd.poll and not publishers:
        message = f"{subscription.name!r} is asked for by {name!r}, which is polled itself "
        message += f"(line {report.line_of(f'{own.pd.at}.poll')})"
        report.add(path, message, _PUSHED)


def _check_asked(
    index: Index, report: FindingReport, subscription: SubscribeSection, sent: SentPd, own: SentPd
) -> None:
    """Report that *sent*, which *subscription* takes, does not answer *own*."""
    path = f"{subscription.at}.poll"
    if not sent.pd.poll:
        message = f"{subscription.name!r} is polled, but {sent.label} is sent by itself"
        report.add(path, message, f"no poll here, or poll in line {report.line_of(sent.pd.at)}")
        return
    request = index.subscription(sent.station, sent.pd.poll)
    if request is not None and own not in index.publishers(request):
        message = f"{sent.label} does not answer {own.label} but {sent.station.name}'s "
        message += f"{request.name!r} (line {report.line_of(f'{request.at}.from')})"
        asked = [each.pd.name for each in index.publishers(request) if each.station is own.station]
        report.add(path, message, one_of(asked) if asked else "a PD that is received there")


def _check_unasked(index: Index, report: FindingReport, subscription: SubscribeSection) -> None:
    for sent in index.publishers(subscription):
        if sent.pd.poll:
            line = report.line_of(f"{sent.pd.at}.poll")
            message = f"{sent.label} is sent only to who asks for it (line {line})"
            report.add(f"{subscription.at}.from", message, "poll: the PD of this station that asks")
