"""Checks of process data: frames and PDs that stations send, and PDs that they receive.

Rules of polled exchange: a request is a PD that its station sends by itself, an answer is a PD that
its station sends only for a request.  Each answer needs a request and a path back to the requester.
An answer cannot be a request: the traffic of one station would then depend on that of two others.
"""

from __future__ import annotations

from msgspec.structs import replace

from eap.codec import datatypes
from eap.codec.datatypes import variable_of
from eap.codec.pd import FIRST_PD, PdHeader
from eap.config.finding import FindingReport, one_beside, one_of
from eap.config.index import Index, SentPd
from eap.config.ports import (
    EXPECTED,
    check_frame_monitoring,
    check_names,
    check_net_id_destination,
    reaches,
    resolve_destination,
)
from eap.config.structs import (
    ANY_SOURCE,
    FrameSection,
    FromSection,
    PublishSection,
    StationSection,
    SubscribeSection,
)
from eap.ids import NetId
from eap.pd import rules
from eap.pd.address import is_group_source, source_octets
from eap.pd.authentication import SIGNED_BYTES
from eap.pd.device import FaultCode
from eap.pd.spec import REQUESTER, Authentication
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
        _check_keys(index, report, station)
    _check_ids(index, report)


def _check_keys(index: Index, report: FindingReport, station: StationSection) -> None:
    """Report what needs keys where the station has none."""
    if index.pd_keys(station):
        return
    expected = "pd_keys of the station, a file of 'eapctl keys new', or of defaults"
    for frame in station.frames:
        if frame.sign:
            message = f"frame {frame.name!r} is signed, but {station.name} has no keys"
            report.add(f"{frame.at}.sign", message, expected)
    for subscription in station.subscribe:
        if subscription.auth is not Authentication.OFF:
            message = f"{subscription.name!r} looks at signatures, but {station.name} has no keys"
            report.add(f"{subscription.at}.auth", message, expected)


def check_port_reference(
    index: Index, report: FindingReport, station: StationSection, at: str, name: str
) -> None:
    """Report a *name* at *at* that is not an EAP port of *station*."""
    known = station.eap_ports
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
    pds = [pd for pd in station.publish if pd.frame == frame.name]
    spec = frame.spec(frame.to, tuple(pd.spec() for pd in pds))
    report.add_breaches(frame.at, rules.check_frame(spec, frame.modulo))
    known = {each.name for each in station.frames}
    # A PD with errors may be the one that belongs here.
    if not pds and not report.broken and all(pd.frame in known for pd in station.publish):
        expected = f"a PD under publish with frame: {frame.name}"
        report.add(frame.at, f"frame {frame.name!r} carries no PD", expected)
    uri = index.uris.get((station.name, frame.port))
    if uri is None or index.eap_port(station, frame.port) is None:
        return
    try:
        destination = None if frame.to == REQUESTER else resolve_destination(frame.to, uri, index)
    except ValueError as exc:
        if not set(frame.to.split("/")) & report.broken and uri.scheme in EXPECTED:
            message = f"destination of frame {frame.name!r}: {exc}"
            report.add(f"{frame.at}.to", message, EXPECTED[uri.scheme])
        return
    check_net_id_destination(index, report, (station, frame), destination)
    check_frame_monitoring(report, frame, destination, uri)
    size = FIRST_PD + (SIGNED_BYTES if frame.sign else 0)
    for pd in pds:
        sent = index.sent.get((station.name, pd.name))
        kinds = index.types(sent) if sent else None
        # PDs lie back to back in a frame, without alignment (ETG.1005).
        size += PdHeader.SIZE + (datatypes.layout(kinds).size if kinds else 0)
    kind = None if destination is None else destination.kind
    if size > (budget := rules.frame_budget(uri.scheme, kind)):
        message = f"frame {frame.name!r} has {size} bytes with its {len(pds)} PDs"
        expected = f"at most {budget} to {destination or 'the requester'} (more frames carry more)"
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
        if index.type_text(station, name) is None and not is_unresolved(
            index, report, station, name
        ):
            names = index.names(station)
            message = f"station {station.name} has no variable {name!r}{suggest(name, names)}"
            expected = one_beside(name, names)
            if (variable := variable_of(name, names)) in names:
                message = f"{name!r} is a part of {variable!r}; a PD carries whole variables"
                expected = f"{variable}, or a variable of its own that a link fills"
            report.add(f"{pd.at}.variables[{position}]", message, expected)
    _check_triggers(index, report, station, pd)


