"""Descriptors that are passed between running processes, each message with its own (SCM_RIGHTS).

The supervisor opens sockets while the appliance runs, as services requests them, and answers with
their descriptors.  Services passes its TCP connections with process data, and the sockets of the
engine, on to the engine.  The SOCK_SEQPACKET pairs outlive all three, so the next process reads the
messages that were sent while it restarted.  No side ever waits for another.
"""

from __future__ import annotations

import array
import os
import socket
from collections.abc import Mapping, Sequence
from typing import TypeAlias, TypeVar

import msgspec
from msgspec.structs import replace

from eap.pd.spec import SpecRecord
from eap.runtime.handover import BusSocket, PortName, SharedSocket

_MAX_MESSAGE = 8192
_MAX_DESCRIPTORS = 16
"""Descriptors of one message: a socket has two, a bus six."""
_DESCRIPTOR_SPACE = socket.CMSG_SPACE(_MAX_DESCRIPTORS * array.array("i").itemsize)
# CLOEXEC at once: a process that is started in between must not inherit them.
_RECEIVE_FLAGS = socket.MSG_DONTWAIT | socket.MSG_CMSG_CLOEXEC

MessageT = TypeVar("MessageT")


class PassedConnection(SpecRecord, frozen=True, tag="connection", tag_field="pass"):
    """A type-4 connection: the ports that its frames are for, and its peer."""

    owners: tuple[PortName, ...]
    host: str
    """Address of the peer, as the policy counts it (eap.net.limits)."""


class PassedSocket(SpecRecord, frozen=True, tag="socket", tag_field="pass"):
    """The engine's socket of a pair; an engine that has it closes the other descriptor."""

    socket: SharedSocket


class PassedLine(SpecRecord, frozen=True, tag="line", tag_field="pass"):
    """The engine's socket of a line of a bus; an engine that has it closes the other descriptor."""

    bus: BusSocket
    is_second: bool = False


PassedDescriptor: TypeAlias = PassedConnection | PassedSocket | PassedLine
"""Message of services to the engine, with one descriptor."""


class OpenSocket(SpecRecord, frozen=True, tag="open", tag_field="do"):
    """Open a shared socket, or pass the descriptors of an open one again.

    The reply has those of ``engine_fd`` and ``services_fd``, as far as the socket has both.
    """

    id: int
    """Chosen by the requester and repeated in the reply."""
    socket: SharedSocket


class CloseSocket(SpecRecord, frozen=True, tag="close", tag_field="do"):
    """Close a shared socket, which no port uses any more; not answered."""

    socket: SharedSocket


class OpenBus(SpecRecord, frozen=True, tag="open-bus", tag_field="do"):
    """Open the lines of a bus, and start its simulated slaves, or pass those of an open one again.

    The reply has the number of the bus, and its descriptors for engine and services.  It comes
    when the simulated slaves are ready.
    """

    id: int
    """As in OpenSocket."""
    bus: BusSocket


class KeepBuses(SpecRecord, frozen=True, tag="keep-buses", tag_field="do"):
    """Close the lines of all buses of a station but these; not answered."""

    station: str
    buses: tuple[BusSocket, ...]


SupervisorRequest: TypeAlias = OpenSocket | CloseSocket | OpenBus | KeepBuses
"""Message of services to the supervisor."""


class SupervisorReply(SpecRecord, frozen=True):
    """Reply of the supervisor: *error*, or the names of the descriptors that come with it."""

    id: int
    error: str = ""
    names: tuple[str, ...] = ()
    number: int = 0
    """Number of a bus."""


def pass_descriptors(
    link: socket.socket, message: msgspec.Struct, descriptors: Sequence[int]
) -> bool:
    """Send *message* with *descriptors*, which stay open; return whether there was room for it."""
    rights = (socket.SOL_SOCKET, socket.SCM_RIGHTS, array.array("i", descriptors))
    try:
        # socket.send_fds() of Python 3.11 forgets its flags, and would wait here.
        link.sendmsg(
            [msgspec.json.encode(message)], [rights] if descriptors else [], socket.MSG_DONTWAIT
        )
    except OSError:
        return False
    return True


