"""ADS services of a slave: its object dictionary by index group and offset (ETG.1020, AoE).

A master tells a slave its address first, by writing a NetID; a slave that was never told takes the
one of the first request for its own.
"""

from __future__ import annotations

from collections.abc import Callable

from devicebus.mailbox.aoe_server import AmsAnswer
from eap.codec.ads import AdsError, AdsRange, AdsReadWrite, IndexGroup, encode_result
from eap.codec.ams import AmsCommand, AmsHeader
from eap.errors import TruncatedError
from eap.ids import NetId
from eap.od import info
from eap.od.abort import AbortCode, SdoAbortError
from eap.od.dictionary import ObjectDictionary
from eap.od.model import OdState

_NAME_SIZE = 16
_NET_ID_OFFSET = 3
_NET_ID_SIZE = 6
_COMPLETE = 0x100
_RUN = 5
_SERVICES = frozenset((AmsCommand.READ_DEVICE_INFO, AmsCommand.READ_STATE, AmsCommand.READ,
                       AmsCommand.WRITE, AmsCommand.READ_WRITE))  # fmt: skip
_NOT_THERE = frozenset((AbortCode.NO_OBJECT, AbortCode.NO_SUBINDEX))


class _RefusedError(Exception):
    """A service that is answered with a result other than 0."""

    def __init__(self, result: AdsError) -> None:
        super().__init__(result.name)
        self.result = result


class AdsServer:
    """The services of one slave; an instance is the handler of an AoeServer.

    Args:
        dictionary: What is read and written.
        state: Says in which state the slave is now.
        name: Of the device; 16 octets of it are told.

    Attributes:
        address: NetID and port of the slave; None until a request has told them.
    """

    def __init__(
        self, dictionary: ObjectDictionary, state: Callable[[], OdState], name: str
    ) -> None:
        self.address: tuple[NetId, int] | None = None
        self._dictionary = dictionary
        self._state = state
        self._name = name.encode("latin-1", "replace")[:_NAME_SIZE].ljust(_NAME_SIZE, b"\0")

    def forget(self) -> None:
        """Take any address next: the mailbox starts again."""
        self.address = None

    def __call__(self, header: AmsHeader, data: bytes) -> AmsAnswer:
        """Answer one request."""
        if header.command == AmsCommand.WRITE and self._take_address(header, data):
            return AmsAnswer(encode_result(AdsError.NONE))
        if self.address is None:
            self.address = header.target, header.target_port
        if header.target != self.address[0]:
            return AmsAnswer(error_code=AdsError.TARGET_MACHINE)
        if header.target_port != self.address[1]:
            return AmsAnswer(error_code=AdsError.TARGET_PORT)
        if header.command not in _SERVICES:
            return AmsAnswer(error_code=AdsError.SERVICE)
        return AmsAnswer(self._serve_or_refuse(header.command, data))

    def _serve_or_refuse(self, command: int, data: bytes) -> bytes:
        try:
            return self._serve(command, data)
        except _RefusedError as exc:
            return encode_result(exc.result)
        except TruncatedError:
            return encode_result(AdsError.SIZE)
        except SdoAbortError as exc:
            known = AdsError.NOT_FOUND if exc.code in _NOT_THERE else AdsError.GENERAL
            return encode_result(known)

    def _take_address(self, header: AmsHeader, data: bytes) -> bool:
        if len(data) < AdsRange.SIZE + _NET_ID_SIZE:
            return False
        asked = AdsRange.decode(data)
        place = IndexGroup.ADDRESS, _NET_ID_OFFSET, _NET_ID_SIZE
        if (asked.group, asked.offset, asked.length) != place:
            return False
        octets = data[AdsRange.SIZE : AdsRange.SIZE + _NET_ID_SIZE]
        if not any(octets[:4]):
            octets = bytes(header.target)[:4] + octets[4:]
        self.address = NetId(octets), header.target_port
        return True

    def _serve(self, command: int, data: bytes) -> bytes:
        if command == AmsCommand.READ_DEVICE_INFO:
            return encode_result(AdsError.NONE) + bytes((1, 0, 0, 0)) + self._name
        if command == AmsCommand.READ_STATE:
            return encode_result(AdsError.NONE) + _RUN.to_bytes(2, "little") + bytes(2)
        if command == AmsCommand.READ:
            asked = AdsRange.decode(data)
            octets = self._read(asked.group, asked.offset, asked.length)
            return encode_result(AdsError.NONE, octets)
        if command == AmsCommand.WRITE:
            asked = AdsRange.decode(data)
            self._write(asked.group, asked.offset, _written(data[AdsRange.SIZE :], asked.length))
            return encode_result(AdsError.NONE)
        both = AdsReadWrite.decode(data)
        written = _written(data[AdsReadWrite.SIZE :], both.write_length)
        if written:
            self._write(both.group, both.offset, written)
        octets = self._read(both.group, both.offset, both.read_length)
        return encode_result(AdsError.NONE, octets)

    def _read(self, group: int, offset: int, length: int) -> bytes:
        index, low = offset >> 16, offset & 0xFFFF
        subindex = low & 0xFF
        if group == IndexGroup.SDO:
            octets = self._upload(index, subindex, complete=_is_complete(low))
        elif group == IndexGroup.OBJECT_LIST:
            octets = info.object_list(self._dictionary, index)
        elif group == IndexGroup.OBJECT_DESCRIPTION:
            octets = info.object_description(self._dictionary, index)
        elif group == IndexGroup.ENTRY_DESCRIPTION:
            octets = info.entry_description(self._dictionary, index, subindex, low >> 8)
        else:
            raise _RefusedError(AdsError.INDEX_GROUP)
        if len(octets) > length:
            raise _RefusedError(AdsError.SIZE)
        return octets

    def _upload(self, index: int, subindex: int, *, complete: bool) -> bytes:
        if complete:
            return self._dictionary.upload_complete(index, 0, self._state())
        return self._dictionary.upload(index, subindex, self._state())

    def _write(self, group: int, offset: int, data: bytes) -> None:
        if group != IndexGroup.SDO:
            raise _RefusedError(AdsError.INDEX_GROUP)
        index, low = offset >> 16, offset & 0xFFFF
        if _is_complete(low):
            self._dictionary.download_complete(index, 0, data, self._state())
        else:
            self._dictionary.download(index, low & 0xFF, data, self._state())


def _is_complete(low: int) -> bool:
    if low >> 9:
        raise _RefusedError(AdsError.INDEX_OFFSET)
    return bool(low & _COMPLETE)


def _written(data: bytes, length: int) -> bytes:
    if len(data) < length:
        raise _RefusedError(AdsError.SIZE)
    return data[:length]