def is_unresolved(index: Index, report: FindingReport, station: StationSection, name: str) -> bool:
    """Return whether *name* may belong to a section that was reported already."""
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
    report.add_breaches(pd.at, rules.check_pd(spec, pd.modulo))
    if pd.modulo is not None and not pd.divider:
        spec = replace(spec, trigger=replace(spec.trigger, modulo=0))  # reported above
    gate = None if frame is None else frame.spec(frame.to)
    for breach in rules.check_times(spec, gate, index.cycle_us(station)):
        message = breach.message
        if breach.code is FaultCode.GATE and frame is not None:
            message += f" (line {report.line_of(f'{frame.at}.divider')})"
        report.add(f"{pd.at}.{breach.key}", message, breach.expected)


def _check_ids(index: Index, report: FindingReport) -> None:
    # The pair of publisher and id is the key of a PD on the wire (ETG.1005).
    ids = (
        ((sent.port.net_id, sent.pd.id), sent) for sent in index.sent.values() if sent.port.net_id
    )
    for sent, first in rules.duplicates(ids):
        message = f"PD id {sent.pd.id} is used twice by publisher {sent.port.net_id}"
        message += f" (first in line {report.line_of(f'{first.pd.at}.id')})"
        report.add(f"{sent.pd.at}.id", message, "an id of its own for each PD")


_PUSHED = "a request that is sent by itself"
_ONE_PORT = "one port for both: an answer goes back as its request came"


def check_polls(index: Index, report: FindingReport) -> None:
    """Report every request without an answer, and every answer without a request."""
    for station in index.plant.stations:
        for frame in station.frames:
            _check_poll_frame(report, station, frame)
        for pd in station.publish:
            if pd.poll:
                _check_answer(index, report, station, pd)
        for subscription in station.subscribe:
            if subscription.poll:
                _check_polled_subscription(index, report, station, subscription)
            else:
                _check_unpolled(index, report, subscription)


def _check_poll_frame(report: FindingReport, station: StationSection, frame: FrameSection) -> None:
    spec, line = frame.spec(frame.to), report.line_of(f"{frame.at}.to")
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
        message = f"polls form a loop: {', '.join(each.label for each in chain)}"
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
    """Return the chain of polled PDs that *sent* answers; a loop ends with the PD it began with."""
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


