from __future__ import annotations

import pytest

from devicebus.errors import SoeError
from devicebus.mailbox.soe_parameter import SoeParameter
from devicebus.mailbox.soe_procedure import Procedure
from eap.codec.soe import Display, Element, SoeAttribute
from eap.codec.soeerror import SoeErrorCode
from eap.od.model import OdState

PREOP, SAFEOP, OP = OdState.PREOP, OdState.SAFEOP, OdState.OP
SIGNED = SoeAttribute(length=2, display=Display.SIGNED)
LIST = SoeAttribute(length=1, is_list=1, display=Display.IDN)


def speed(**options: object) -> SoeParameter:
    return SoeParameter(
        "S-0-0036", "Velocity", SIGNED, -5, unit="rpm", limits=(-100, 200), **options
    )


def code_of(call: object, *arguments: object) -> SoeErrorCode:
    with pytest.raises(SoeError) as caught:
        call(*arguments)  # type: ignore[operator]
    return SoeErrorCode(caught.value.code)


def number(value: int) -> bytes:
    return value.to_bytes(4, "little", signed=True)


@pytest.mark.parametrize(
    ("element", "octets"),
    [
        (Element.NAME, "0800 0800 56656c6f63697479"),
        (Element.ATTRIBUTE, "0100 2200"),
        (Element.UNIT, "0300 0300 72706d"),
        (Element.MINIMUM, "9cffffff"),
        (Element.MAXIMUM, "c8000000"),
        (Element.VALUE, "fbffffff"),
        (Element.DEFAULT, "fbffffff"),
        (Element.VALUE | Element.UNIT | Element.MINIMUM, "0300 0300 72706d 9cffffff fbffffff"),
    ],
)
def test_elements(element: int, octets: str) -> None:
    assert speed().read(element, 0) == bytes.fromhex(octets)


@pytest.mark.parametrize(
    ("element", "code"),
    [
        (0, "NO_ELEMENT"),
        (Element.DATA_STATE, "NO_DATA_STATE"),
        (Element.NAME, "NO_NAME"),
        (Element.UNIT, "NO_UNIT"),
        (Element.MINIMUM, "NO_MINIMUM"),
        (Element.MAXIMUM, "NO_MAXIMUM"),
        (Element.VALUE | Element.MAXIMUM, "NO_MAXIMUM"),
    ],
)
def test_element_that_is_not_there(element: int, code: str) -> None:
    assert code_of(SoeParameter("P-0-0001", "", SIGNED).read, element, 0).name == code


def test_value_is_written_and_default_stays() -> None:
    parameter = speed()
    parameter.write(Element.VALUE, number(200), PREOP, 0)
    assert parameter.read(Element.VALUE, 0) == number(200)
    assert parameter.read(Element.DEFAULT, 0) == number(-5)


@pytest.mark.parametrize(
    ("element", "data", "code"),
    [
        (0, bytes(4), "NO_ELEMENT"),
        (Element.DATA_STATE, bytes(2), "ELEMENT_1_ACCESS"),
        (Element.NAME, b"x", "NAME_READ_ONLY"),
        (Element.ATTRIBUTE, bytes(4), "ATTRIBUTE_READ_ONLY"),
        (Element.UNIT, b"x", "UNIT_READ_ONLY"),
        (Element.MINIMUM, bytes(4), "MINIMUM_READ_ONLY"),
        (Element.MAXIMUM, bytes(4), "MAXIMUM_READ_ONLY"),
        (Element.DEFAULT, bytes(4), "DEFAULT_READ_ONLY"),
        (Element.VALUE | Element.UNIT, bytes(4), "UNIT_READ_ONLY"),
        (Element.VALUE, bytes(3), "VALUE_TOO_SHORT"),
        (Element.VALUE, bytes(5), "VALUE_TOO_LONG"),
        (Element.VALUE, number(-101), "BELOW_MINIMUM"),
        (Element.VALUE, number(201), "ABOVE_MAXIMUM"),
    ],
)
def test_write_that_is_refused(element: int, data: bytes, code: str) -> None:
    parameter = speed()
    assert code_of(parameter.write, element, data, PREOP, 0).name == code
    assert parameter.read(Element.VALUE, 0) == number(-5)