def receive_descriptors(link: socket.socket) -> tuple[bytes, list[int]] | None:
    """Return the next message with its descriptors, None if there is none now.

    The message is empty when the other end is closed.
    """
    try:
        message, ancillary, _, _ = link.recvmsg(_MAX_MESSAGE, _DESCRIPTOR_SPACE, _RECEIVE_FLAGS)
    except OSError:
        return None
    descriptors = array.array("i")
    for level, kind, data in ancillary:
        if (level, kind) == (socket.SOL_SOCKET, socket.SCM_RIGHTS):
            descriptors.frombytes(data)
    return message, descriptors.tolist()


def pass_connection(
    link: socket.socket, connection: socket.socket, description: PassedConnection
) -> bool:
    """Send *connection*, which the caller then closes; return whether there was room for it."""
    return pass_descriptors(link, description, [connection.fileno()])


def pass_socket(link: socket.socket, shared: SharedSocket, sock: socket.socket) -> bool:
    """Send the engine's socket of a pair; return whether there was room for it."""
    return pass_descriptors(link, PassedSocket(shared.key), [sock.fileno()])


def pass_bus(link: socket.socket, bus: BusSocket, lines: Sequence[int]) -> bool:
    """Send the sockets of one or two lines of *bus*; return whether there was room for them."""
    numbered = replace(bus.key, number=bus.number)
    return all(
        pass_descriptors(link, PassedLine(numbered, is_second=bool(index)), [fd])
        for index, fd in enumerate(lines)
    )


def receive_passed(link: socket.socket) -> tuple[socket.socket, PassedDescriptor] | None:
    """Return the next connection or socket that was passed, None if there is none now."""
    received = receive_descriptors(link)
    if received is None:
        return None
    message, descriptors = received
    if not descriptors:
        return None
    return socket.socket(fileno=descriptors[0]), _decoder.decode(message)


_decoder = msgspec.json.Decoder(PassedDescriptor)


class SupervisorRequests:
    """The supervisor's end of its pair with services.

    Args:
        sock: Closed by its owner.
    """

    def __init__(self, sock: socket.socket) -> None:
        self._socket = sock
        self._decoder = msgspec.json.Decoder(SupervisorRequest)

    def fileno(self) -> int:
        """Return the descriptor that becomes readable when there is a request."""
        return self._socket.fileno()

    def receive(self) -> SupervisorRequest | None:
        """Return the next request, None if there is none now."""
        received = receive_descriptors(self._socket)
        return None if received is None or not received[0] else self._decoder.decode(received[0])

    def reply(self, number: int, descriptors: Mapping[str, int], bus: int = 0) -> None:
        """Answer request *number* with the named descriptors, and the number of a *bus*."""
        # A process that reads no replies reports the time-out of its request.
        message = SupervisorReply(number, names=tuple(descriptors), number=bus)
        pass_descriptors(self._socket, message, [*descriptors.values()])

    def refuse(self, number: int, error: str) -> None:
        """Answer request *number* with the reason why it failed."""
        pass_descriptors(self._socket, SupervisorReply(number, error), [])


def receive_reply(link: socket.socket) -> tuple[SupervisorReply, dict[str, int]] | None:
    """Return the next reply of the supervisor and its descriptors, None if there is none now."""
    received = receive_descriptors(link)
    if received is None or not received[0]:
        return None
    reply = msgspec.json.decode(received[0], type=SupervisorReply)
    return reply, dict(zip(reply.names, received[1], strict=True))


def close_descriptors(descriptors: Mapping[str, int]) -> None:
    """Close descriptors that were received."""
    for fd in descriptors.values():
        os.close(fd)
