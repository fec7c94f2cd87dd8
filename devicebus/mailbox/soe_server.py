"""SoE of a slave: up to eight drives with their IDNs (ETG.1000.6).

A :class:`SoeParameter` is one IDN with its elements; it refuses with SoeError.  A
:class:`ProcedureCommand` runs behind an IDN that is a procedure command (IEC 61800-7-300): writing
3 (set and enabled) starts it, writing 0 clears it, and a command must be cleared before the next
start.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence

from devicebus.errors import SoeError
from devicebus.mailbox.protocol import MailboxSizes, decode_or_error, raise_mailbox_error
from eap.codec.coe import Emergency
from eap.codec.mailbox import MailboxError
from eap.codec.soe import (
    COMMAND_CLEAR,
    COMMAND_START,
    DATA_OVERHEAD,
    MAX_DRIVE,
    DataState,
    Display,
    Element,
    Idn,
    ListHead,
    SoeAttribute,
    SoeErrorCode,
    SoeHeader,
    SoeOpcode,
    SoeScalar,
    decode_list,
    decode_scalar,
    encode_fragments,
    encode_list,
    encode_message,
    encode_scalar,
    encode_value,
    name_of,
)
from eap.errors import CodecError
from eap.od.model import OdState


class ProcedureCommand:
    """Procedure command and its data state.

    Args:
        duration_ns: Execution time.
        start: Called at the start; refuses with SoeError, such as COMMAND_NOT_NOW.
        finish: Called after the execution time; returns true for success.
        is_interruptible: Allows clearing during execution.
    """

    def __init__(
        self,
        *,
        duration_ns: int = 0,
        start: Callable[[], None] | None = None,
        finish: Callable[[], bool] | None = None,
        is_interruptible: bool = True,
    ) -> None:
        self.duration_ns = duration_ns
        self._start = start
        self._finish = finish
        self._is_interruptible = is_interruptible
        self._state = DataState(0)
        self._end_ns = 0

    def command(self, value: int, now_ns: int) -> None:
        """Handle a value written to the IDN; raise SoeError if it is refused."""
        state = self.state(now_ns)
        if value == COMMAND_CLEAR:
            if state == DataState.BUSY and not self._is_interruptible:
                raise _command_error(SoeErrorCode.COMMAND_NOT_INTERRUPTIBLE)
            self._state = DataState(0)
            return
        if value != COMMAND_START:
            raise _command_error(SoeErrorCode.INVALID_VALUE)
        if state:
            raise _command_error(SoeErrorCode.COMMAND_ACTIVE)
        if self._start is not None:
            self._start()
        self._state = DataState.BUSY
        self._end_ns = now_ns + self.duration_ns

    def state(self, now_ns: int) -> DataState:
        """Return the data state at *now_ns*, after ending a command that is due."""
        if self._state == DataState.BUSY and now_ns >= self._end_ns:
            is_good = self._finish is None or self._finish()
            self._state = DataState.DONE if is_good else DataState.FAILED
        return self._state


def _command_error(code: SoeErrorCode) -> SoeError:
    return SoeError(name_of(code), code=code)


MAX_LENGTH = 0xFFFF
"""Longest list in bytes: its length header has 16 bits."""
_MISSING = {
    Element.NAME: SoeErrorCode.NO_NAME,
    Element.UNIT: SoeErrorCode.NO_UNIT,
    Element.MINIMUM: SoeErrorCode.NO_MINIMUM,
    Element.MAXIMUM: SoeErrorCode.NO_MAXIMUM,
    Element.DEFAULT: SoeErrorCode.NO_DEFAULT,
}
_READ_ONLY = {
    Element.DATA_STATE: SoeErrorCode.ELEMENT_1_ACCESS,
    Element.NAME: SoeErrorCode.NAME_READ_ONLY,
    Element.ATTRIBUTE: SoeErrorCode.ATTRIBUTE_READ_ONLY,
    Element.UNIT: SoeErrorCode.UNIT_READ_ONLY,
    Element.MINIMUM: SoeErrorCode.MINIMUM_READ_ONLY,
    Element.MAXIMUM: SoeErrorCode.MAXIMUM_READ_ONLY,
    Element.DEFAULT: SoeErrorCode.DEFAULT_READ_ONLY,
}


class SoeParameter:
    """One IDN with its elements; only its value (element 7) is writable.

    Args:
        idn: Number as text, such as ``S-0-0032``.
        name: Element 2; empty for none.
        attribute: Element 3: type, length and protection of the value.
        value: Initial value and default.
        unit: Element 4.
        limits: Elements 5 and 6, each None for none; checked on writing.
        max_length: Maximum length of a list in bytes; by default the initial length.
        read: Returns the encoded value in place of the stored one (a list without its length
            header).
        write: Called with the encoded value before it is stored; refuses with SoeError.
        procedure: Command behind the IDN, if it is a procedure command.
    """

    def __init__(
        self,
        idn: str,
        name: str,
        attribute: SoeAttribute,
        value: SoeScalar | str | Sequence[SoeScalar] = 0,
        *,
        unit: str | None = None,
        limits: tuple[SoeScalar | None, SoeScalar | None] = (None, None),
        max_length: int = 0,
        read: Callable[[], bytes] | None = None,
        write: Callable[[bytes], None] | None = None,
        procedure: ProcedureCommand | None = None,
    ) -> None:
        self.idn = Idn.parse(idn)
        self.attribute = attribute
        self.limits = limits
        self.procedure = procedure
        self._read = read
        self._write = write
        value = () if attribute.is_list and value == 0 else value
        self.octets = encode_value(attribute, value)
        if attribute.is_list:
            self.octets = decode_list(self.octets)[1]
        self.max_length = min(MAX_LENGTH, max(max_length, len(self.octets)))
        self._fixed = {
            Element.NAME: encode_list(name.encode()) if name else None,
            Element.ATTRIBUTE: attribute.encode(),
            Element.UNIT: None if unit is None else encode_list(unit.encode()),
            Element.MINIMUM: None if limits[0] is None else encode_scalar(attribute, limits[0]),
            Element.MAXIMUM: None if limits[1] is None else encode_scalar(attribute, limits[1]),
            Element.DEFAULT: self._framed(self.octets),
        }

    def read(self, elements: int, now_ns: int) -> bytes:
        """Return the requested elements, concatenated; raise SoeError if one is missing."""
        requested = [element for element in Element if elements & element]
        if not requested:
            raise self.error(SoeErrorCode.NO_ELEMENT)
        return b"".join(self._read_element(element, now_ns) for element in requested)

    def write(self, elements: int, data: bytes, state: OdState, now_ns: int) -> None:
        """Write the value; raise SoeError if it is refused, or another element is requested."""
        for element, code in _READ_ONLY.items():
            if elements & element:
                raise self.error(code)
        if not elements:
            raise self.error(SoeErrorCode.NO_ELEMENT)
        self._check_protection(state)
        octets = self._checked_list(data) if self.attribute.is_list else self._checked(data)
        if self.procedure is not None:
            try:
                self.procedure.command(int.from_bytes(octets, "little"), now_ns)
            except SoeError as exc:
                raise self.error(exc.code) from None
        if self._write is not None:
            self._write(octets)
        self.octets = octets

    def error(self, code: int) -> SoeError:
        """Return the SoeError of a refused request."""
        return SoeError(f"{self.idn}: {name_of(code)} (0x{code:04X})", code=code)

    def _read_element(self, element: Element, now_ns: int) -> bytes:
        if element is Element.VALUE:
            return self._framed(self.octets if self._read is None else self._read())
        if element is Element.DATA_STATE:
            if self.procedure is None:
                raise self.error(SoeErrorCode.NO_DATA_STATE)
            return self.procedure.state(now_ns).to_bytes(2, "little")
        octets = self._fixed[element]
        if octets is None:
            raise self.error(_MISSING[element])
        return octets

    def _framed(self, octets: bytes) -> bytes:
        if not self.attribute.is_list:
            return octets
        return encode_list(octets, max(self.max_length, len(octets)))

    def _check_protection(self, state: OdState) -> None:
        attribute = self.attribute
        protected = {
            OdState.PREOP: attribute.protected_preop,
            OdState.SAFEOP: attribute.protected_safeop,
            OdState.OP: attribute.protected_op,
        }
        # Protected in every state is "read only" (0x7004), in some states "protected now" (0x7005).
        if all(protected.values()):
            raise self.error(SoeErrorCode.VALUE_READ_ONLY)
        if protected[state]:
            raise self.error(SoeErrorCode.VALUE_PROTECTED)

    def _checked_list(self, data: bytes) -> bytes:
        try:
            head, octets = decode_list(data)
        except CodecError:
            raise self.error(SoeErrorCode.VALUE_TOO_SHORT) from None
        if head.length > self.max_length or len(data) > len(encode_list(octets)):
            raise self.error(SoeErrorCode.VALUE_TOO_LONG)
        if self.attribute.display != Display.TEXT:
            if len(octets) % self.attribute.size:
                raise self.error(SoeErrorCode.INVALID_VALUE)
            self._check_limits(octets)
        return octets

    def _checked(self, data: bytes) -> bytes:
        if len(data) < self.attribute.size:
            raise self.error(SoeErrorCode.VALUE_TOO_SHORT)
        if len(data) > self.attribute.size:
            raise self.error(SoeErrorCode.VALUE_TOO_LONG)
        self._check_limits(data)
        return data

    def _check_limits(self, octets: bytes) -> None:
        minimum, maximum = self.limits
        for at in range(0, len(octets), self.attribute.size):
            number = decode_scalar(self.attribute, octets[at:])
            if minimum is not None and number < minimum:
                raise self.error(SoeErrorCode.BELOW_MINIMUM)
            if maximum is not None and number > maximum:
                raise self.error(SoeErrorCode.ABOVE_MAXIMUM)


MAX_PENDING = 16
"""Limit for queued notifications and emergencies; further ones are dropped and counted."""
FRAGMENT_TIMEOUT_NS = 2_000_000_000
"""Time-out for the next fragment of a write; the fragments before it are discarded then."""
LIST_OF_ALL = "S-0-0017"
_MAX_WRITTEN = MAX_LENGTH + ListHead.SIZE
_RESPONSE = {
    SoeOpcode.READ_REQUEST: SoeOpcode.READ_RESPONSE,
    SoeOpcode.WRITE_REQUEST: SoeOpcode.WRITE_RESPONSE,
}


class _PendingWrite:
    """Fragments of a write received so far."""

    __slots__ = ("content", "deadline_ns", "drive", "elements", "left")

    def __init__(self, header: SoeHeader) -> None:
        self.drive = header.drive
        self.elements = header.elements
        self.left = header.idn + 1
        self.content = bytearray()
        self.deadline_ns = 0

    def add(self, header: SoeHeader, body: bytes, now_ns: int) -> None:
        """Add a fragment; data beyond the longest list is counted and not stored."""
        self.left = header.idn
        # One byte beyond the limit is kept, so that the excess is noticed at the end.
        self.content += body[: _MAX_WRITTEN + 1 - len(self.content)]
        self.deadline_ns = now_ns + FRAGMENT_TIMEOUT_NS


class SoeServer:
    """SoE protocol of a slave.

    Args:
        drives: IDNs of each drive by its number from 0 to 7; the list of all of them,
            S-0-0017, is added.
        state: Returns the present state of the slave.
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
        self._partial: _PendingWrite | None = None
        self._running: dict[tuple[int, int], SoeParameter] = {}
        self._pending: deque[bytes] = deque()
        self.dropped = 0
        """Number of notifications and emergencies lost because the queue was full."""

    def reset(self) -> None:
        """Discard fragments and queued messages; procedure commands continue."""
        self._partial = None
        self._running.clear()
        self._pending.clear()

    def receive_message(self, data: bytes, now_ns: int) -> list[bytes]:
        """Handle a message (without mailbox header) and return the fragments of its answer."""
        header = decode_or_error(SoeHeader.decode, data)
        if header.opcode not in _RESPONSE:
            raise_mailbox_error(MailboxError.SERVICE_NOT_SUPPORTED, f"opcode {header.opcode.name}")
        body = data[SoeHeader.SIZE :]
        if header.opcode is SoeOpcode.WRITE_REQUEST:
            joined = self._join(header, body, now_ns)
            if joined is None:
                return []
            body = joined
        else:
            self._partial = None
        fragment_size = self._sizes.to_master - DATA_OVERHEAD
        error = False
        try:
            answer = self._answer(header, body, now_ns)
        except SoeError as exc:
            # An error code replaces the data: it is the last two bytes of the answer.
            error, answer = True, exc.code.to_bytes(2, "little")
        opcode = _RESPONSE[header.opcode]
        head = SoeHeader(opcode, 0, error, header.drive, header.elements, header.idn)
        return encode_fragments(head, answer, fragment_size)

    def messages_to_send(self, now_ns: int) -> list[bytes]:
        """Return and remove queued emergencies and notifications of ended procedure commands."""
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
        """Queue a notification with the data state of a procedure command."""
        data = state.to_bytes(2, "little")
        self._push(SoeOpcode.NOTIFICATION, drive, idn.number, data, Element.DATA_STATE)

    def send_emergency(
        self, error_code: int, register: int = 0, data: bytes = b"", *, drive: int = 0
    ) -> None:
        """Queue an emergency of a drive; *data* is up to five vendor bytes."""
        emergency = Emergency(error_code, register, data.ljust(5, b"\0"))
        self._push(SoeOpcode.EMERGENCY, drive, 0, emergency.encode(), 0)

    def _push(self, opcode: SoeOpcode, drive: int, idn: int, body: bytes, elements: int) -> None:
        if len(self._pending) >= MAX_PENDING:
            self.dropped += 1
            return
        message = encode_message(opcode, idn, body, drive=drive, elements=elements)
        self._pending.append(message)

    def _join(self, header: SoeHeader, body: bytes, now_ns: int) -> bytes | None:
        """Return the complete content of a write, or None while fragments are missing."""
        partial = self._partial
        if partial is not None and not self._continues(partial, header, body, now_ns):
            partial = None
        if header.incomplete:
            self._partial = partial or _PendingWrite(header)
            self._partial.add(header, body, now_ns)
            return None
        self._partial = None
        if partial is None:
            return body
        partial.add(header, body, now_ns)
        return bytes(partial.content)

    def _continues(
        self, partial: _PendingWrite, header: SoeHeader, body: bytes, now_ns: int
    ) -> bool:
        if now_ns > partial.deadline_ns:
            return False
        if (header.drive, header.elements) != (partial.drive, partial.elements):
            return False
        if header.incomplete:
            return header.idn < partial.left
        # SOEM counts total / room fragments left: one too many if the last fragment is full.
        is_full = len(body) == self._sizes.to_slave - DATA_OVERHEAD
        return partial.left == 1 or (partial.left == 2 and is_full)

    def _answer(self, header: SoeHeader, body: bytes, now_ns: int) -> bytes:
        parameter = self._find(header.drive, header.idn)
        if header.opcode is SoeOpcode.READ_REQUEST:
            return parameter.read(header.elements, now_ns)
        if len(body) > _MAX_WRITTEN:
            raise parameter.error(SoeErrorCode.VALUE_TOO_LONG)
        parameter.write(header.elements, body, self._state(), now_ns)
        if parameter.procedure is not None:
            self._running[header.drive, header.idn] = parameter
        return b""

    def _find(self, drive: int, number: int) -> SoeParameter:
        if drive not in self.drives:
            raise _command_error(SoeErrorCode.INVALID_DRIVE)
        try:
            return self.drives[drive][number]
        except KeyError:
            raise _command_error(SoeErrorCode.NO_IDN) from None


def _with_list(items: Iterable[SoeParameter]) -> dict[int, SoeParameter]:
    parameters = {item.idn.number: item for item in items}

    def listed() -> bytes:
        return b"".join(number.to_bytes(2, "little") for number in sorted(parameters))

    protected = {"protected_preop": 1, "protected_safeop": 1, "protected_op": 1}
    attribute = SoeAttribute(length=1, is_list=1, display=Display.IDN, **protected)
    whole = SoeParameter(LIST_OF_ALL, "IDN list of all operation data", attribute, read=listed)
    parameters.setdefault(whole.idn.number, whole)
    return parameters