def test_protection_depends_on_the_state() -> None:
    attribute = SoeAttribute(protected_safeop=1, protected_op=1)
    parameter = SoeParameter("S-0-0001", "Cycle time", attribute)
    parameter.write(Element.VALUE, number(7), PREOP, 0)
    for state in (SAFEOP, OP):
        code = code_of(parameter.write, Element.VALUE, number(8), state, 0)
        assert code is SoeErrorCode.VALUE_PROTECTED
    attribute = SoeAttribute(protected_preop=1, protected_safeop=1, protected_op=1)
    parameter = SoeParameter("S-0-0030", "Version", attribute)
    code = code_of(parameter.write, Element.VALUE, number(8), PREOP, 0)
    assert code is SoeErrorCode.VALUE_READ_ONLY


def test_list_has_a_head() -> None:
    parameter = SoeParameter("S-0-0016", "AT list", LIST, [40, 51], max_length=8)
    assert parameter.read(Element.VALUE, 0) == bytes.fromhex("0400 0800 2800 3300")
    parameter.write(Element.VALUE, bytes.fromhex("0600 0600 010002000300"), PREOP, 0)
    assert parameter.read(Element.VALUE, 0) == bytes.fromhex("0600 0800 010002000300")
    assert parameter.read(Element.DEFAULT, 0) == bytes.fromhex("0400 0800 2800 3300")


@pytest.mark.parametrize(
    ("octets", "code"),
    [
        ("0400", "VALUE_TOO_SHORT"),
        ("0400 0400 0100", "VALUE_TOO_SHORT"),
        ("0a00 0a00 01000200030004000500", "VALUE_TOO_LONG"),
        ("0200 0200 01000200", "VALUE_TOO_LONG"),
        ("0300 0300 010002", "INVALID_VALUE"),
        ("0400 0400 01006400", "ABOVE_MAXIMUM"),
    ],
)
def test_list_that_is_refused(octets: str, code: str) -> None:
    parameter = SoeParameter("S-0-0016", "", LIST, [1], max_length=8, limits=(None, 99))
    write = (Element.VALUE, bytes.fromhex(octets), PREOP, 0)
    assert code_of(parameter.write, *write).name == code


def test_text_is_a_list_of_octets() -> None:
    text = SoeAttribute(length=0, is_list=1, display=Display.TEXT)
    parameter = SoeParameter("S-0-0140", "Type", text, "AX", max_length=4)
    assert parameter.read(Element.VALUE, 0) == bytes.fromhex("0200 0400 4158")
    parameter.write(Element.VALUE, bytes.fromhex("0300 0300 414241"), OP, 0)
    assert parameter.octets == b"ABA"


def test_empty_list() -> None:
    parameter = SoeParameter("S-0-0016", "", LIST, max_length=4)
    assert parameter.read(Element.VALUE, 0) == bytes.fromhex("0000 0400")


def test_hooks_read_and_check_the_octets() -> None:
    def check(octets: bytes) -> None:
        if octets == number(3):
            raise SoeError("not 3", code=SoeErrorCode.OTHER_SETTINGS)

    parameter = speed(read=lambda: number(77), write=check)
    assert parameter.read(Element.VALUE, 0) == number(77)
    assert code_of(parameter.write, Element.VALUE, number(3), OP, 0).name == "OTHER_SETTINGS"
    parameter.write(Element.VALUE, number(4), OP, 0)
    assert parameter.octets == number(4)


def test_procedure_command_has_a_data_state() -> None:
    attribute = SoeAttribute(length=1, is_command=1, display=Display.BINARY)
    parameter = SoeParameter("S-0-0099", "Reset", attribute, procedure=Procedure(duration_ns=9))
    assert parameter.read(Element.DATA_STATE, 0) == bytes(2)
    parameter.write(Element.VALUE, b"\3\0", OP, 0)
    assert parameter.read(Element.DATA_STATE, 8) == b"\7\0"
    assert parameter.read(Element.DATA_STATE, 9) == b"\3\0"
    code = code_of(parameter.write, Element.VALUE, b"\3\0", OP, 9)
    assert code is SoeErrorCode.COMMAND_ACTIVE
    assert parameter.read(Element.VALUE, 9) == b"\3\0"


def test_refusal_names_the_idn() -> None:
    with pytest.raises(SoeError, match=r"P-0-0001: no unit \(0x4001\)"):
        SoeParameter("P-0-0001", "", SIGNED).read(Element.UNIT, 0)
