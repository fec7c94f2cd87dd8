"""An AMS router of another make by MQTT: paho and ``struct``, nothing of this project."""

from __future__ import annotations

import queue
import struct
import threading
from contextlib import suppress
from typing import Self
from xml.etree import ElementTree as ET

import paho.mqtt.client as paho

from tests.support.ams import Ams, parse

PATIENCE_S = 10.0


class PahoPeer:
    """Tells of itself, asks, and answers every request with ``peer was asked``.

    Attributes:
        forms: In which forms packets came: True for those with a prefix.
        routers: Names of the routers that told of themselves, by NetID; None for who is gone.
    """

    def __init__(
        self, address: str, network: str, net_id: str, *, is_prefixed: bool = False
    ) -> None:
        self.forms: set[bool] = set()
        self.routers: dict[str, str | None] = {}
        self.answers: queue.Queue[Ams] = queue.Queue()
        self._told = threading.Condition()
        self._start, self._net_id, self._is_prefixed = f"{network}/", net_id, is_prefixed
        self._client = paho.Client(paho.CallbackAPIVersion.VERSION2, protocol=paho.MQTTv311)
        self._client.on_message = self._take
        self._client.on_connect = self._subscribe
        self._client.will_set(self._topic(net_id, "info"), self._info("false"), 2, retain=True)
        self._client.connect(address)
        self._has_left = threading.Event()
        self._thread = threading.Thread(target=self._run)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        """Vanish: the broker publishes the will."""
        self._has_left.set()
        self._thread.join()
        self._client._sock_close()

    def wait_for_router(self, net_id: str, name: str | None) -> None:
        """Wait until the router with *net_id* says that it has *name*; None: that it is gone."""
        with self._told:
            assert self._told.wait_for(lambda: self.routers.get(net_id, "") == name, PATIENCE_S), (
                self.routers
            )

    def publish(self, net_id: str, rest: str, payload: bytes, *, retain: bool = False) -> None:
        """Publish anything."""
        self._client.publish(self._topic(net_id, rest), payload, 0, retain=retain)

    def ask(self, router: str, packet: Ams) -> Ams:
        """Ask *router*; return the answer."""
        self.publish(router, "ams", self._form(packet))
        return self.answers.get(timeout=PATIENCE_S)

    def _run(self) -> None:
        while not self._has_left.is_set():  # of paho, loop_stop takes up to a second
            self._client.loop(timeout=0.02)

    def _subscribe(self, *_: object) -> None:
        self._client.subscribe(
            [(self._topic(self._net_id, "ams/#"), 2), (self._topic("+", "info"), 2)]
        )
        self._client.publish(self._topic(self._net_id, "info"), self._info("true"), 2, retain=True)

    def _take(self, _client: object, _data: object, message: paho.MQTTMessage) -> None:
        net_id, _, rest = message.topic.removeprefix(self._start).partition("/")
        if rest == "info":
            with suppress(ET.ParseError):  # what a test published itself
                online = ET.fromstring(message.payload).find("online")
                if online is not None:
                    self._tell(net_id, online)
            return
        is_prefixed = message.payload[:2] == b"\0\0"
        if is_prefixed:
            assert struct.unpack("<HI", message.payload[:6]) == (0, len(message.payload) - 6)
        self.forms.add(is_prefixed)
        packet = parse(message.payload[6:] if is_prefixed else message.payload)
        if rest == "ams/res":
            self.answers.put(packet)
        else:
            router = packet.source.partition(":")[0]
            self.publish(router, "ams/res", self._form(packet.answer(b"peer was asked")))

    def _tell(self, net_id: str, online: ET.Element) -> None:
        with self._told:
            self.routers[net_id] = online.get("name") if online.text == "true" else None
            self._told.notify_all()

    def _form(self, packet: Ams) -> bytes:
        octets = packet.octets()
        return (struct.pack("<HI", 0, len(octets)) if self._is_prefixed else b"") + octets

    def _topic(self, net_id: str, rest: str) -> str:
        return f"{self._start}{net_id}/{rest}"

    @staticmethod
    def _info(word: str) -> bytes:
        return (
            f'<info>\n<online name="FOREIGN" osVersion="10.0.14393" osPlatform="2"'
            f' tcVersion="3.1.4024">{word}</online>\n</info>'
        ).encode()