def _check_polled_subscription(
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
        _check_request(index, report, subscription, sent, own)
    if own.pd.poll and not publishers:
        message = f"{subscription.name!r} is requested by {name!r}, which is polled itself "
        message += f"(line {report.line_of(f'{own.pd.at}.poll')})"
        report.add(path, message, _PUSHED)


def _check_request(
    index: Index, report: FindingReport, subscription: SubscribeSection, sent: SentPd, own: SentPd
) -> None:
    """Report that *sent*, which *subscription* receives, does not answer *own*."""
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


def _check_unpolled(index: Index, report: FindingReport, subscription: SubscribeSection) -> None:
    for sent in index.publishers(subscription):
        if sent.pd.poll:
            line = report.line_of(f"{sent.pd.at}.poll")
            message = f"{sent.label} is sent only on request (line {line})"
            report.add(
                f"{subscription.at}.from", message, "poll: the PD of this station that requests it"
            )


def check_subscribe(index: Index, report: FindingReport) -> None:
    """Report every RxPD that would receive nothing, or another layout than it expects."""
    for station in index.plant.stations:
        check_names(((s.at, s.name) for s in station.subscribe), "subscription", report)
        taken: dict[tuple[str, str, int], str] = {}
        for subscription in station.subscribe:
            check_port_reference(index, report, station, subscription.at, subscription.port)
            publishers = index.publishers(subscription)
            _check_source(index, report, subscription, publishers)
            _check_sender(index, report, station, subscription)
            _check_variables(subscription, report)
            for sent in publishers:
                _check_match(index, report, subscription, sent)
            _check_arrival(index, report, station, subscription)
            _check_timeout(index, report, station, subscription)
            _check_duplicates(subscription, publishers, taken, report)


def _check_source(
    index: Index, report: FindingReport, subscription: SubscribeSection, publishers: list[SentPd]
) -> None:
    path, source = f"{subscription.at}.from", subscription.source
    if publishers:
        if subscription.foreign:
            message = f"{subscription.name!r} is foreign, but this plant publishes it as "
            expected = "no foreign, or another publisher"
            report.add(f"{subscription.at}.foreign", message + publishers[0].label, expected)
        elif isinstance(source, FromSection) and (source.cycle_us or source.step):
            message = f"{publishers[0].label} is in this plant, which gives cycle_us and step"
            report.add(path, message, "both to be left out")
    elif isinstance(source, FromSection):
        _check_numbers(report, subscription, source)
    elif subscription.foreign:
        report.add(path, f"{source} is foreign", "publisher and id of what is not in this plant")
    elif not set(source.split("/")) & report.broken:
        known = [f"{s.name}/{pd.name}" for s in index.plant.stations for pd in s.publish]
        if source not in known:  # else its frame or port was reported
            message = f"no station of this plant publishes {source!r}{suggest(source, known)}"
            report.add(path, message, f"STATION/PD: {one_of(known)}")


def _check_sender(
    index: Index, report: FindingReport, station: StationSection, subscription: SubscribeSection
) -> None:
    """Report a source that no frame of the subscription's port can have."""
    uri = index.uris.get((station.name, subscription.port))
    if subscription.sender in {"", ANY_SOURCE} or uri is None:
        return
    kinds = {"ethernet": (6, "a MAC address"), "udp": (4, "an IPv4 address")}
    size, kind = kinds.get(uri.scheme, kinds["udp"])
    try:
        octets = source_octets(subscription.sender)
        is_host = len(octets) == size and any(octets) and not is_group_source(octets)
    except ValueError:
        is_host = False
    if not is_host or uri.scheme == "loop":
        expected = "it only on ethernet, udp and tcp" if uri.scheme == "loop" else f"{kind} or any"
        message = f"source of {subscription.name!r} is {subscription.sender!r} on {uri}"
        report.add(f"{subscription.at}.source", message, expected)


def _check_numbers(
    report: FindingReport, subscription: SubscribeSection, source: FromSection
) -> None:
    path = f"{subscription.at}.from"
    if source.publisher == "any":
        if subscription.auth is not Authentication.OFF:
            message = f"{subscription.name!r} looks at signatures of any publisher"
            report.add(f"{subscription.at}.auth", message, "one publisher: each counts by itself")
    else:
        try:
            NetId.parse(source.publisher)
        except ValueError as exc:
            report.add(f"{path}.publisher", str(exc), "a NetID or any")
            return
    if not subscription.foreign:
        message = f"no station of this plant publishes id {source.id} as {source.publisher}"
        report.add(path, message, "a publisher of this plant, or foreign: true")


def _check_variables(subscription: SubscribeSection, report: FindingReport) -> None:
    path, name = f"{subscription.at}.variables", subscription.name
    if subscription.variables is None:
        if isinstance(subscription.source, FromSection):
            report.add(subscription.at, f"subscription {name!r} has no variables", "its variables")
    elif not subscription.variables and not report.broken:
        report.add(path, f"subscription {name!r} has no variables", "at least one")


def _check_match(
    index: Index, report: FindingReport, subscription: SubscribeSection, sent: SentPd
) -> None:
    """Report where *subscription* differs from the PD *sent*, naming both lines."""
    at, label = subscription.at, sent.label
    if not subscription.ignore_version and subscription.version not in (None, sent.pd.version):
        line = report.line_of(f"{sent.pd.at}.version")
        message = f"version {subscription.version} of {subscription.name!r}, but {label} has "
        message += f"{sent.pd.version} (line {line})"
        report.add(f"{at}.version", message, f"{sent.pd.version}, or ignore_version: true")
    if subscription.auth is not Authentication.OFF and not sent.frame.sign:
        line = report.line_of(sent.frame.at)
        message = f"{subscription.name!r} looks at the signature of {label}, but frame "
        message += f"{sent.frame.name!r} (line {line}) has none"
        report.add(f"{at}.auth", message, "sign: true at the frame, or auth: off")
    theirs = index.types(sent)
    if not subscription.variables or theirs is None:
        return
    line = report.line_of(f"{sent.pd.at}.variables")
    if len(subscription.variables) != len(theirs):
        message = f"{subscription.name!r} has {len(subscription.variables)} variables, but {label} "
        message += f"has {len(theirs)} (line {line})"
        if not report.broken:
            report.add(f"{at}.variables", message, ", ".join(kind.name for kind in theirs))
        return
    pairs = zip(subscription.variables.items(), sent.pd.variables, theirs, strict=True)
    for (name, variable), their_name, kind in pairs:
        try:
            ours = datatypes.parse(variable.type)
        except ValueError:
            continue  # reported with the variable
        if ours.wire != kind.wire:
            message = f"{name} is {ours.name}, but {label} sends {their_name} as {kind.name} "
            report.add(f"{at}.variables.{name}", f"{message}(line {line})", kind.name)


def _check_arrival(
    index: Index, report: FindingReport, station: StationSection, subscription: SubscribeSection
) -> None:
    receiver = index.eap_port(station, subscription.port)
    uri = index.uris.get((station.name, subscription.port))
    if receiver is None or uri is None:
        return
    missed = []
    for sent in index.publishers(subscription):
        sender_uri = index.uris.get((sent.station.name, sent.port.name))
        if sender_uri is None or sent.frame.to == REQUESTER:
            return  # an answer goes back to its requester, which is checked with the polls
        try:
            destination = resolve_destination(sent.frame.to, sender_uri, index)
        except ValueError:
            return  # reported with the frame
        # One is enough: with any publisher a subscription may match several PDs.
        if reaches(destination, (sent.port, sender_uri), (receiver, uri)):
            return
        line = report.line_of(f"{sent.frame.at}.to")
        missed.append(f"{sent.label} goes to {destination} (line {line})")
    if missed:
        message = f"{', '.join(missed)}, which does not reach {station.name}/{receiver.name}"
        report.add(f"{subscription.at}.from", f"{message} ({uri})", "a frame to this port")


def _check_timeout(
    index: Index, report: FindingReport, station: StationSection, subscription: SubscribeSection
) -> None:
    if not subscription.timeout_ms:
        return
    path = f"{subscription.at}.timeout_ms"
    timeout_us = subscription.timeout_ms * 1000
    shown = f"timeout_ms {subscription.timeout_ms} of {subscription.name!r}"
    cycle = index.cycle_us(station)
    breaches = list(rules.check_time_out(subscription.name, subscription.timeout_ms, cycle))
    report.add_breaches(subscription.at, breaches)
    if breaches:
        return
    for sent in index.publishers(subscription):
        period = index.step(sent) * index.cycle_us(sent.station)
        if timeout_us < period:
            message = f"{shown} is shorter than the {period} us between two of {sent.label}"
            report.add(path, message, f"at least {-(-period // 1000)}, or 0 for never")


def _check_duplicates(
    subscription: SubscribeSection,
    publishers: list[SentPd],
    taken: dict[tuple[str, str, int], str],
    report: FindingReport,
) -> None:
    source = subscription.source
    keys = [(subscription.port, str(sent.port.net_id), sent.pd.id) for sent in publishers]
    if isinstance(source, FromSection):
        keys = [(subscription.port, source.publisher, source.id)]
    for key in keys:
        if key in taken:
            line = report.line_of(taken[key])
            message = f"id {key[2]} of {key[1]} is received twice on port {key[0]}"
            expected = "one subscription for each PD on a port"
            report.add(f"{subscription.at}.from", f"{message} (first in line {line})", expected)
        taken.setdefault(key, f"{subscription.at}.from")
