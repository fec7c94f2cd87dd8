"""One client's session with the dictionary of the master (ETG.1510): address 0 of a gateway."""

from __future__ import annotations

from collections.abc import Awaitable, Callable

from devicebus.errors import MailboxRefusedError
from devicebus.mailbox.coe_server import CoeServer
from devicebus.mailbox.protocol import MailboxSizes
from eap.ads.operation import Operation
from eap.ams.access import place_of
from eap.codec.mailbox import MailboxError, MailboxType
from eap.gateway.error_table import Cause
from eap.gateway.refusal import mailbox_error, refuse
from eap.gateway.rights import operation_of
from eap.od.dictionary import ObjectDictionary
from eap.od.model import OdState
from eap.services.gateway.client_session import GatewayReply, refusals


class MasterSession:
    """Session of one client with the master: segmented transfers of two clients do not meet.

    Args:
        dictionary: Of the master.
        room: Octets of the longest answer behind its mailbox header.
        refresh: Sees to it that what an object shows is not old; it gets the object's index.
        is_fresh: Says whether that is so already.
    """

    is_running = False

    def __init__(
        self,
        dictionary: ObjectDictionary,
        room: int,
        refresh: Callable[[int], Awaitable[None]],
        is_fresh: Callable[[int], bool],
    ) -> None:
        self._dictionary = dictionary
        self._refresh = refresh
        self._is_fresh = is_fresh
        self._server = CoeServer(dictionary, _op, MailboxSizes.of_data(room))

    async def ask(self, kind: MailboxType, body: bytes) -> list[GatewayReply]:
        """Return the answers to a request."""
        if kind is not MailboxType.COE:
            return refusals(kind, body, Cause.NO_PROTOCOL)
        await self._refresh(_index_of(operation_of(kind, body)))
        return self.ask_now(body)

    def is_ready(self, operation: Operation | None) -> bool:
        """Say whether the answer to a request by CoE, which does *operation*, need not wait."""
        return self._is_fresh(_index_of(operation))

    def ask_now(self, body: bytes) -> list[GatewayReply]:
        """Return the answers to a request by CoE that is ready."""
        try:
            answers = self._server.receive_message(body, 0)
        except MailboxRefusedError as exc:
            if exc.detail == MailboxError.SIZE_TOO_SHORT:
                return [GatewayReply(*refuse(MailboxType.COE, body, Cause.TOO_SHORT))]
            return [GatewayReply(*mailbox_error(exc.detail))]
        return [GatewayReply(MailboxType.COE, answer) for answer in answers]

    async def read(self, index: int, subindex: int, *, complete: bool) -> bytes:
        """Return an entry or an object as it is now; raise SdoAbortError."""
        await self._refresh(index)
        read = self._dictionary.upload_complete if complete else self._dictionary.upload
        return read(index, subindex, OdState.OP)

    def write(self, index: int, subindex: int, data: bytes) -> None:
        """Write an entry; raise SdoAbortError."""
        self._dictionary.download(index, subindex, data, OdState.OP)

    def close(self) -> None:
        """Forget what is under way."""
        self._server.reset()


def _index_of(operation: Operation | None) -> int:
    return place_of(operation)[1] >> 16 if operation else 0


def _op() -> OdState:
    return OdState.OP
