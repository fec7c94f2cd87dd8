"""CoE on the side of a slave: SDOs, SDO information, PDOs over the mailbox, emergencies."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable

from devicebus.mailbox.protocol import MailboxSizes, readable, refuse
from devicebus.mailbox.sdo_server import SdoServer
from devicebus.mailbox.sdoinfo_server import SdoInfoServer
from eap.codec.coe import CoeHeader, CoeService, Emergency, encode_message
from eap.codec.mailbox import MailboxError
from eap.od.dictionary import ObjectDictionary
from eap.od.model import OdState

MAX_PENDING = 16
"""Emergencies and PDOs that wait for the master; what comes on top is dropped and counted."""

_ANSWERED_BY = {
    CoeService.TX_PDO_REMOTE_REQUEST: CoeService.TX_PDO,
    CoeService.RX_PDO_REMOTE_REQUEST: CoeService.RX_PDO,
}


class CoeServer:
    """The CoE protocol of a slave.

    Args:
        dictionary: What SDOs read and write, and SDO information describes.
        state: Says in which state the slave is now.
        sizes: Of the slave's mailboxes.
        read_pdo: Returns the TxPDO or RxPDO of a number (told apart by the service TX_PDO or
            RX_PDO), None if there is none; without it the slave has no PDOs in its mailbox.
        write_pdo: Takes an RxPDO; returns whether there is one of this number.
    """

    def __init__(
        self,
        dictionary: ObjectDictionary,
        state: Callable[[], OdState],
        sizes: MailboxSizes,
        *,
        read_pdo: Callable[[CoeService, int], bytes | None] | None = None,
        write_pdo: Callable[[int, bytes], bool] | None = None,
    ) -> None:
        self._sdo = SdoServer(dictionary, state, sizes)
        self._info = SdoInfoServer(dictionary, sizes)
        self._read_pdo = read_pdo
        self._write_pdo = write_pdo
        self._pending: deque[bytes] = deque()
        self.dropped = 0
        """Emergencies and PDOs lost because the master did not fetch those before."""

    def reset(self) -> None:
        """Forget the transfer under way and what waits to be sent."""
        self._sdo.reset()
        self._pending.clear()

    def receive_message(self, data: bytes, now_ns: int) -> list[bytes]:
        """Act on a message behind its mailbox header and return the answers."""
        del now_ns
        header = readable(CoeHeader.decode, data)
        body = data[CoeHeader.SIZE :]
        if header.service is CoeService.SDO_REQUEST:
            return self._sdo.receive_request(body)
        if header.service is CoeService.SDO_INFORMATION:
            return self._info.receive_request(body)
        return self._answer_pdo(header, body)

    def messages_to_send(self, now_ns: int) -> list[bytes]:
        """Take emergencies and PDOs that are due."""
        del now_ns
        messages = list(self._pending)
        self._pending.clear()
        return messages

    def send_emergency(self, error_code: int, register: int = 0, data: bytes = b"") -> None:
        """Report an error, or with code 0 its end; *data* is up to five octets of the vendor."""
        emergency = Emergency(error_code, register, data.ljust(5, b"\0"))
        self._push(encode_message(CoeService.EMERGENCY, emergency.encode()))

    def send_tx_pdo(self, number: int, data: bytes) -> None:
        """Send a TxPDO through the mailbox unasked."""
        self._push(encode_message(CoeService.TX_PDO, data, number=number))

    def _push(self, message: bytes) -> None:
        if len(self._pending) < MAX_PENDING:
            self._pending.append(message)
        else:
            self.dropped += 1

    def _answer_pdo(self, header: CoeHeader, body: bytes) -> list[bytes]:
        answer = _ANSWERED_BY.get(header.service)
        if answer is not None and self._read_pdo is not None:
            data = self._read_pdo(answer, header.number)
            if data is not None:
                return [encode_message(answer, data, number=header.number)]
        write = self._write_pdo if header.service is CoeService.RX_PDO else None
        if write is not None and write(header.number, body):
            return []
        return refuse(
            MailboxError.SERVICE_NOT_SUPPORTED, f"{header.service.name}, number {header.number}"
        )
