"""What another plant file changes for a router, in words, and what needs a new start."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Any

from eap.ams.spec import AccessRule, AmsUser, MqttSpec, RouteSpec, RoutingSpec

_NEW_START = "this needs a new start of the appliance"


def describe_routing(old: RoutingSpec, new: RoutingSpec) -> list[str]:
    """Return what differs and can change while a station runs, one line each."""
    found = [
        *_differences(_routes(old.routes), _routes(new.routes)),
        *_differences(_rules(old.access), _rules(new.access)),
        *_differences(_users(old.users), _users(new.users)),
    ]
    before, after = _order(old.access), _order(new.access)
    if before != after and sorted(before) == sorted(after):
        found.append("access rules: in another order")
    if old.learn != new.learn:
        found.append(f"routes are learned from {_sources(new.learn)}")
    return found


def routing_needs_new_start(old: RoutingSpec, new: RoutingSpec) -> list[str]:
    """Return what differs and cannot change while a station runs, one line each."""
    lines = list(_differences(_brokers(old.mqtt), _brokers(new.mqtt)))
    if any(
        old.learns_by_mqtt(each.network) != new.learns_by_mqtt(each.network) for each in new.mqtt
    ):
        lines.append("routes by MQTT: learn is another one")
    return [f"{line}: {_NEW_START}" for line in lines]


def _sources(learn: bool | tuple[str, ...]) -> str:
    if isinstance(learn, bool):
        return "anywhere" if learn else "nowhere"
    return ", ".join(learn) or "nowhere"


def _differences(old: dict[str, Any], new: dict[str, Any]) -> Iterator[str]:
    for name in old:
        if name not in new:
            yield f"{name}: removed"
    for name, each in new.items():
        if name not in old:
            yield f"{name}: added"
        elif old[name] != each:
            yield f"{name}: changed"


def _routes(routes: Iterable[RouteSpec]) -> dict[str, list[RouteSpec]]:
    """Return the routes by what they are called; several NetIDs of a station are one."""
    found: dict[str, list[RouteSpec]] = {}
    for route in routes:
        found.setdefault(f"route {route.name}", []).append(route)
    return found


def _rules(rules: Iterable[AccessRule]) -> dict[str, AccessRule]:
    return {f"access rule {rule.name}": rule for rule in rules}


def _order(rules: Iterable[AccessRule]) -> list[str]:
    return [rule.name for rule in rules]


def _users(users: Iterable[AmsUser]) -> dict[str, AmsUser]:
    return {f"user {user.name}": user for user in users}


def _brokers(brokers: Iterable[MqttSpec]) -> dict[str, MqttSpec]:
    return {f"MQTT network {broker.network}": broker for broker in brokers}
