"""SoE on the side of a slave: up to eight drives with their IDNs (ETG.1000.6)."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Mapping

from devicebus.errors import SoeError
from devicebus.mailbox.protocol import MailboxSizes, readable, refuse
from devicebus.mailbox.soe_parameter import MAX_LENGTH, SoeParameter
from eap.codec.coe import Emergency
from eap.codec.mailbox import MailboxError
from eap.codec.soe import (
    DATA_OVERHEAD,
    MAX_DRIVE,
    DataState,
    Display,
    Element,
    Idn,
    ListHead,
    SoeAttribute,
    SoeHeader,
    SoeOpcode,
    encode_fragments,
    encode_message,
)
from eap.codec.soeerror import SoeErrorCode, name_of
from eap.od.model import OdState

MAX_PENDING = 16
"""Notifications and emergencies that wait; what comes on top is dropped and counted."""
FRAGMENT_TIMEOUT_NS = 2_000_000_000
"""How long the next fragment of a write may take; what came before is forgotten then."""
LIST_OF_ALL = "S-0-0017"
_MAX_WRITTEN = MAX_LENGTH + ListHead.SIZE
_RESPONSE = {
    SoeOpcode.READ_REQUEST: SoeOpcode.READ_RESPONSE,
    SoeOpcode.WRITE_REQUEST: SoeOpcode.WRITE_RESPONSE,
}


class _Partial:
    """The fragments of a write so far."""

    __slots__ = ("content", "deadline_ns", "drive", "elements", "left")

    def __init__(self, header: SoeHeader) -> None:
        self.drive = header.drive
        self.elements = header.elements
        self.left = header.idn + 1
        self.content = bytearray()
        self.deadline_ns = 0

    def take(self, header: SoeHeader, body: bytes, now_ns: int) -> None:
        """Add a fragment; what goes beyond any list is counted and not kept."""
        self.left = header.idn
        self.content += body[: _MAX_WRITTEN + 1 - len(self.content)]
        self.deadline_ns = now_ns + FRAGMENT_TIMEOUT_NS


class SoeServer:
    """The SoE protocol of a slave.

    Args:
        drives: The IDNs of each drive by its number from 0 to 7; the list of all of them,
            S-0-0017, is added.
        state: Says in which state the slave is now.
        sizes: Of the slave's mailboxes.
    """

    def __init__(
        self,
        drives: Mapping[int, Iterable[SoeParameter]],
        state: Callable[[], OdState],
        sizes: MailboxSizes,
    ) -> None:
        if not all(0 <= drive <= MAX_DRIVE for drive in drives):
            raise ValueError(f"drives {sorted(drives)}, expected numbers from 0 to {MAX_DRIVE}")
        self.drives = {drive: _with_list(items) for drive, items in drives.items()}
        self._state = state
        self._sizes = sizes
        self._partial: _Partial | None = None
        self._running: dict[tuple[int, int], SoeParameter] = {}
        self._pending: deque[bytes] = deque()
        self.dropped = 0
        """Notifications and emergencies lost because the master did not fetch those before."""

    def reset(self) -> None:
        """Forget fragments, and what waits to be sent; procedure commands run on."""
        self._partial = None
        self._running.clear()
        self._pending.clear()

    def receive_message(self, data: bytes, now_ns: int) -> list[bytes]:
        """Act on a message behind its mailbox header and return the answer in its fragments."""
        header = readable(SoeHeader.decode, data)
        if header.opcode not in _RESPONSE:
            refuse(MailboxError.SERVICE_NOT_SUPPORTED, f"opcode {header.opcode.name}")
        body = data[SoeHeader.SIZE :]
        if header.opcode is SoeOpcode.WRITE_REQUEST:
            joined = self._join(header, body, now_ns)
            if joined is None:
                return []
            body = joined
        else:
            self._partial = None
        room = self._sizes.to_master - DATA_OVERHEAD
        error = False
        try:
            answer = self._answer(header, body, now_ns)
        except SoeError as exc:
            error, answer = True, exc.code.to_bytes(2, "little")
        opcode = _RESPONSE[header.opcode]
        head = SoeHeader(opcode, 0, error, header.drive, header.elements, header.idn)
        return encode_fragments(head, answer, room)

    def messages_to_send(self, now_ns: int) -> list[bytes]:
        """Take emergencies, and notifications of procedure commands that ended by now."""
        for (drive, number), parameter in list(self._running.items()):
            procedure = parameter.procedure
            state = procedure.state(now_ns) if procedure is not None else DataState(0)
            if state != DataState.BUSY:
                del self._running[drive, number]
                if state:
                    self.send_notification(parameter.idn, drive, state)
        messages = list(self._pending)
        self._pending.clear()
        return messages

    def send_notification(self, idn: Idn, drive: int, state: DataState) -> None:
        """Tell the master the data state of a procedure command."""
        data = state.to_bytes(2, "little")
        self._push(SoeOpcode.NOTIFICATION, drive, idn.number, data, Element.DATA_STATE)

    def send_emergency(
        self, error_code: int, register: int = 0, data: bytes = b"", *, drive: int = 0
    ) -> None:
        """Report an error of a drive; *data* is up to five octets of the vendor."""
        emergency = Emergency(error_code, register, data.ljust(5, b"\0"))
        self._push(SoeOpcode.EMERGENCY, drive, 0, emergency.encode(), 0)

    def _push(self, opcode: SoeOpcode, drive: int, idn: int, body: bytes, elements: int) -> None:
        if len(self._pending) >= MAX_PENDING:
            self.dropped += 1
            return
        message = encode_message(opcode, idn, body, drive=drive, elements=elements)
        self._pending.append(message)

    def _join(self, header: SoeHeader, body: bytes, now_ns: int) -> bytes | None:
        """Return the whole content of a write, or None while fragments are missing."""
        partial = self._partial
        if partial is not None and not self._continues(partial, header, body, now_ns):
            partial = None
        if header.incomplete:
            self._partial = partial or _Partial(header)
            self._partial.take(header, body, now_ns)
            return None
        self._partial = None
        if partial is None:
            return body
        partial.take(header, body, now_ns)
        return bytes(partial.content)

    def _continues(self, partial: _Partial, header: SoeHeader, body: bytes, now_ns: int) -> bool:
        if now_ns > partial.deadline_ns:
            return False
        if (header.drive, header.elements) != (partial.drive, partial.elements):
            return False
        if header.incomplete:
            return header.idn < partial.left
        # Masters that count total / room are one too high if the last fragment is a full one.
        is_full = len(body) == self._sizes.to_slave - DATA_OVERHEAD
        return partial.left == 1 or (partial.left == 2 and is_full)

    def _answer(self, header: SoeHeader, body: bytes, now_ns: int) -> bytes:
        parameter = self._find(header.drive, header.idn)
        if header.opcode is SoeOpcode.READ_REQUEST:
            return parameter.read(header.elements, now_ns)
        if len(body) > _MAX_WRITTEN:
            raise parameter.refusal(SoeErrorCode.VALUE_TOO_LONG)
        parameter.write(header.elements, body, self._state(), now_ns)
        if parameter.procedure is not None:
            self._running[header.drive, header.idn] = parameter
        return b""

    def _find(self, drive: int, number: int) -> SoeParameter:
        if drive not in self.drives:
            raise _refusal(SoeErrorCode.INVALID_DRIVE)
        try:
            return self.drives[drive][number]
        except KeyError:
            raise _refusal(SoeErrorCode.NO_IDN) from None


def _with_list(items: Iterable[SoeParameter]) -> dict[int, SoeParameter]:
    parameters = {item.idn.number: item for item in items}

    def listed() -> bytes:
        return b"".join(number.to_bytes(2, "little") for number in sorted(parameters))

    protected = {"protected_preop": 1, "protected_safeop": 1, "protected_op": 1}
    attribute = SoeAttribute(length=1, is_list=1, display=Display.IDN, **protected)
    whole = SoeParameter(LIST_OF_ALL, "IDN list of all operation data", attribute, read=listed)
    parameters.setdefault(whole.idn.number, whole)
    return parameters


def _refusal(code: SoeErrorCode) -> SoeError:
    return SoeError(name_of(code), code=code)
