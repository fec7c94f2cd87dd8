"""EEPROM images: decoded, written again, read through a controller, and what follows from them."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress

from devicebus.errors import BusError
from devicebus.mailbox.conversation import drive
from devicebus.master import eeprom
from devicebus.master.image import SlaveProcessData, plan_image
from devicebus.master.pdo import channels_from_sii
from devicebus.master.procedure import Sleep, Step, StepReplies
from devicebus.wire import sii
from devicebus.wire.datagram import DatagramReply, DatagramRequest
from devicebus.wire.register import Register
from devicebus.wire.sii import CategoryHeader, SiiCategory, SiiFixed
from eap.errors import CodecError
from tools.fuzz.messages import cut

_FIXED = SiiFixed(size=7).encode()


def fuzz_one(data: bytes) -> None:
    """Only CodecError and errors of the bus may pass."""
    for image in (data, _FIXED + data, _FIXED + b"".join(_categories(data)) + b"\xff\xff"):
        _decode(image)
        with suppress(BusError):
            there = _read(image)
            if image.ljust(len(there), b"\xff")[: len(there)] != there:
                raise AssertionError("other octets were read than are there")
            _decode(there)


def _categories(data: bytes) -> Iterator[bytes]:
    """Cut *data* into categories of known types, whose lengths are true but for every fourth."""
    kinds = list(SiiCategory)
    for number, body in enumerate(cut(data)):
        octets = body + bytes(len(body) % 2)
        length = len(octets) // 2 + (number % 4 == 3)
        yield CategoryHeader(kinds[len(body) % len(kinds)], length).encode() + octets


def _decode(image: bytes) -> None:
    try:
        content = sii.decode(image)
    except CodecError:
        return
    again = sii.decode(sii.encode(content))
    if [item for item in content.other if item[1]] != list(again.other):
        raise AssertionError("the image encodes to other categories")
    if (content.strings, content.tx_pdos, content.rx_pdos, content.sync_managers) != (
        again.strings, again.tx_pdos, again.rx_pdos, again.sync_managers,
    ):  # fmt: skip
        raise AssertionError("the image encodes to another device")
    with suppress(BusError, CodecError):
        plan_image([SlaveProcessData(1001, channels_from_sii(content))])


def _read(image: bytes) -> bytes:
    """Read *image* as a master does, from a controller that gives four octets at a time."""
    word = 0

    def exchange(step: Step) -> StepReplies:
        nonlocal word
        replies = []
        if not isinstance(step, Sleep):
            for access in step:
                if access.ado == Register.EEPROM_CONTROL and len(access.data) == 6:
                    word = int.from_bytes(access.data[2:6], "little")
                replies.append(_reply(access, image, word))
        return StepReplies(replies, 0)

    return drive(eeprom.read_image(1001), exchange)


def _reply(access: DatagramRequest, image: bytes, word: int) -> DatagramReply:
    here = image[2 * word : 2 * word + 4].ljust(4, b"\xff")
    octets = bytes(2) + word.to_bytes(4, "little") + here
    return DatagramReply(octets[: len(access.data)].ljust(len(access.data), b"\0"), 1)
