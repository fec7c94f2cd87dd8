"""Who holds a port: the search through /proc that turns "address in use" into advice."""

from __future__ import annotations

import socket
import struct
from dataclasses import dataclass
from pathlib import Path

_PROC = Path("/proc")
_SHOWN = 80
"""Characters of a command in a message."""
_OWN_COMMANDS = ("eapctl", "-m eap")


@dataclass(frozen=True, slots=True)
class Holder:
    """A socket that stands in the way, and its process where that is visible."""

    local: str
    remote: str
    """Address it is connected to, empty if it is not."""
    pid: int = 0
    command: str = ""

    def __str__(self) -> str:
        if not self.pid:
            return "an unknown process"
        short = " ".join(word.rpartition("/")[2] or word for word in self.command.split())
        return f"process {self.pid} ({short[:_SHOWN]})"


def find_holders(protocol: str, address: str, port: int, *, proc: Path = _PROC) -> list[Holder]:
    """Return the sockets of *protocol* (``UDP`` or ``TCP``) that keep *address* from being bound.

    Raises nothing: what this user may not see is left out.
    """
    holders = []
    for name in (protocol.lower(), protocol.lower() + "6"):
        try:
            lines = (proc / "net" / name).read_text().splitlines()[1:]
        except OSError:
            continue
        for line in lines:
            fields = line.split()
            local, local_port = _parse(fields[1])
            wild = "0.0.0.0"  # noqa: S104  a comparison
            if local_port != port or (local != address and wild not in {local, address}):
                continue
            remote, remote_port = _parse(fields[2])
            pid, command = _find_process(fields[9], proc)
            peer = f"{remote}:{remote_port}" if remote_port else ""
            holders.append(Holder(f"{local}:{local_port}", peer, pid, command))
    return holders


def describe_holder(protocol: str, address: str, port: int, *, proc: Path = _PROC) -> str:
    """Return one line for a person: who has the port, and what to do."""
    start = f"{protocol} {address}:{port} is in use"
    holders = find_holders(protocol, address, port, proc=proc)
    if not holders:
        return f"{start} by an unknown process: `ss -lnp` as root shows it"
    holder = min(holders, key=lambda found: bool(found.remote))  # a server before its clients
    text = f"{start} by {holder}"
    if any(own in holder.command for own in _OWN_COMMANDS):
        return f"{text}: stop that appliance or give this one another address"
    if not _is_ephemeral(port, proc):
        return f"{text}: stop it or choose another address"
    what = f", a client connected to {holder.remote}" if holder.remote else ""
    return (
        f"{text}{what}; clients get any port of {_range(proc)[0]} to {_range(proc)[1]}: end it, "
        f"and keep the port free with `sysctl -w net.ipv4.ip_local_reserved_ports={port}`"
    )


def _parse(text: str) -> tuple[str, int]:
    """Read ``0100007F:88A4``, or the 32 digits of IPv6 if they stand for an IPv4 address."""
    digits, _, port = text.partition(":")
    words = [int(digits[n : n + 8], 16) for n in range(0, len(digits), 8)]
    if len(words) == 4 and any(words[:2]):
        return digits, int(port, 16)
    return socket.inet_ntoa(struct.pack("@I", words[-1])), int(port, 16)


def _find_process(inode: str, proc: Path) -> tuple[int, str]:
    wanted = f"socket:[{inode}]"
    for process in proc.iterdir():
        if not process.name.isdigit():
            continue
        try:
            if any(str(link.readlink()) == wanted for link in (process / "fd").iterdir()):
                command = (process / "cmdline").read_bytes().decode(errors="replace")
                return int(process.name), command.replace("\0", " ").strip()
        except OSError:
            continue
    return 0, ""


def _range(proc: Path) -> tuple[int, int]:
    low, high = (proc / "sys/net/ipv4/ip_local_port_range").read_text().split()
    return int(low), int(high)


def _is_ephemeral(port: int, proc: Path) -> bool:
    """Whether the kernel may give *port* to any client that asks for none in particular."""
    try:
        low, high = _range(proc)
        reserved = (proc / "sys/net/ipv4/ip_local_reserved_ports").read_text().strip()
    except OSError:
        return False
    if not low <= port <= high:
        return False
    spans = [part.partition("-") for part in reserved.split(",") if part]
    return not any(int(first) <= port <= int(last or first) for first, _, last in spans)
