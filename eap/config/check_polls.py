"""Checks of polled exchange: a request for every answer, a way back, no chains and no loops.

A request is a PD that is sent by itself, an answer one that is sent for a request only.  An answer
that is a request again would make the traffic of one station depend on that of two others.
"""

from __future__ import annotations

from eap.config.finding import Report, one_of
from eap.config.index import Index, SentPd
from eap.config.structs import Frame, Publish, Station, Subscribe
from eap.near import near
from eap.pd import rules

_PUSHED = "a request that is sent by itself"
_ONE_PORT = "one port for both: an answer goes back as its request came"


def check_polls(index: Index, report: Report) -> None:
    """Report every request and answer that do not find each other."""
    for station in index.plant.stations:
        for frame in station.frames:
            _check_frame(report, station, frame)
        for pd in station.publish:
            if pd.poll:
                report.add_breaches(pd.at, rules.check_polled(pd.spec()))
                _check_answer(index, report, station, pd)
        for subscription in station.subscribe:
            if subscription.poll:
                _check_question(index, report, station, subscription)
            else:
                _check_unasked(index, report, subscription)


def _check_frame(report: Report, station: Station, frame: Frame) -> None:
    spec, line = frame.spec(frame.to), report.line_of(f"{frame.at}.to")
    report.add_breaches(frame.at, rules.check_answers(spec))
    for pd in station.publish:
        if pd.frame == frame.name:
            report.add_breaches(pd.at, rules.check_frame_of(pd.spec(), spec, f"line {line}"))


def _check_answer(index: Index, report: Report, station: Station, pd: Publish) -> None:
    path = f"{pd.at}.poll"
    request = index.subscription(station, pd.poll)
    if request is None:
        if pd.poll not in report.broken:
            known = [each.name for each in station.subscribe]
            message = f"station {station.name} has no subscription {pd.poll!r}"
            report.add(path, message + near(pd.poll, known), one_of(known))
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
    index: Index, report: Report, station: Station, subscription: Subscribe
) -> None:
    path, name = f"{subscription.at}.poll", subscription.poll
    own = index.sent.get((station.name, name))
    if own is None:
        known = [pd.name for pd in station.publish]
        if name not in report.broken and name not in known:  # else its frame or port was reported
            message = f"station {station.name} publishes no {name!r}{near(name, known)}"
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
    index: Index, report: Report, subscription: Subscribe, sent: SentPd, own: SentPd
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


def _check_unasked(index: Index, report: Report, subscription: Subscribe) -> None:
    for sent in index.publishers(subscription):
        if sent.pd.poll:
            line = report.line_of(f"{sent.pd.at}.poll")
            message = f"{sent.label} is sent only to who asks for it (line {line})"
            report.add(f"{subscription.at}.from", message, "poll: the PD of this station that asks")
