"""How the connections of one listener are shared out: no foreign host keeps the others out."""

from __future__ import annotations

from ipaddress import IPv4Address

MAX_CONNECTIONS = 128
"""Of one listener."""
MAX_FOREIGN = 96
"""Of these, from all other hosts: programs of this one always find room."""
MAX_OF_HOST = 32
"""Of these, from one other host."""


class Shares:
    """The connections that there are, by the hosts that they came from."""

    def __init__(self) -> None:
        self._by_host: dict[str, int] = {}
        self._total = 0
        self._foreign = 0

    def take(self, host: str, own: str) -> str | None:
        """Take a place for *host*, which has reached *own*; return why there is none."""
        if self._total >= MAX_CONNECTIONS:
            return f"there are {MAX_CONNECTIONS} already"
        if not is_this_host(host, own):
            if self._by_host.get(host, 0) >= MAX_OF_HOST:
                return f"{host} has {MAX_OF_HOST} already"
            if self._foreign >= MAX_FOREIGN:
                return f"other hosts have {MAX_FOREIGN} already"
            self._foreign += 1
            self._by_host[host] = self._by_host.get(host, 0) + 1
        self._total += 1
        return None

    def give_back(self, host: str) -> None:
        """Let others have a place that *host* had."""
        self._total -= 1
        if host in self._by_host:
            self._foreign -= 1
            self._by_host[host] -= 1
            if not self._by_host[host]:
                del self._by_host[host]


def is_this_host(peer: str, own: str) -> bool:
    """Tell whether *peer*, that reached *own*, is this machine: who is has its address."""
    return peer == own or IPv4Address(peer).is_loopback
