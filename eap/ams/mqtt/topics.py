"""Topics of AMS over MQTT: which router a message is from, or for (Beckhoff ADS-over-MQTT).

All routers of a network have topics that begin with its name and their NetID: ``…/info`` tells of
them, requests come by ``…/ams``, answers and notifications by ``…/ams/res``.
"""

from __future__ import annotations

from enum import Enum

from eap.ids import NetId

MAX_NETWORK = 128
"""Characters of the name of a network."""


class TopicKind(Enum):
    """What a topic is for; the value is what follows the NetID."""

    INFO = "info"
    REQUESTS = "ams"
    ANSWERS = "ams/res"


class Topics:
    """Topics of one router in a network.

    Raises:
        ValueError: no network can have that name.

    Attributes:
        info: Where it tells of itself.
        filters: What it subscribes to.
    """

    def __init__(self, network: str, net_id: NetId) -> None:
        check_network(network)
        self._start = f"{network}/"
        self.info = self.of(str(net_id), TopicKind.INFO)
        self.all_info = self.of("+", TopicKind.INFO)
        self.filters = (f"{self._start}{net_id}/ams/#", self.all_info)

    def of(self, address: str, kind: TopicKind) -> str:
        """Return the topic of the router with the NetID *address*."""
        return f"{self._start}{address}/{kind.value}"

    def parse(self, topic: str) -> tuple[NetId, TopicKind] | None:
        """Return whose topic it is and what for; None for one that means nothing here."""
        if not topic.startswith(self._start):
            return None
        address, _, rest = topic[len(self._start) :].partition("/")
        kind = _KINDS.get(rest)
        try:
            net_id = NetId.parse(address)
        except ValueError:
            return None
        # Not 05.1.1.1.1.1: nobody has two topics for one thing.
        return (net_id, kind) if kind is not None and str(net_id) == address else None


def check_network(name: str) -> None:
    """Raise ValueError, and say why, if no network can have that name."""
    if not name or len(name) > MAX_NETWORK:
        raise ValueError(f"{name[:40]!r} is no name of a network: 1 to {MAX_NETWORK} characters")
    if not name.isprintable() or set(name) & set("+#"):
        raise ValueError(f"{name!r} is no name of a network: no '+', '#' or control characters")
    if name.startswith(("$", "/")) or name.endswith("/"):
        raise ValueError(f"{name!r} is no name of a network: no '$' or '/' in front, no '/' behind")


_KINDS = {kind.value: kind for kind in TopicKind}
