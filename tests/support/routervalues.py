"""Values of a router's dictionary, without a router."""

from __future__ import annotations

from eap.od.profiles.router9000 import RouterLive

MAC = bytes.fromhex("020000000005")
STATES = {"eap0": 8, "eap1": 4, "bus0": 2}


class Values:
    """A router that counts from 1 on, by key; routes are dicts of what they show."""

    def __init__(self) -> None:
        self.all: list[dict[RouterLive, object]] = []

    def number(self, key):
        return list(RouterLive).index(key)

    def state_of(self, port):
        return STATES[port]

    def mac_of(self, port):
        return MAC if port == "eap1" else bytes(6)

    def routes(self):
        return self.all

    def of_route(self, key, route):
        return route[key]
