"""Requests and answers byte for byte; mailboxes have room for 6 bytes of data."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from devicebus.errors import MailboxRefusedError, SoeError
from devicebus.mailbox.protocol import MailboxSizes
from devicebus.mailbox.soe_server import (
    FRAGMENT_TIMEOUT_NS,
    MAX_PENDING,
    ProcedureCommand,
    SoeParameter,
    SoeServer,
)
from eap.codec.mailbox import MailboxError
from eap.codec.soe import (
    COMMAND_CLEAR,
    COMMAND_START,
    DataState,
    Display,
    Element,
    SoeAttribute,
    SoeErrorCode,
)
from eap.od.model import OdState


def code_of(procedure: ProcedureCommand, value: int, now_ns: int) -> SoeErrorCode:
    with pytest.raises(SoeError) as caught:
        procedure.command(value, now_ns)
    return SoeErrorCode(caught.value.code)


def test_life_of_a_command() -> None:
    procedure = ProcedureCommand(duration_ns=100)
    assert procedure.state(0) == 0
    procedure.command(COMMAND_START, 10)
    assert procedure.state(109) == DataState.BUSY == 0x0007
    assert code_of(procedure, COMMAND_START, 109) is SoeErrorCode.COMMAND_ACTIVE
    assert procedure.state(110) == DataState.DONE == 0x0003
    assert code_of(procedure, COMMAND_START, 111) is SoeErrorCode.COMMAND_ACTIVE
    procedure.command(COMMAND_CLEAR, 112)
    assert procedure.state(112) == 0
    procedure.command(COMMAND_START, 113)
    assert procedure.state(113) == DataState.BUSY


def test_hooks_run_once_at_start_and_end() -> None:
    seen: list[str] = []
    procedure = ProcedureCommand(
        duration_ns=5,
        start=lambda: seen.append("start"),
        finish=lambda: bool(seen.append("finish")) or True,
    )
    procedure.command(COMMAND_START, 0)
    for now_ns in (0, 4, 5, 6):
        procedure.state(now_ns)
    assert seen == ["start", "finish"]


def test_command_that_does_not_succeed_has_failed() -> None:
    procedure = ProcedureCommand(finish=lambda: False)
    procedure.command(COMMAND_START, 0)
    assert procedure.state(0) == DataState.FAILED == 0x000F
    procedure.command(COMMAND_CLEAR, 0)
    assert procedure.state(0) == 0


def test_procedure_command_start_refused() -> None:
    def refuse() -> None:
        raise SoeError("no power", code=SoeErrorCode.COMMAND_NOT_NOW)

    procedure = ProcedureCommand(start=refuse)
    assert code_of(procedure, COMMAND_START, 0) is SoeErrorCode.COMMAND_NOT_NOW
    assert procedure.state(0) == 0


@pytest.mark.parametrize("is_interruptible", [True, False])
def test_procedure_command_cleared_during_execution(is_interruptible: bool) -> None:
    procedure = ProcedureCommand(duration_ns=9, is_interruptible=is_interruptible)
    procedure.command(COMMAND_START, 0)
    if is_interruptible:
        procedure.command(COMMAND_CLEAR, 1)
        assert procedure.state(99) == 0
    else:
        assert code_of(procedure, COMMAND_CLEAR, 1) is SoeErrorCode.COMMAND_NOT_INTERRUPTIBLE
        assert procedure.state(9) == DataState.DONE


@pytest.mark.parametrize("value", [1, 2, 7, 0xFFFF])
def test_other_values_are_invalid(value: int) -> None:
    assert code_of(ProcedureCommand(), value, 0) is SoeErrorCode.INVALID_VALUE


PREOP, SAFEOP, OP = OdState.PREOP, OdState.SAFEOP, OdState.OP
SIGNED = SoeAttribute(length=2, display=Display.SIGNED)
LIST = SoeAttribute(length=1, is_list=1, display=Display.IDN)


def speed(**options: object) -> SoeParameter:
    return SoeParameter(
        "S-0-0036", "Velocity", SIGNED, -5, unit="rpm", limits=(-100, 200), **options
    )


def refusal_of(call: object, *arguments: object) -> SoeErrorCode:
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
def test_soe_parameter_has_its_elements(element: int, octets: str) -> None:
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
def test_soe_parameter_refuses_missing_elements(element: int, code: str) -> None:
    assert refusal_of(SoeParameter("P-0-0001", "", SIGNED).read, element, 0).name == code


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
def test_soe_parameter_refuses_writes(element: int, data: bytes, code: str) -> None:
    parameter = speed()
    assert refusal_of(parameter.write, element, data, PREOP, 0).name == code
    assert parameter.read(Element.VALUE, 0) == number(-5)


def test_protection_depends_on_the_state() -> None:
    attribute = SoeAttribute(protected_safeop=1, protected_op=1)
    parameter = SoeParameter("S-0-0001", "Cycle time", attribute)
    parameter.write(Element.VALUE, number(7), PREOP, 0)
    for state in (SAFEOP, OP):
        code = refusal_of(parameter.write, Element.VALUE, number(8), state, 0)
        assert code is SoeErrorCode.VALUE_PROTECTED
    attribute = SoeAttribute(protected_preop=1, protected_safeop=1, protected_op=1)
    parameter = SoeParameter("S-0-0030", "Version", attribute)
    code = refusal_of(parameter.write, Element.VALUE, number(8), PREOP, 0)
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
def test_soe_parameter_refuses_lists(octets: str, code: str) -> None:
    parameter = SoeParameter("S-0-0016", "", LIST, [1], max_length=8, limits=(None, 99))
    write = (Element.VALUE, bytes.fromhex(octets), PREOP, 0)
    assert refusal_of(parameter.write, *write).name == code


def test_text_is_a_list_of_octets() -> None:
    text = SoeAttribute(length=0, is_list=1, display=Display.TEXT)
    parameter = SoeParameter("S-0-0140", "Type", text, "AX", max_length=4)
    assert parameter.read(Element.VALUE, 0) == bytes.fromhex("0200 0400 4158")
    parameter.write(Element.VALUE, bytes.fromhex("0300 0300 414241"), OP, 0)
    assert parameter.octets == b"ABA"


def test_soe_parameter_reads_empty_list() -> None:
    parameter = SoeParameter("S-0-0016", "", LIST, max_length=4)
    assert parameter.read(Element.VALUE, 0) == bytes.fromhex("0000 0400")


def test_hooks_read_and_check_the_octets() -> None:
    def check(octets: bytes) -> None:
        if octets == number(3):
            raise SoeError("not 3", code=SoeErrorCode.OTHER_SETTINGS)

    parameter = speed(read=lambda: number(77), write=check)
    assert parameter.read(Element.VALUE, 0) == number(77)
    assert refusal_of(parameter.write, Element.VALUE, number(3), OP, 0).name == "OTHER_SETTINGS"
    parameter.write(Element.VALUE, number(4), OP, 0)
    assert parameter.octets == number(4)


def test_procedure_command_has_a_data_state() -> None:
    attribute = SoeAttribute(length=1, is_command=1, display=Display.BINARY)
    parameter = SoeParameter(
        "S-0-0099", "Reset", attribute, procedure=ProcedureCommand(duration_ns=9)
    )
    assert parameter.read(Element.DATA_STATE, 0) == bytes(2)
    parameter.write(Element.VALUE, b"\3\0", OP, 0)
    assert parameter.read(Element.DATA_STATE, 8) == b"\7\0"
    assert parameter.read(Element.DATA_STATE, 9) == b"\3\0"
    code = refusal_of(parameter.write, Element.VALUE, b"\3\0", OP, 9)
    assert code is SoeErrorCode.COMMAND_ACTIVE
    assert parameter.read(Element.VALUE, 9) == b"\3\0"


def test_soe_parameter_error_names_the_idn() -> None:
    with pytest.raises(SoeError, match=r"P-0-0001: no unit \(0x4001\)"):
        SoeParameter("P-0-0001", "", SIGNED).read(Element.UNIT, 0)


NUMBER = SoeAttribute(length=2, protected_op=1)
COMMAND = SoeAttribute(length=1, is_command=1, display=Display.BINARY)


class Drive:
    def __init__(self) -> None:
        self.list = SoeParameter("S-0-0016", "AT list", LIST, max_length=40)
        self.number = SoeParameter("S-0-0032", "Mode", NUMBER, 11)
        reset = SoeParameter(
            "S-0-0099", "Reset", COMMAND, procedure=ProcedureCommand(duration_ns=9)
        )
        self.state = OdState.PREOP
        self.server = SoeServer(
            {0: [self.list, self.number, reset], 3: [SoeParameter("P-0-0001", "x", NUMBER, 3)]},
            lambda: self.state,
            MailboxSizes(16, 16),
        )

    def ask(self, octets: str, now_ns: int = 0) -> list[str]:
        answers = self.server.receive_message(bytes.fromhex(octets), now_ns)
        return [answer.hex(" ") for answer in answers]

    def unasked(self, now_ns: int = 0) -> list[str]:
        return [message.hex(" ") for message in self.server.messages_to_send(now_ns)]


def test_value_is_read_and_written() -> None:
    drive = Drive()
    assert drive.ask("01 40 2000") == ["02 40 20 00 0b 00 00 00"]
    assert drive.ask("03 40 2000 0c000000") == ["04 40 20 00"]
    assert drive.ask("01 40 2000") == ["02 40 20 00 0c 00 00 00"]
    assert drive.ask("61 40 0180") == ["62 40 01 80 03 00 00 00"]


@pytest.mark.parametrize(
    ("asked", "answer"),
    [
        ("01 40 2100", "12 40 21 00 01 10"),
        ("21 40 2000", "32 40 20 00 0a 80"),
        ("01 00 2000", "12 00 20 00 0c 80"),
        ("01 01 2000", "12 01 20 00 14 70"),
        ("03 40 2000 0c00", "14 40 20 00 02 70"),
        ("03 02 2000 0c00", "14 02 20 00 04 20"),
    ],
)
def test_soe_server_refusal(asked: str, answer: str) -> None:
    assert Drive().ask(asked) == [answer]


def test_state_of_the_slave_counts() -> None:
    drive = Drive()
    drive.state = OdState.OP
    assert drive.ask("03 40 2000 0c000000") == ["14 40 20 00 05 70"]


def test_soe_server_long_answer_fragments_count_down() -> None:
    drive = Drive()
    drive.list.octets = bytes(range(10))
    assert drive.ask("01 40 1000") == [
        "0a 40 02 00 0a 00 28 00 00 01",
        "0a 40 01 00 02 03 04 05 06 07",
        "02 40 10 00 08 09",
    ]


def test_list_of_all_idns_is_there() -> None:
    drive = Drive()
    assert drive.ask("61 40 1100") == ["6a 40 01 00 04 00 04 00 11 00", "62 40 11 00 01 80"]
    listed = drive.server.drives[0][17].read(0x40, 0)
    assert listed == bytes.fromhex("0800 0800 1000 1100 2000 6300")


def test_fragments_of_a_write_are_joined() -> None:
    drive = Drive()
    assert drive.ask("0b 40 0100 040004000100") == []
    assert drive.ask("03 40 1000 0200") == ["04 40 10 00"]
    assert drive.list.octets == bytes.fromhex("01000200")


def test_soe_server_accepts_fragments_counted_as_soem_does() -> None:
    drive = Drive()
    assert drive.ask("0b 40 0200 080008000100") == []
    assert drive.ask("03 40 1000 020003000400") == ["04 40 10 00"]
    assert drive.list.octets == bytes.fromhex("0100020003000400")


@pytest.mark.parametrize(
    ("before", "now_ns"),
    [
        ("0b 40 0300 060006000100", 0),
        ("2b 40 0100 060006000100", 0),
        ("0b 20 0100 060006000100", 0),
        ("0b 40 0100 060006000100", FRAGMENT_TIMEOUT_NS + 1),
    ],
)
def test_fragments_of_another_write_are_forgotten(before: str, now_ns: int) -> None:
    drive = Drive()
    drive.ask(before)
    assert drive.ask("03 40 1000 020002000700", now_ns) == ["04 40 10 00"]
    assert drive.list.octets == b"\7\0"


def test_soe_server_short_message_does_not_end_an_incomplete_write() -> None:
    drive = Drive()
    assert drive.ask("0b 40 0200 080008000100") == []
    assert drive.ask("03 40 2000 0c000000") == ["04 40 20 00"]


@pytest.mark.parametrize("between", ["01 40 2000", "0b 40 0100 020002000700"])
def test_soe_server_restarted_write_discards_fragments(between: str) -> None:
    drive = Drive()
    drive.ask("0b 40 0100 040004000100")
    drive.ask(between)
    if between.startswith("01"):
        assert drive.ask("03 40 1000 020002000700") == ["04 40 10 00"]
    else:
        assert drive.ask("03 40 1000") == ["04 40 10 00"]
    assert drive.list.octets == b"\7\0"


def test_soe_server_reset_discards_fragments_and_queue() -> None:
    drive = Drive()
    drive.ask("03 40 6300 0300")
    drive.server.send_emergency(1)
    drive.ask("0b 40 0100 040004000100")
    drive.server.reset()
    assert drive.unasked(99) == []
    assert drive.ask("01 01 6300", 99) == ["02 01 63 00 03 00"]
    assert drive.ask("03 40 1000 0200") == ["14 40 10 00 02 70"]


def test_endless_fragments_are_not_kept_and_are_too_long() -> None:
    drive = Drive()
    for left in range(30, 0, -1):
        drive.ask(f"0b 40 {left:02x}00 " + "00" * 3000)
    assert drive.ask("03 40 1000 00") == ["14 40 10 00 03 70"]


def test_procedure_command_ends_with_a_notification() -> None:
    drive = Drive()
    assert drive.ask("03 40 6300 0300", 10) == ["04 40 63 00"]
    assert drive.unasked(18) == []
    assert drive.ask("01 01 6300", 18) == ["02 01 63 00 07 00"]
    assert drive.unasked(19) == ["05 01 63 00 03 00"]
    assert drive.unasked(20) == []
    assert drive.ask("03 40 6300 0000", 21) == ["04 40 63 00"]
    assert drive.unasked(99) == []


def test_soe_server_emergency_as_the_vector() -> None:
    drive = Drive()
    drive.server.send_emergency(0x2310, 3, b"\7", drive=1)
    assert drive.unasked() == ["26 00 00 00 10 23 03 07 00 00 00 00"]


def test_soe_server_drops_and_counts_messages_beyond_the_queue() -> None:
    drive = Drive()
    for code in range(MAX_PENDING + 2):
        drive.server.send_emergency(code)
    assert drive.server.dropped == 2
    assert len(drive.unasked()) == MAX_PENDING


@pytest.mark.parametrize(
    ("octets", "detail"),
    [
        ("01 40 20", MailboxError.SIZE_TOO_SHORT),
        ("02 40 2000", MailboxError.SERVICE_NOT_SUPPORTED),
        ("05 40 2000", MailboxError.SERVICE_NOT_SUPPORTED),
        ("00 40 2000", MailboxError.SERVICE_NOT_SUPPORTED),
    ],
)
def test_soe_server_answers_other_messages_with_a_mailbox_error(
    octets: str, detail: MailboxError
) -> None:
    with pytest.raises(MailboxRefusedError) as caught:
        Drive().ask(octets)
    assert caught.value.detail == detail


def test_drive_number_has_three_bits() -> None:
    with pytest.raises(ValueError, match=r"drives \[8\], expected numbers from 0 to 7"):
        SoeServer({8: []}, lambda: OdState.OP, MailboxSizes())


@given(st.lists(st.tuples(st.binary(max_size=12), st.integers(0, 1 << 33)), max_size=20))
def test_soe_server_any_requests_are_answered_or_refused(requests: list[tuple[bytes, int]]) -> None:
    drive = Drive()
    for request, now_ns in requests:
        try:
            answers = drive.server.receive_message(request, now_ns)
        except MailboxRefusedError:
            continue
        assert all(len(answer) <= 10 for answer in answers)
