"""Frames of type 5 over TCP: one connection, cut into frames by their Length."""

from __future__ import annotations

import asyncio
import socket
from collections.abc import Callable, Sequence
from time import monotonic_ns

from eap.appliance.discards import Refusal
from eap.appliance.services.aoe_desk import AoeDesk
from eap.appliance.services.mailbox_door import MailboxDoor
from eap.codec.ethercat import EtherCatHeader, FrameType
from eap.codec.mailbox import MailboxHeader

LARGEST_FRAME = EtherCatHeader.SIZE + 0x7FF
"""What the 11 bits of Length allow."""
SLOW_READER_S = 10.0
"""A client that takes nothing for this long while answers wait for it is disconnected."""


async def serve_stream(
    connection: socket.socket, desks: Sequence[AoeDesk], refuse: Callable[[Refusal], None]
) -> None:
    """Answer what comes by *connection* until its end, and close it.

    Args:
        connection: Its first frame may have been looked at, not taken.
        desks: Of the stations behind the listener.
        refuse: Counts a frame that is not taken.
    """
    reader, writer = await asyncio.open_connection(sock=connection)
    try:
        await _answer(reader, writer, desks, refuse)
        async with asyncio.timeout(SLOW_READER_S):
            for desk in desks:
                await desk.wait_idle()  # who has only closed its sending side still listens
            writer.close()
            await writer.wait_closed()
    except (OSError, TimeoutError):
        pass
    finally:
        writer.transport.abort()


async def _answer(
    reader: asyncio.StreamReader,
    writer: asyncio.StreamWriter,
    desks: Sequence[AoeDesk],
    refuse: Callable[[Refusal], None],
) -> None:
    """Take frames until the end, or until what comes is none."""
    door = MailboxDoor(desks, LARGEST_FRAME)

    def send(frame: bytes) -> None:
        if not writer.is_closing():
            writer.write(frame)

    while True:
        try:
            head = await reader.readexactly(EtherCatHeader.SIZE)
            header = EtherCatHeader.decode(head)
            if header.type != FrameType.MAILBOX or header.length < MailboxHeader.SIZE:
                refuse(Refusal.TCP_TYPE)
                return
            frame = head + await reader.readexactly(header.length)
        except asyncio.IncompleteReadError:
            return
        reason = door.receive_frame(frame, send, monotonic_ns())
        if reason is not None:
            refuse(reason)
        async with asyncio.timeout(SLOW_READER_S):
            await writer.drain()
