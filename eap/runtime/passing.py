"""How services hands a TCP connection to the engine: one message with one descriptor.

The pair of SOCK_SEQPACKET sockets outlives both processes, so a connection passed while the engine
restarts is taken by the next one.  Neither side ever waits for the other.
"""

from __future__ import annotations

import array
import socket

import msgspec

from eap.pd.spec import SpecRecord
from eap.runtime.handover import PortName

_MAX_MESSAGE = 8192
_DESCRIPTOR_SPACE = socket.CMSG_SPACE(array.array("i").itemsize)


class PassedConnection(SpecRecord, frozen=True):
    """A type-4 connection: the ports that its frames are for, and its peer."""

    owners: tuple[PortName, ...]
    host: str
    """Address of the peer, as the policy counts it (eap.net.connections)."""


def pass_connection(
    link: socket.socket, connection: socket.socket, description: PassedConnection
) -> bool:
    """Send *connection*, which the caller then closes; return whether there was room for it."""
    message = msgspec.json.encode(description)
    rights = (socket.SOL_SOCKET, socket.SCM_RIGHTS, array.array("i", [connection.fileno()]))
    try:
        # socket.send_fds() of Python 3.11 forgets its flags, and would wait here.
        link.sendmsg([message], [rights], socket.MSG_DONTWAIT)
    except OSError:
        return False
    return True


def take_connection(link: socket.socket) -> tuple[socket.socket, PassedConnection] | None:
    """Return the next connection that was passed, None if there is none now."""
    flags = socket.MSG_DONTWAIT | socket.MSG_CMSG_CLOEXEC
    try:
        message, ancillary, _, _ = link.recvmsg(_MAX_MESSAGE, _DESCRIPTOR_SPACE, flags)
    except OSError:
        return None
    for level, kind, data in ancillary:
        if level == socket.SOL_SOCKET and kind == socket.SCM_RIGHTS:
            connection = socket.socket(fileno=array.array("i", data)[0])
            return connection, msgspec.json.decode(message, type=PassedConnection)
    return None
