"""What a person wants to know of a drive's IDNs: which there are, and all about one of them."""

from __future__ import annotations

import msgspec

from devicebus.errors import SoeError
from devicebus.mailbox import soe_client
from devicebus.mailbox.conversation import Conversation, reading
from eap.codec.soe import Element, Idn, SoeAttribute, decode_list
from eap.codec.soevalue import SoeScalar, SoeValue, decode_scalar, decode_value

LIST_OF_ALL = Idn.parse("S-0-0017")
_IDNS = SoeAttribute(length=1, is_list=1)


class IdnDescription(msgspec.Struct, frozen=True):
    """One IDN with the elements that it has; None for those it has not."""

    idn: Idn
    attribute: SoeAttribute
    value: SoeValue
    name: str | None = None
    unit: str | None = None
    minimum: SoeScalar | None = None
    maximum: SoeScalar | None = None
    default: SoeValue | None = None
    data_state: int | None = None
    """Of a procedure command; other IDNs usually have none."""


def idn_list(idn: Idn = LIST_OF_ALL, *, drive: int = 0) -> Conversation[list[Idn]]:
    """Read a list of IDNs, such as that of all of them; raises as soe_client.read() does."""
    octets = yield from soe_client.read(idn, drive=drive)
    with reading(f"IDN list {idn}"):
        _, numbers = decode_list(octets)
        return [Idn.of(int(decode_scalar(_IDNS, numbers[at:]))) for at in range(0, len(numbers), 2)]


def describe(idn: Idn, *, drive: int = 0) -> Conversation[IdnDescription]:
    """Read everything about an IDN, one element at a time; raises as soe_client.read() does.

    An element that the drive refuses is missing, except attribute and value.
    """
    octets = yield from soe_client.read(idn, Element.ATTRIBUTE, drive=drive)
    with reading(f"attribute of {idn}"):
        attribute = SoeAttribute.decode(octets)
    value = yield from soe_client.read(idn, drive=drive)
    name = yield from _read_if_any(idn, Element.NAME, drive)
    unit = yield from _read_if_any(idn, Element.UNIT, drive)
    minimum = yield from _read_if_any(idn, Element.MINIMUM, drive)
    maximum = yield from _read_if_any(idn, Element.MAXIMUM, drive)
    default = yield from _read_if_any(idn, Element.DEFAULT, drive)
    state = yield from _read_if_any(idn, Element.DATA_STATE, drive)
    with reading(f"elements of {idn}"):
        return IdnDescription(
            idn,
            attribute,
            decode_value(attribute, value),
            _text(name),
            _text(unit),
            None if minimum is None else decode_scalar(attribute, minimum),
            None if maximum is None else decode_scalar(attribute, maximum),
            None if default is None else decode_value(attribute, default),
            None if state is None else int.from_bytes(state, "little"),
        )


def _read_if_any(idn: Idn, element: Element, drive: int) -> Conversation[bytes | None]:
    try:
        return (yield from soe_client.read(idn, element, drive=drive))
    except SoeError:
        return None


def _text(octets: bytes | None) -> str | None:
    return None if octets is None else decode_list(octets)[1].rstrip(b"\0").decode(errors="replace")
