"""A mailbox gateway in a thread: one slave and a master, without a bus."""

from __future__ import annotations

import socket
import threading
from typing import Self

from devicebus.mailbox.coe_server import CoeServer
from devicebus.mailbox.foe_server import FoeServer, MemoryFile, MemoryStore
from devicebus.mailbox.protocol import MailboxSizes
from devicebus.mailbox.server import MailboxServer
from devicebus.mailbox.soe_server import SoeParameter, SoeServer
from devicebus.mailbox.voe import VoeServer
from eap.codec.ethercat import EtherCatHeader, FrameType
from eap.codec.mailbox import (
    MailboxError,
    MailboxErrorReply,
    MailboxHeader,
    MailboxType,
    decode_message,
    encode_message,
)
from eap.codec.soe import SoeAttribute
from eap.device.eap_dictionary import DeviceIdentity
from eap.device.live_dictionaries import MasterDictionary
from eap.gateway.error_table import Cause
from eap.gateway.requests import error_reply
from eap.od.dictionary import ObjectDictionary
from eap.od.model import RW, OdState, variable
from eap.od.profiles.master1100 import MasterLive

SIZES = MailboxSizes(140, 132)
FILE = bytes(range(256)) * 4


class _OneSlave:
    """Values of a master with one slave, 1001."""

    def __init__(self, sizes: MailboxSizes) -> None:
        self._sizes = sizes

    def configured(self) -> list[int]:
        return [1001]

    detected = configured

    def of_configured(self, station: int, key: MasterLive) -> int | str:
        texts = {MasterLive.NAME: "drive", MasterLive.TYPE: "D1"}
        sizes = {
            MasterLive.MAILBOX_OUT: self._sizes.to_slave,
            MasterLive.MAILBOX_IN: self._sizes.to_master,
        }
        numbers = {MasterLive.ADDRESS: 1001, MasterLive.VENDOR: 5, MasterLive.PROTOCOLS: 0x0C}
        return {**numbers, **sizes, **texts}.get(key, 0)

    of_detected = of_configured

    def of_diagnosis(self, station: int, key: MasterLive) -> int:
        return 8 if key is MasterLive.AL_STATUS else 0

    def of_master(self, key: MasterLive) -> int | bytes:
        return {MasterLive.DETECT_REQUEST: bytes(2), MasterLive.DETECT_RESPONSE: bytes(6)}.get(
            key, 0
        )

    def write_slave(self, station: int, key: MasterLive, value: int) -> None:
        """Nothing."""

    def write_master(self, key: MasterLive, data: bytes) -> None:
        """Nothing."""


