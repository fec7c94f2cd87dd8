"""Describes an object dictionary to a client (ETG.1000.6, SDO information)."""

from __future__ import annotations

from devicebus.mailbox.protocol import MailboxSizes
from eap.codec.coe import CoeService, encode_message
from eap.codec.sdoinfo import (
    EntryRequest,
    InfoError,
    ListRequest,
    ObjectRequest,
    SdoInfoHeader,
    SdoInfoOpcode,
)
from eap.errors import CodecError, TruncatedError
from eap.od import info
from eap.od.abort import AbortCode, SdoAbortError
from eap.od.dictionary import ObjectDictionary

_OVERHEAD = 12
"""Octets of a mailbox in front of the body: headers of mailbox, CoE and SDO information."""


class SdoInfoServer:
    """The SDO information service of a slave."""

    def __init__(self, dictionary: ObjectDictionary, sizes: MailboxSizes) -> None:
        self._dictionary = dictionary
        self._sizes = sizes

    def receive_request(self, body: bytes) -> list[bytes]:
        """Answer a request behind its CoE header with as many fragments as it takes."""
        try:
            header = SdoInfoHeader.decode(body)
            opcode, answer = self._answer(header.opcode, body[SdoInfoHeader.SIZE :])
        except SdoAbortError as exc:
            opcode, answer = SdoInfoOpcode.ERROR, InfoError(exc.code).encode()
        except TruncatedError:
            opcode, answer = SdoInfoOpcode.ERROR, InfoError(AbortCode.TOO_SHORT).encode()
        except CodecError:
            opcode, answer = SdoInfoOpcode.ERROR, InfoError(AbortCode.COMMAND).encode()
        # An index is never cut in two.
        room = (self._sizes.to_master - _OVERHEAD) & ~1
        pieces = [answer[at : at + room] for at in range(0, len(answer), room)]
        return [
            encode_message(
                CoeService.SDO_INFORMATION,
                SdoInfoHeader(opcode, bool(left), fragments_left=left).encode() + piece,
            )
            for left, piece in zip(range(len(pieces) - 1, -1, -1), pieces, strict=True)
        ]

    def _answer(self, opcode: SdoInfoOpcode, body: bytes) -> tuple[SdoInfoOpcode, bytes]:
        if opcode is SdoInfoOpcode.LIST_REQUEST:
            listed = info.object_list(self._dictionary, ListRequest.decode(body).list_type)
            return SdoInfoOpcode.LIST_RESPONSE, listed
        if opcode is SdoInfoOpcode.OBJECT_REQUEST:
            index = ObjectRequest.decode(body).index
            return SdoInfoOpcode.OBJECT_RESPONSE, info.object_description(self._dictionary, index)
        if opcode is SdoInfoOpcode.ENTRY_REQUEST:
            asked = EntryRequest.decode(body)
            described = info.entry_description(
                self._dictionary, asked.index, asked.subindex, asked.value_info
            )
            return SdoInfoOpcode.ENTRY_RESPONSE, described
        raise SdoAbortError(AbortCode.COMMAND, 0, 0, f"opcode {opcode.name} is no request")
