"""What came of a question to another station, in words: where it got stuck, and what to do."""

from __future__ import annotations

from typing import NamedTuple

from eap.ams.report import Obstacle, RouteReport, RouteState
from eap.ams.spec import TransportKind
from eap.codec.ads import AdsError
from eap.ids import NetId

_ALIVE = frozenset({AdsError.TARGET_PORT})
"""Errors of the AMS header that only who has the NetID answers with."""
_UNREACHED: dict[str, str] = {
    TransportKind.AMS_TCP: (
        "see whether it is switched on, and listens on that TCP port (a firewall?)"
    ),
    TransportKind.UDP: "see whether it is switched on, in the same network, and its station runs",
    TransportKind.TCP: "see whether its station runs, and takes connections on that port",
    TransportKind.ETHERNET: "see to the cable and the MAC address, and whether its station runs",
    TransportKind.MQTT: (
        "see whether both stations are connected to the broker, under the same network"
    ),
}
"""What to do about a hop that is down, by the kind of the door."""
_CLIENT = "nothing is wrong if it only asks; to be asked, it has to listen there"


class Advice(NamedTuple):
    """What to tell people."""

    is_reached: bool
    text: str
    hint: str = ""


def advise(
    error: int, target: NetId, route: RouteReport | None, own: NetId, *, is_own: bool
) -> Advice:
    """Say what the *error* of an AMS header means.

    Args:
        error: 0 for none.
        target: Who was asked.
        route: That was taken; None for none.
        own: NetID of the router that asked.
        is_own: Whether *target* is of its station.
    """
    if not error:
        return Advice(is_reached=True, text="answers")
    words = AdsError.words_of(error)
    if error in _ALIVE:
        return Advice(is_reached=True, text=f"is there; {words}")
    if is_own:
        return Advice(is_reached=False, text=f"this station itself answers: {words}")
    if route is None:
        return Advice(
            is_reached=False,
            text=f"there is no route to {target}",
            hint="add one: 'eapctl routes add', or under routes in the plant file",
        )
    return _behind(error, words, target, route, own)


def _behind(error: int, words: str, target: NetId, report: RouteReport, own: NetId) -> Advice:
    """Say what is wrong with a route, or behind it."""
    hop = report.route.hop
    where = f"{report.next_name} ({hop})"
    if report.state in {RouteState.DOWN, RouteState.CLIENT}:
        hint = _CLIENT if report.state is RouteState.CLIENT else _UNREACHED.get(hop.kind, "")
        obstacle = Obstacle(report.state, report.why)
        return Advice(is_reached=False, text=f"{where} {obstacle}", hint=hint)
    if error == AdsError.TIMEOUT:
        hint = (
            f"it may be overloaded, or answer only whom it has a route to, as TwinCAT does: there,"
            f" add one to {own} at the address of this host"
        )
        return Advice(is_reached=False, text=f"no answer from {where} in time", hint=hint)
    if error == AdsError.TARGET_MACHINE:
        hint = f"the router there needs a route to {target}, or it is not the NetID that is meant"
        return Advice(is_reached=False, text=f"{where} knows no way to {target}", hint=hint)
    if error == AdsError.HOST_UNREACHABLE:
        hint = "'eapctl trace' names the hop"
        return Advice(is_reached=False, text=f"the way is cut behind {where}", hint=hint)
    if error == AdsError.ACCESS_DENIED:
        hint = "allow it under access in the plant file, of this station or of one on the way"
        return Advice(is_reached=False, text="access rules forbid to ask for its state", hint=hint)
    return Advice(is_reached=False, text=f"{where} or somebody behind it answers: {words}")
