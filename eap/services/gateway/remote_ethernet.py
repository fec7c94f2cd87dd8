"""Ethernet frames of slaves of other stations, for the clients of one gateway.

The frames wait at the other station, from where one reader for each virtual address fetches them as
long as a client talks EoE to that address.  It asks often while frames come, and seldom otherwise.
"""

from __future__ import annotations

import asyncio
import secrets
from collections.abc import Callable
from contextlib import suppress
from time import monotonic_ns

from devicebus.mailbox.eoe import iter_fragments
from eap.codec.eoe import EoeHeader, FragmentWord
from eap.errors import CodecError
from eap.ids import Endpoint
from eap.services.gateway.message_codecs import EoeListener, EoeListeners
from eap.services.slaves.access import RemoteAccessError
from eap.services.slaves.remote_slave import RemoteSlave
from eap.services.tasks import TaskSet

FIRST_PAUSE_S = 0.01
"""Pause between two requests while frames come."""
LONGEST_PAUSE_S = 0.2
"""Pause while none come; it doubles up to this."""
FAILURE_PAUSE_S = 1.0
"""Pause after a request that failed."""


class RemoteEthernet:
    """Readers of one gateway.

    Args:
        name: Of the gateway, for the log.
        data_size: Bytes behind the mailbox header of the longest message to a client.
        deliver: Sends a fragment to a client.
    """

    def __init__(
        self, name: str, data_size: int, deliver: Callable[[EoeListener, bytes], None]
    ) -> None:
        self._fragment_size = data_size - EoeHeader.SIZE - FragmentWord.SIZE
        self._deliver = deliver
        self._listeners = EoeListeners()
        self._wakes: dict[int, asyncio.Event] = {}
        self._tasks = TaskSet(f"EoE of gateway {name}")

    def add(
        self,
        address: int,
        slave: RemoteSlave,
        endpoint: Endpoint,
        send: Callable[[bytes], None],
    ) -> None:
        """Note that a client talks EoE to the slave at a virtual address."""
        self._listeners.add(address, endpoint, address, send, monotonic_ns())
        wake = self._wakes.get(address)
        if wake is None:
            wake = self._wakes[address] = asyncio.Event()
            self._tasks.start(self._fetch(address, slave, wake))
        wake.set()

    def forget(self, endpoint: Endpoint) -> None:
        """Forget a client whose connection is closed."""
        self._listeners.forget(endpoint)

    def forget_slaves(self) -> None:
        """End all readers: the virtual addresses are other ones.

        A client that goes on to talk EoE gets a reader for the slave that is there now.
        """
        self._tasks.cancel()
        self._listeners = EoeListeners()

    async def close(self) -> None:
        """End all readers."""
        await self._tasks.close()

    async def _fetch(self, address: int, slave: RemoteSlave, wake: asyncio.Event) -> None:
        """Fetch frames as long as there are clients."""
        # A number of its own: several gateways of one station have one NetID there.
        reader, number, pause_s = secrets.randbits(32), 0, FIRST_PAUSE_S
        try:
            while listeners := self._listeners.of_slave(address, monotonic_ns()):
                try:
                    frames = await slave.read_frames(reader)
                except RemoteAccessError:
                    frames, pause_s = [], FAILURE_PAUSE_S
                else:
                    pause_s = FIRST_PAUSE_S if frames else min(2 * pause_s, LONGEST_PAUSE_S)
                for frame in frames:
                    number = (number + 1) % 16
                    self._send(frame, number, listeners)
                with suppress(TimeoutError):
                    await asyncio.wait_for(wake.wait(), pause_s)
                    # A client has sent something: the answer comes soon.
                    await asyncio.sleep(FIRST_PAUSE_S)
                    pause_s = FIRST_PAUSE_S
                wake.clear()
        finally:
            del self._wakes[address]

    def _send(self, frame: bytes, number: int, listeners: list[EoeListener]) -> None:
        with suppress(CodecError):  # longer than Ethernet has it
            for fragment in iter_fragments(frame, number, self._fragment_size):
                for listener in listeners:
                    self._deliver(listener, fragment)
