"""A minimal AMS/TCP server for ADS devices, in a thread: no router, no routes, no limits.

Octets are put together by ``struct`` from the public layout: 2 reserved octets, a length, an AMS
header of 32 octets.  Notifications are sampled every 5 ms.
"""

from __future__ import annotations

import selectors
import socket
import struct
import threading
import time
from collections.abc import Mapping
from typing import Self

from eap.ads.device import AdsDevice
from eap.ads.notifications import AdsClient
from eap.codec.adsnotification import to_filetime
from eap.ids import Endpoint, NetId

PORT = 48898
_PREFIX = struct.Struct("<HI")
_HEADER = struct.Struct("<6sH6sHHHIII")
_CYCLE_S = 0.005


class AmsTcpServer:
    """Serves devices by NetID and port on *address* while the ``with`` block runs.

    Attributes:
        lock: Held while devices work; tests hold it to change what they work on.
        connections: How many came so far.
    """

    def __init__(self, address: str, devices: Mapping[tuple[bytes, int], AdsDevice]) -> None:
        self.lock = threading.Lock()
        self.connections = 0
        self._devices = devices
        self._listener = socket.create_server((address, PORT))
        self._listener.setblocking(False)
        self._buffers: dict[socket.socket, bytearray] = {}
        self._numbers: dict[int, socket.socket] = {}
        self._selector = selectors.DefaultSelector()
        self._selector.register(self._listener, selectors.EVENT_READ)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join()
        self._selector.close()
        for connection in [*self._buffers, self._listener]:
            connection.close()

    def _run(self) -> None:
        due = time.monotonic()
        while not self._stop.is_set():
            for key, _ in self._selector.select(max(0.0, due - time.monotonic())):
                if key.fileobj is self._listener:
                    self._accept()
                else:
                    self._receive(key.fileobj, key.data)
            if time.monotonic() >= due:
                due = time.monotonic() + _CYCLE_S
                self._cycle()

    def _accept(self) -> None:
        connection, _ = self._listener.accept()
        self.connections += 1
        self._buffers[connection] = bytearray()
        self._numbers[self.connections] = connection
        self._selector.register(connection, selectors.EVENT_READ, self.connections)

    def _receive(self, connection: socket.socket, number: int) -> None:
        try:
            octets = connection.recv(1 << 16)
        except OSError:
            octets = b""
        buffer = self._buffers[connection]
        buffer += octets
        if not octets:
            self._close(connection, number)
        while len(buffer) >= _PREFIX.size:
            _, length = _PREFIX.unpack_from(buffer)
            if len(buffer) < _PREFIX.size + length:
                break
            self._answer(connection, number, bytes(buffer[_PREFIX.size : _PREFIX.size + length]))
            del buffer[: _PREFIX.size + length]

    def _close(self, connection: socket.socket, number: int) -> None:
        self._selector.unregister(connection)
        connection.close()
        del self._buffers[connection], self._numbers[number]
        with self.lock:
            for device in self._devices.values():
                device.notifications.forget(Endpoint("tcp", str(number)))

    def _answer(self, connection: socket.socket, number: int, packet: bytes) -> None:
        target, port, source, source_port, command, flags, *_, invoke_id = _HEADER.unpack_from(
            packet
        )
        device = self._devices.get((target, port))
        error, body = 7, b""
        if device is not None:
            with self.lock:
                client = AdsClient(Endpoint("tcp", str(number)), NetId(source), source_port)
                answer = device.answer(command, packet[_HEADER.size :], client, time.monotonic_ns())
            error, body = answer.error_code, answer.data
        header = _HEADER.pack(
            source, source_port, target, port, command, flags | 1, len(body), error, invoke_id
        )
        self._send(connection, header + body)

    def _cycle(self) -> None:
        for (target, port), device in self._devices.items():
            with self.lock:
                notices = device.notifications.handle_cycle(
                    time.monotonic_ns(), to_filetime(time.time_ns())
                )
            for notice in notices:
                if connection := self._numbers.get(int(notice.client.endpoint.connection)):
                    self._send(connection, notice.encode(NetId(target), port))

    def _send(self, connection: socket.socket, packet: bytes) -> None:
        connection.sendall(_PREFIX.pack(0, len(packet)) + packet)
