"""Network namespaces with a cable between them, made for one test and gone after it."""

from __future__ import annotations

import ctypes
import itertools
import os
import socket
import subprocess
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

from eap.ids import MacAddr

_NUMBERS = itertools.count()
_CLONE_NEWNET = 0x40000000
_CLONE_NEWNS = 0x20000
_MS_REC, _MS_SLAVE = 0x4000, 0x80000
_MNT_DETACH = 2
_library = ctypes.CDLL(None, use_errno=True)


class Namespace:
    """One namespace; its loopback is up, and its end of a cable is called ``line0``.

    Attributes:
        prefix: Words that run a command inside, as the process that is started.
    """

    def __init__(self, name: str) -> None:
        self.name = name
        self.prefix = ["ip", "netns", "exec", name]

    def ip(self, *words: str) -> None:
        """Run ``ip`` on what is inside."""
        _run("ip", "-netns", self.name, *words)

    def plug(self) -> None:
        """Switch ``line0`` on."""
        self.ip("link", "set", "line0", "up")

    def unplug(self) -> None:
        """Switch ``line0`` off, which takes the carrier from the other end, too."""
        self.ip("link", "set", "line0", "down")

    def socket(self, *kind: int) -> socket.socket:
        """Return a socket of this test that belongs to the namespace."""
        with Path("/proc/self/ns/net").open() as home, Path(f"/run/netns/{self.name}").open() as ns:
            enter_network(ns.fileno())
            try:
                return socket.socket(*kind)
            finally:
                enter_network(home.fileno())

    def mac(self) -> str:
        """Return the address of ``line0``."""
        with self.socket(socket.AF_PACKET, socket.SOCK_RAW) as sock:
            sock.bind(("line0", 0))
            return str(MacAddr(sock.getsockname()[4]))


@contextmanager
def namespace() -> Iterator[Namespace]:
    """Make a namespace and delete it with all that is in it, whatever happens."""
    name = f"eap-test-{os.getpid()}-{next(_NUMBERS)}"
    _run("ip", "netns", "add", name)
    try:
        inside = Namespace(name)
        # Nothing but the test speaks here: no neighbour discovery between the frames.
        path = "/proc/sys/net/ipv6/conf/{}/disable_ipv6"
        for scope in ("default", "all"):
            words = f"echo 1 > {path.format(scope)}"
            subprocess.run([*inside.prefix, "sh", "-c", words], check=False, capture_output=True)
        inside.ip("link", "set", "lo", "up")
        yield inside
    finally:
        _run("ip", "netns", "del", name)


@contextmanager
def cable(*, addresses: bool = False) -> Iterator[tuple[Namespace, Namespace]]:
    """Make two namespaces whose ``line0`` are the ends of one cable.

    With *addresses* they are 10.88.164.1/24 and 10.88.164.2/24.
    """
    with ExitStack() as stack:
        ends = stack.enter_context(namespace()), stack.enter_context(namespace())
        lay_cable(ends, addresses=addresses)
        yield ends


def lay_cable(ends: tuple[Namespace, Namespace], *, addresses: bool = False) -> None:
    """Lay a cable between the ``line0`` of two namespaces, which have none."""
    left, right = (end.name for end in ends)
    _run(
        *("ip", "link", "add", "line0", "netns", left, "type", "veth"),
        *("peer", "name", "line0", "netns", right),
    )
    for number, end in enumerate(ends, 1):
        if addresses:
            end.ip("addr", "add", f"10.88.164.{number}/24", "broadcast", "+", "dev", "line0")
        end.plug()


@contextmanager
def row(count: int) -> Iterator[list[Namespace]]:
    """Make namespaces in a row, with a cable from the ``east0`` of each to ``west0`` of the next.

    The first cable has addresses: 10.88.170.1/24 and 10.88.170.2/24.
    """
    with ExitStack() as stack:
        found = [stack.enter_context(namespace()) for _ in range(count)]
        for left, right in itertools.pairwise(found):
            _run(
                *("ip", "link", "add", "east0", "netns", left.name, "type", "veth"),
                *("peer", "name", "west0", "netns", right.name),
            )
            left.ip("link", "set", "east0", "up")
            right.ip("link", "set", "west0", "up")
        found[0].ip("addr", "add", "10.88.170.1/24", "dev", "east0")
        found[1].ip("addr", "add", "10.88.170.2/24", "dev", "west0")
        yield found


def enter(inside: Namespace) -> None:
    """Take the calling thread into a namespace, for good."""
    with Path(f"/run/netns/{inside.name}").open() as ns:
        enter_network(ns.fileno())


def become_inside(name: str) -> None:
    """Take this process into a namespace as ``ip netns exec`` does, with its view of ``/sys``."""
    with Path(f"/run/netns/{name}").open() as ns:
        enter_network(ns.fileno())
    if _library.unshare(_CLONE_NEWNS):
        raise OSError(ctypes.get_errno(), "unshare")
    for source, target, kind, flags in (
        (b"", b"/", b"none", _MS_SLAVE | _MS_REC),
        (name.encode(), b"/sys", b"sysfs", 0),
    ):
        if target == b"/sys":
            _library.umount2(target, _MNT_DETACH)
        if _library.mount(source, target, kind, ctypes.c_ulong(flags), None):
            raise OSError(ctypes.get_errno(), f"mount {target.decode()}")


def enter_network(descriptor: int) -> None:
    """Take the calling thread into the network that *descriptor* is open on."""
    if _library.setns(descriptor, _CLONE_NEWNET):
        raise OSError(ctypes.get_errno(), "setns")


def _run(*words: str) -> None:
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    assert done.returncode == 0, f"{' '.join(words)}: {done.stderr}"
