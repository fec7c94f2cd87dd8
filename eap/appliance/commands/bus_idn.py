"""IDNs of drives as plain data: read, written, listed."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import msgspec

from devicebus.errors import SoeError
from devicebus.mailbox import soe_browse, soe_client
from devicebus.mailbox.conversation import Conversation, reading
from devicebus.mailbox.protocol import MailboxSizes
from eap.appliance.commands.bus_slave import Slave, SlaveBus
from eap.codec.soe import Display, Element, Idn, SoeAttribute, decode_list
from eap.codec.soevalue import SoeScalar, SoeValue, encode_value
from eap.errors import ConfigError


def read_idn(bus: SlaveBus, slave: str, idn: Idn, *, drive: int) -> dict[str, Any]:
    """Return an IDN with all elements that it has.

    Raises:
        SoeError: the drive refuses.
        BusError: there is no such slave, or it does not answer.
    """
    unit = bus.find(slave)
    found = bus.converse(unit, lambda _: soe_browse.describe(idn, drive=drive), str(idn))
    row = msgspec.structs.asdict(found)
    attribute = row.pop("attribute")
    kinds = Display._value2member_map_
    display = attribute.display
    return row | {
        "slave": unit.station,
        "drive": drive,
        "idn": str(idn),
        "display": Display(display).name if display in kinds else str(display),
        "octets": attribute.size,
        "decimals": attribute.decimals,
        "factor": attribute.factor,
        "is_list": bool(attribute.is_list),
        "is_command": bool(attribute.is_command),
        "protected_in": [
            state
            for state, is_protected in (
                ("PREOP", attribute.protected_preop),
                ("SAFEOP", attribute.protected_safeop),
                ("OP", attribute.protected_op),
            )
            if is_protected
        ],
    }


def write_idn(bus: SlaveBus, slave: str, idn: Idn, text: str, *, drive: int) -> dict[str, Any]:
    """Write the value of an IDN; lists are separated by commas.

    Raises:
        ConfigError: *text* is no value of this IDN.
        SoeError: the drive refuses.
        BusError: there is no such slave, or it does not answer.
    """
    unit = bus.find(slave)

    def conversation(sizes: MailboxSizes) -> Conversation[SoeValue]:
        octets = yield from soe_client.read(idn, Element.ATTRIBUTE, drive=drive)
        with reading(f"attribute of {idn}"):
            attribute = SoeAttribute.decode(octets)
        value = _parse(attribute, text, idn)
        yield from soe_client.write(idn, _encode(attribute, value, idn), sizes, drive=drive)
        return value

    value = bus.converse(unit, conversation, str(idn))
    return {"slave": unit.station, "drive": drive, "idn": str(idn), "value": value}


def list_idns(bus: SlaveBus, slave: str, *, drive: int) -> Iterator[dict[str, Any]]:
    """Yield every IDN of a drive with its name; raises as read_idn() does."""
    unit = bus.find(slave)
    for idn in bus.converse(unit, lambda _: soe_browse.idn_list(drive=drive), "list of IDNs"):
        yield {"idn": str(idn), "number": idn.number, "name": _name(bus, unit, idn, drive)}


def _name(bus: SlaveBus, unit: Slave, idn: Idn, drive: int) -> str:
    return bus.converse(unit, lambda _: _read_name(idn, drive), str(idn))


def _read_name(idn: Idn, drive: int) -> Conversation[str]:
    try:
        octets = yield from soe_client.read(idn, Element.NAME, drive=drive)
    except SoeError:
        return ""
    with reading(f"name of {idn}"):
        return decode_list(octets)[1].rstrip(b"\0").decode(errors="replace")


def _parse(attribute: SoeAttribute, text: str, idn: Idn) -> SoeValue:
    if attribute.display == Display.TEXT:
        return text
    try:
        if not attribute.is_list:
            return _number(attribute, text)
        words = [word for word in text.split(",") if word.strip()]
        values: list[int] | list[float] = [_number(attribute, word) for word in words]
    except ValueError:
        expected = "numbers with commas between" if attribute.is_list else "a number"
        raise ConfigError(f"{idn}: {text!r} is no value of it, expected {expected}") from None
    return values


def _number(attribute: SoeAttribute, text: str) -> SoeScalar:
    if attribute.display == Display.FLOAT:
        return float(text)
    if attribute.display == Display.IDN and "-" in text.strip()[1:]:
        return Idn.parse(text).number
    return int(text, 0)


def _encode(attribute: SoeAttribute, value: SoeValue, idn: Idn) -> bytes:
    try:
        return encode_value(attribute, value)
    except ValueError as exc:
        raise ConfigError(f"{idn}: {exc}") from None
