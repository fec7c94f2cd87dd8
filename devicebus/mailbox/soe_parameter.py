"""One IDN of a simulated drive: its elements, and what may be read and written of them.

A parameter refuses with SoeError; only its value (element 7) can be written.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

from devicebus.errors import SoeError
from devicebus.mailbox.soe_procedure import Procedure
from eap.codec.soe import Display, Element, Idn, SoeAttribute, decode_list, encode_list
from eap.codec.soeerror import SoeErrorCode, name_of
from eap.codec.soevalue import SoeScalar, decode_scalar, encode_scalar, encode_value
from eap.errors import CodecError
from eap.od.model import OdState

MAX_LENGTH = 0xFFFF
"""Octets of the longest list: its head has 16 bits for them."""
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
    """One IDN.

    Args:
        idn: Its number as text, such as ``S-0-0032``.
        name: Element 2; empty means that it has none.
        attribute: Element 3: type, length and protection of the value.
        value: What it starts with, and its default.
        unit: Element 4.
        limits: Elements 5 and 6, each None if there is none; checked on writing.
        max_length: Octets to which a list may grow; those it starts with if left out.
        read: Where the octets of the value come from instead of being stored (a list without its
            head).
        write: Called with them before they are stored; refuses with SoeError.
        procedure: What the IDN does, if it is a procedure command.
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
        procedure: Procedure | None = None,
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
        """Return the elements asked for, one behind the other; raise SoeError if one is missing."""
        asked = [element for element in Element if elements & element]
        if not asked:
            raise self.refusal(SoeErrorCode.NO_ELEMENT)
        return b"".join(self._read_element(element, now_ns) for element in asked)

    def write(self, elements: int, data: bytes, state: OdState, now_ns: int) -> None:
        """Write the value; raise SoeError if it is refused, or another element is meant."""
        for element, code in _READ_ONLY.items():
            if elements & element:
                raise self.refusal(code)
        if not elements:
            raise self.refusal(SoeErrorCode.NO_ELEMENT)
        self._check_protection(state)
        octets = self._checked_list(data) if self.attribute.is_list else self._checked(data)
        if self.procedure is not None:
            try:
                self.procedure.command(int.from_bytes(octets, "little"), now_ns)
            except SoeError as exc:
                raise self.refusal(exc.code) from None
        if self._write is not None:
            self._write(octets)
        self.octets = octets

    def refusal(self, code: int) -> SoeError:
        """Make the error with which the drive refuses."""
        return SoeError(f"{self.idn}: {name_of(code)} (0x{code:04X})", code=code)

    def _read_element(self, element: Element, now_ns: int) -> bytes:
        if element is Element.VALUE:
            return self._framed(self.octets if self._read is None else self._read())
        if element is Element.DATA_STATE:
            if self.procedure is None:
                raise self.refusal(SoeErrorCode.NO_DATA_STATE)
            return self.procedure.state(now_ns).to_bytes(2, "little")
        octets = self._fixed[element]
        if octets is None:
            raise self.refusal(_MISSING[element])
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
        if all(protected.values()):
            raise self.refusal(SoeErrorCode.VALUE_READ_ONLY)
        if protected[state]:
            raise self.refusal(SoeErrorCode.VALUE_PROTECTED)

    def _checked_list(self, data: bytes) -> bytes:
        try:
            head, octets = decode_list(data)
        except CodecError:
            raise self.refusal(SoeErrorCode.VALUE_TOO_SHORT) from None
        if head.length > self.max_length or len(data) > len(encode_list(octets)):
            raise self.refusal(SoeErrorCode.VALUE_TOO_LONG)
        if self.attribute.display != Display.TEXT:
            if len(octets) % self.attribute.size:
                raise self.refusal(SoeErrorCode.INVALID_VALUE)
            self._check_limits(octets)
        return octets

    def _checked(self, data: bytes) -> bytes:
        if len(data) < self.attribute.size:
            raise self.refusal(SoeErrorCode.VALUE_TOO_SHORT)
        if len(data) > self.attribute.size:
            raise self.refusal(SoeErrorCode.VALUE_TOO_LONG)
        self._check_limits(data)
        return data

    def _check_limits(self, octets: bytes) -> None:
        minimum, maximum = self.limits
        for at in range(0, len(octets), self.attribute.size):
            number = decode_scalar(self.attribute, octets[at:])
            if minimum is not None and number < minimum:
                raise self.refusal(SoeErrorCode.BELOW_MINIMUM)
            if maximum is not None and number > maximum:
                raise self.refusal(SoeErrorCode.ABOVE_MAXIMUM)
