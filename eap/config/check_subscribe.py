"""Checks of what stations receive: a publisher for everybody, and both ends alike."""

from __future__ import annotations

from eap.codec import datatypes
from eap.config.check_ports import check_names
from eap.config.check_publish import check_port_reference
from eap.config.destination import reaches, resolve
from eap.config.finding import FindingReport, one_of
from eap.config.index import Index, SentPd
from eap.config.structs import ANY_SOURCE, FromSection, StationSection, SubscribeSection
from eap.ids import NetId
from eap.pd import rules
from eap.pd.address import is_group_source, source_octets
from eap.pd.spec import REQUESTER
from eap.suggest import suggest


def check_subscribe(index: Index, report: FindingReport) -> None:
    """Report every RxPD that would receive nothing, or something else than it expects."""
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
                _check_ends(index, report, subscription, sent)
            _check_arrival(index, report, station, subscription)
            _check_timeout(index, report, station, subscription)
            _check_once(subscription, publishers, taken, report)


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
            message = f"nobody in this plant publishes {source!r}{suggest(source, known)}"
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
    if source.publisher != "any":
        try:
            NetId.parse(source.publisher)
        except ValueError as exc:
            report.add(f"{path}.publisher", str(exc), "a NetID or any")
            return
    if not subscription.foreign:
        message = f"nobody in this plant publishes id {source.id} as {source.publisher}"
        report.add(path, message, "a publisher of this plant, or foreign: true")


def _check_variables(subscription: SubscribeSection, report: FindingReport) -> None:
    path, name = f"{subscription.at}.variables", subscription.name
    if subscription.variables is None:
        if isinstance(subscription.source, FromSection):
            report.add(subscription.at, f"subscription {name!r} has no variables", "its variables")
    elif not subscription.variables and not report.broken:
        report.add(path, f"subscription {name!r} has no variables", "at least one")


def _check_ends(
    index: Index, report: FindingReport, subscription: SubscribeSection, sent: SentPd
) -> None:
    """Report where *subscription* differs from the PD *sent*, naming both lines."""
    at, label = subscription.at, sent.label
    if not subscription.ignore_version and subscription.version not in (None, sent.pd.version):
        line = report.line_of(f"{sent.pd.at}.version")
        message = f"version {subscription.version} of {subscription.name!r}, but {label} has "
        message += f"{sent.pd.version} (line {line})"
        report.add(f"{at}.version", message, f"{sent.pd.version}, or ignore_version: true")
    theirs = index.types(sent)
    if not subscription.variables or theirs is None:
        return
    line = report.line_of(f"{sent.pd.at}.variables")
    if len(subscription.variables) != len(theirs):
        message = f"{subscription.name!r} has {len(subscription.variables)} variables, but {label} "
        message += f"has {len(theirs)} (line {line})"
        if not report.broken:
            report.add(f"{at}.variables", message, ", ".join(kind.text for kind in theirs))
        return
    pairs = zip(subscription.variables.items(), sent.pd.variables, theirs, strict=True)
    for (name, variable), their_name, kind in pairs:
        try:
            ours = datatypes.parse(variable.type)
        except ValueError:
            continue  # reported with the variable
        if ours != kind:
            message = f"{name} is {ours.text}, but {label} sends {their_name} as {kind.text} "
            report.add(f"{at}.variables.{name}", f"{message}(line {line})", kind.text)


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
            destination = resolve(sent.frame.to, sender_uri, index)
        except ValueError:
            return  # reported with the frame
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


def _check_once(
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
