"""Messages of a broker as mosquitto_sub shows them, and messages that mosquitto_pub sends."""

from __future__ import annotations

import json
import shutil
import subprocess
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

from tests.support.npm import node_environment

SPARKPLUG = Path(__file__).with_name("sparkplug.js")


class Heard(NamedTuple):
    """One message."""

    topic: str
    payload: bytes
    is_retained: bool


class Listener:
    """All messages of a broker; it connects again by itself."""

    def __init__(self) -> None:
        self.messages: list[Heard] = []

    def take(self, line: str) -> None:
        topic, is_retained, digits = line.split(" ")
        self.messages.append(Heard(topic, bytes.fromhex(digits), is_retained == "1"))

    def payloads(self, topic: str, since: int = 0) -> list[Any]:
        """Return the JSON payloads on *topic*, behind the first *since* messages."""
        found = [each for each in self.messages[since:] if each.topic == topic and each.payload]
        return [json.loads(each.payload) for each in found]

    def texts(self, topic: str, since: int = 0) -> list[str]:
        """Return the payloads on *topic* as text."""
        return [m.payload.decode() for m in self.messages[since:] if m.topic == topic]


@contextmanager
def listen(address: str, topic: str = "#", *words: str) -> Iterator[Listener]:
    """Hear all messages on *topic* of the broker at *address*."""
    found = Listener()
    program = shutil.which("mosquitto_sub")
    assert program is not None
    process = subprocess.Popen(
        [program, "-h", address, "-t", topic, "-F", "%t %r %x", *words],
        stdout=subprocess.PIPE, text=True,
    )  # fmt: skip

    def read() -> None:
        assert process.stdout is not None
        for line in process.stdout:
            found.take(line.removesuffix("\n"))

    reader = threading.Thread(target=read)
    reader.start()
    try:
        yield found
    finally:
        process.kill()
        reader.join(20)
        process.communicate()


def publish(address: str, topic: str, payload: bytes, *words: str) -> None:
    """Publish one message with QoS 1; an empty one clears what is retained."""
    program = shutil.which("mosquitto_pub")
    assert program is not None
    command = [program, "-h", address, "-t", topic, "-q", "1", "-s" if payload else "-n", *words]
    subprocess.run(command, input=payload, check=True, timeout=20)


def decode_sparkplug(messages: list[Heard]) -> list[dict[str, Any]]:
    """Return topic and payload of messages as sparkplug-payload of npm decodes them."""
    lines = "".join(f"{each.topic} {each.payload.hex()}\n" for each in messages)
    done = subprocess.run(
        ["node", str(SPARKPLUG)], input=lines, env=node_environment(), capture_output=True,
        text=True, check=True, timeout=60,
    )  # fmt: skip
    return [json.loads(line) for line in done.stdout.splitlines()]


def encode_sparkplug(**payload: Any) -> bytes:
    """Return a payload as sparkplug-payload of npm encodes it."""
    done = subprocess.run(
        ["node", str(SPARKPLUG), json.dumps(payload)], env=node_environment(), capture_output=True,
        text=True, check=True, timeout=60,
    )  # fmt: skip
    return bytes.fromhex(done.stdout)
