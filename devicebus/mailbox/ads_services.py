"""ADS services of whoever has an object dictionary: by index group and offset (ETG.1020, AoE)."""

from __future__ import annotations

from collections.abc import Callable

from eap.aoe.answer import AmsAnswer
from eap.codec.ads import AdsError, AdsRange, AdsReadWrite, IndexGroup, encode_result
from eap.codec.ams import AmsCommand
from eap.errors import TruncatedError
from eap.od import info
from eap.od.abort import AbortCode, SdoAbortError
from eap.od.dictionary import ObjectDictionary
from eap.od.model import OdState

_NAME_SIZE = 16
_COMPLETE = 0x100
_RUN = 5
_SERVICES = frozenset((AmsCommand.READ_DEVICE_INFO, AmsCommand.READ_STATE, AmsCommand.READ,
                       AmsCommand.WRITE, AmsCommand.READ_WRITE))  # fmt: skip
_RESULTS: dict[int, AdsError] = {
    AbortCode.NO_OBJECT: AdsError.NOT_FOUND,
    AbortCode.NO_SUBINDEX: AdsError.NOT_FOUND,
}


class _RefusedError(Exception):
    """A service that is answered with a result other than 0."""

    def __init__(self, result: AdsError) -> None:
        super().__init__(result.name)
        self.result = result


def slave_result(abort: SdoAbortError) -> AdsError:
    """Return the result by which a slave tells of a refused SDO (as Beckhoff's stack code does)."""
    return _RESULTS.get(abort.code, AdsError.GENERAL)


class AdsServices:
    """What can be asked of one dictionary.

    Args:
        dictionary: What is read and written.
        state: Says in which state the device is now.
        name: Of the device; 16 octets of it are told.
        result_of: The result that tells of a refused SDO.
    """

    def __init__(
        self,
        dictionary: ObjectDictionary,
        state: Callable[[], OdState],
        name: str,
        result_of: Callable[[SdoAbortError], AdsError] = slave_result,
    ) -> None:
        self._dictionary = dictionary
        self._state = state
        self._name = name.encode("latin-1", "replace")[:_NAME_SIZE].ljust(_NAME_SIZE, b"\0")
        self._result_of = result_of

    def answer(self, command: int, data: bytes) -> AmsAnswer:
        """Do what *command* asks for with the *data* behind its header."""
        if command not in _SERVICES:
            return AmsAnswer(error_code=AdsError.SERVICE)
        try:
            return AmsAnswer(self._serve(command, data))
        except _RefusedError as exc:
            return _refusal(command, exc.result)
        except TruncatedError:
            return _refusal(command, AdsError.SIZE)
        except SdoAbortError as exc:
            return self.refuse(command, exc)

    def refuse(self, command: int, abort: SdoAbortError) -> AmsAnswer:
        """Return the answer to *command* that tells of a refused SDO."""
        return _refusal(command, self._result_of(abort))

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


def _refusal(command: int, result: AdsError) -> AmsAnswer:
    # Clients unpack the length of what was read whatever the result is.
    has_data = command in {AmsCommand.READ, AmsCommand.READ_WRITE}
    return AmsAnswer(encode_result(result, b"" if has_data else None))


def _is_complete(low: int) -> bool:
    if low >> 9:
        raise _RefusedError(AdsError.INDEX_OFFSET)
    return bool(low & _COMPLETE)


def _written(data: bytes, length: int) -> bytes:
    if len(data) < length:
        raise _RefusedError(AdsError.SIZE)
    return data[:length]