class FakeGateway:
    """Answers on UDP and TCP at the same port of 127.0.0.1.

    Args:
        full: Whether the master's dictionary has all entries.
        sizes: Of the slave's mailboxes.

    Attributes:
        drop: Requests by UDP that are not heard, from now on.
        repeats: Number of times that each reply by UDP is sent.
        has_master: Whether address 0 has a dictionary; otherwise it refuses what is asked.
        is_master_silent: Whether address 0 never answers, as with KickCAT.
        addresses: Of the messages that came.
        aborts_for: An address for which requests are refused, though nobody has it.
        aborts_with: Cause of these refusals.
        heard: The messages that came, without headers.
    """

    def __init__(self, *, full: bool = False, sizes: MailboxSizes = SIZES) -> None:
        self.drop = 0
        self.repeats = 1
        self.heard: list[bytes] = []
        self.has_master = True
        self.is_master_silent = False
        self.addresses: list[int] = []
        self._sizes = sizes
        self.aborts_for: int | None = None
        self.aborts_with = Cause.NO_SLAVE
        slave = ObjectDictionary(
            [
                variable(0x1008, "N", "STRING(500)", RW, "x" * 300),
                variable(0x2000, "A", "UDINT", RW),
            ]
        )
        servers = {
            MailboxType.COE: CoeServer(slave, _op, sizes),
            MailboxType.FOE: FoeServer(MemoryStore([MemoryFile("f", FILE, max_size=9999)]), sizes),
            MailboxType.SOE: SoeServer(
                {0: [SoeParameter("S-0-0032", "Mode", SoeAttribute(), 7)]}, _op, sizes
            ),
            MailboxType.VOE: VoeServer(),
        }
        large = MailboxSizes(1400, 1400)
        objects = MasterDictionary(_OneSlave(sizes), DeviceIdentity(device_name="M"), full=full)
        master = CoeServer(objects, _op, large)
        self._boxes = {
            1001: MailboxServer(servers, sizes),
            0: MailboxServer({MailboxType.COE: master}, large),
        }
        self._udp, self._tcp, self.port = _listen()
        self._threads = [
            threading.Thread(target=each) for each in (self._serve_udp, self._serve_tcp)
        ]

    def __enter__(self) -> Self:
        for thread in self._threads:
            thread.start()
        return self

    def __exit__(self, *about: object) -> None:
        self._udp.sendto(b"", self._udp.getsockname())
        self._tcp.shutdown(socket.SHUT_RDWR)
        for thread in self._threads:
            thread.join()
        self._udp.close()
        self._tcp.close()

    def _answers(self, frame: bytes) -> list[bytes]:
        header, body = decode_message(frame, EtherCatHeader.SIZE)
        self.heard.append(bytes(body))
        self.addresses.append(header.address)
        if header.address == 0 and self.is_master_silent:
            return []
        if header.address == self.aborts_for:
            refusal = error_reply(header.type, bytes(body), self.aborts_with)
            return [_frame(MailboxHeader(0, header.address, type=refusal.type), refusal.body)]
        if header.address and len(body) + MailboxHeader.SIZE > self._sizes.to_slave:
            refusal = error_reply(header.type, bytes(body), Cause.TOO_LONG)
            return [_frame(MailboxHeader(0, header.address, type=refusal.type), refusal.body)]
        box = self._boxes.get(header.address)
        if box is None or (header.address == 0 and not self.has_master):
            detail = MailboxErrorReply(detail=MailboxError.UNSUPPORTED_PROTOCOL).encode()
            return [_frame(MailboxHeader(4, header.address), detail)]
        box.receive_message(encode_message(MailboxHeader(0, type=header.type), body), 0)
        found = []
        while (message := box.next_message(0)) is not None:
            box.handle_read()
            back, data = decode_message(message)
            counted = MailboxHeader(0, header.address, type=back.type, counter=back.counter)
            found.append(_frame(counted, data))
        return found

    def _serve_udp(self) -> None:
        while True:
            frame, peer = self._udp.recvfrom(4096)
            if not frame:
                return
            if self.drop:
                self.drop -= 1
                continue
            for answer in self._answers(frame) * self.repeats:
                self._udp.sendto(answer, peer)

    def _serve_tcp(self) -> None:
        while True:
            try:
                connection, _ = self._tcp.accept()
            except OSError:
                return
            # Otherwise the second piece waits for the acknowledgement of the first one.
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            with connection, connection.makefile("rwb") as stream:
                while head := stream.read(2):
                    frame = head + stream.read(int.from_bytes(head, "little") & 0x7FF)
                    answers = b"".join(self._answers(frame))
                    stream.write(answers[:5])  # in two pieces, as a network may
                    stream.flush()
                    stream.write(answers[5:])
                    stream.flush()


def _listen() -> tuple[socket.socket, socket.socket, int]:
    """Return sockets of UDP and TCP with one port number, and that number."""
    tcp = socket.create_server(("127.0.0.1", 0))
    udp = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    port: int = tcp.getsockname()[1]
    try:
        udp.bind(("127.0.0.1", port))
    except OSError:  # a client by UDP has that number
        udp.close()
        tcp.close()
        return _listen()
    return udp, tcp, port


def _frame(header: MailboxHeader, body: bytes | memoryview) -> bytes:
    message = encode_message(header, body)
    return EtherCatHeader(len(message), type=FrameType.MAILBOX).encode() + message


def _op() -> OdState:
    return OdState.OP
