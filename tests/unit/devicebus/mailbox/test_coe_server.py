from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from devicebus.errors import MailboxRefusedError
from devicebus.mailbox.coe_server import MAX_PENDING, CoeServer, SdoInfoServer, SdoServer
from devicebus.mailbox.protocol import MailboxSizes
from eap.codec.coe import CoeService, SdoInfoHeader, SdoInfoOpcode, decode_message
from eap.codec.mailbox import MailboxError
from eap.od.abort import AbortCode
from eap.od.dictionary import ObjectDictionary
from eap.od.model import (
    RO,
    RW,
    RW_PREOP,
    WO,
    Access,
    Entry,
    ObjectCode,
    OdObject,
    OdState,
    array,
    record,
    variable,
)


class Slave:
    """An SDO server, asked in hexadecimal behind the CoE header."""

    def __init__(self, to_slave: int = 128, to_master: int = 128) -> None:
        assignment = {0: Entry("Count", "USINT", RW, 0, maximum=4)}
        assignment |= {sub: Entry(f"PDO {sub}", "UINT", RW) for sub in (1, 2, 3, 4)}
        self.dictionary = ObjectDictionary(
            [
                variable(0x1000, "Device type", "UDINT", RO, 0x1389),
                variable(0x1008, "Name", "STRING(40)", RW, "EK1914"),
                variable(0x2000, "Command", "UDINT", WO),
                variable(0x2001, "Small", "UINT", RW, maximum=100),
                variable(0x2002, "Big", "BLOCK(50)", RW_PREOP, bytes(range(50))),
                variable(0x2003, "Empty", "STRING(8)", RO, ""),
                array(0x1C00, "Sync manager type", "USINT", [1, 2, 3, 4]),
                record(0x8000, "Gaps", {1: Entry("a", "UINT"), 3: Entry("c", "UINT")}),
                OdObject(0x1C12, "Assignment", ObjectCode.ARRAY, assignment),
            ]
        )
        self.state = OdState.PREOP
        self.server = SdoServer(
            self.dictionary, lambda: self.state, MailboxSizes(to_slave, to_master)
        )

    def ask(self, octets: str) -> str:
        (answer,) = self.server.receive_request(bytes.fromhex(octets))
        header, body = decode_message(answer)
        assert header.service is (
            CoeService.SDO_REQUEST if body[0] == 0x80 else CoeService.SDO_RESPONSE
        )
        return body.hex(" ")

    def abort_code(self, octets: str) -> AbortCode:
        answer = bytes.fromhex(self.ask(octets))
        assert answer[0] == 0x80
        return AbortCode(int.from_bytes(answer[4:8], "little"))


@pytest.mark.parametrize(
    ("asked", "answer"),
    [
        ("40 0010 00 00000000", "43 00 10 00 89 13 00 00"),
        ("41 0010 00 00000000", "43 00 10 00 89 13 00 00"),
        ("40 0120 00 00000000", "4b 01 20 00 00 00 00 00"),
        ("40 001c 02 00000000", "4f 00 1c 02 02 00 00 00"),
        ("40 0810 00 00000000", "41 08 10 00 06 00 00 00 45 4b 31 39 31 34"),
        ("40 0320 00 00000000", "41 03 20 00 00 00 00 00"),
        ("50 001c 00 00000000", "51 00 1c 00 06 00 00 00 04 00 01 02 03 04"),
        ("50 001c 01 00000000", "53 00 1c 01 01 02 03 04"),
        ("50 121c 00 00000000", "5b 12 1c 00 00 00 00 00"),
    ],
)
def test_coe_server_answers_upload(asked: str, answer: str) -> None:
    assert Slave().ask(asked) == answer


@pytest.mark.parametrize(
    ("asked", "answer", "index", "stored"),
    [
        ("2b 0120 00 6300ffff", "60 01 20 00 00 00 00 00", 0x2001, b"\x63\0"),
        ("22 0120 00 64000000", "60 01 20 00 00 00 00 00", 0x2001, b"\x64\0"),
        ("21 0810 00 05000000 68656c6c6f", "60 08 10 00 00 00 00 00", 0x1008, b"hello"),
        ("21 0120 00 02000000 0700", "60 01 20 00 00 00 00 00", 0x2001, b"\x07\0"),
        ("21 0810 00 00000000", "60 08 10 00 00 00 00 00", 0x1008, b""),
    ],
)
def test_coe_server_stores_download(asked: str, answer: str, index: int, stored: bytes) -> None:
    slave = Slave()
    assert slave.ask(asked) == answer
    assert slave.dictionary.entry(index, 0).octets == stored


def test_complete_download_sets_the_count_and_confirms_in_kind() -> None:
    slave = Slave()
    assert slave.ask("31 121c 00 06000000 0200 0016 0116") == "70 12 1c 00 00 00 00 00"
    assert slave.ask("50 121c 00 00000000") == "51 12 1c 00 06 00 00 00 02 00 00 16 01 16"
    assert slave.ask("33 121c 01 00160216") == "70 12 1c 01 00 00 00 00"
    assert slave.ask("50 121c 01 00000000") == "53 12 1c 01 00 16 02 16"


@pytest.mark.parametrize(
    ("asked", "code"),
    [
        ("40 0030 00 00000000", AbortCode.NO_OBJECT),
        ("40 0010 01 00000000", AbortCode.NO_SUBINDEX),
        ("40 0080 02 00000000", AbortCode.NOT_STORED),
        ("40 0020 00 00000000", AbortCode.WRITE_ONLY),
        ("50 0010 00 00000000", AbortCode.NO_COMPLETE_ACCESS),
        ("50 001c 02 00000000", AbortCode.UNSUPPORTED_ACCESS),
        ("23 0010 00 00000000", AbortCode.READ_ONLY),
        ("2f 0120 00 01000000", AbortCode.TOO_SHORT),
        ("23 0120 00 01000000", AbortCode.TOO_LONG),
        ("2b 0120 00 65000000", AbortCode.TOO_HIGH),
        ("21 0120 00 01000000 0700", AbortCode.LENGTH),
        ("21 0120 00 ffffffff 0700", AbortCode.TOO_LONG),
        ("31 121c 00 ffffffff 0400", AbortCode.TOO_LONG),
        ("20 0120 00 00000000", AbortCode.COMMAND),
        ("22 0030 00 00000000", AbortCode.NO_OBJECT),
        ("a0 0120 00 00000000", AbortCode.COMMAND),
        ("00 0000 00 00000000", AbortCode.COMMAND),
        ("60 0000 00 00000000", AbortCode.COMMAND),
    ],
)
def test_coe_server_refusal(asked: str, code: AbortCode) -> None:
    assert Slave().abort_code(asked) is code


def test_sdo_server_abort_as_the_vector() -> None:
    answer = Slave().server.receive_request(bytes.fromhex("40 1810 05 00000000"))
    assert answer == [bytes.fromhex("0020 80 1810 05 00000206")]


def test_state_of_the_slave_counts() -> None:
    slave = Slave()
    slave.state = OdState.OP
    assert slave.abort_code("21 0220 00 32000000" + "00" * 50) is AbortCode.DEVICE_STATE


def test_coe_server_uploads_in_segments() -> None:
    slave = Slave(to_master=32)
    assert slave.ask("40 0220 00 00000000") == f"41 02 20 00 32 00 00 00 {octets(0, 16)}"
    assert slave.ask("60 00000000000000") == f"00 {octets(16, 39)}"
    assert slave.ask("70 00000000000000") == f"11 {octets(39, 50)}"
    assert slave.abort_code("60 00000000000000") is AbortCode.COMMAND


def test_sdo_server_short_last_segment_has_its_unused_count() -> None:
    slave = Slave(to_master=29)
    assert slave.ask("40 0220 00 00000000").endswith(octets(0, 13))
    assert slave.ask("60 00000000000000") == f"00 {octets(13, 33)}"
    slave.dictionary.download(0x1008, 0, b"0123456789abcdefg", OdState.PREOP)
    assert slave.ask("40 0810 00 00000000").endswith("30 31 32 33 34 35 36 37 38 39 61 62 63")
    assert slave.ask("60 00000000000000") == "07 64 65 66 67 00 00 00"


def test_coe_server_takes_segments() -> None:
    slave = Slave()
    assert slave.ask(f"21 0220 00 32000000 {octets(50, 80)}") == "60 02 20 00 00 00 00 00"
    assert slave.ask(f"00 {octets(80, 90)}") == "20 00 00 00 00 00 00 00"
    assert slave.dictionary.entry(0x2002, 0).octets == bytes(range(50))
    assert slave.ask(f"10 {octets(90, 98)}") == "30 00 00 00 00 00 00 00"
    assert slave.ask(f"0b {octets(98, 100)} 0000000000") == "20 00 00 00 00 00 00 00"
    assert slave.dictionary.entry(0x2002, 0).octets == bytes(range(50, 100))


def test_sdo_server_segmented_complete_download() -> None:
    slave = Slave()
    assert slave.ask("31 121c 00 0a000000 0400 0016") == "70 12 1c 00 00 00 00 00"
    assert slave.ask("03 0116 0216 0316 00") == "20 00 00 00 00 00 00 00"
    assert slave.dictionary.entry(0x1C12, 4).value == 0x1603


@pytest.mark.parametrize(
    ("segments", "code"),
    [
        (["10 00000000000000"], AbortCode.TOGGLE),
        (["00 00000000000000", "00 00000000000000"], AbortCode.TOGGLE),
        (["01 00000000000000"], AbortCode.TOO_SHORT),
        (["00" + "00" * 31], AbortCode.TOO_LONG),
        (["60 00000000000000"], AbortCode.COMMAND),
    ],
)
def test_broken_segments_abort_the_download(segments: list[str], code: AbortCode) -> None:
    slave = Slave()
    slave.ask(f"21 0220 00 32000000 {octets(0, 20)}")
    for segment in segments[:-1]:
        slave.ask(segment)
    assert slave.abort_code(segments[-1]) is code
    assert slave.dictionary.entry(0x2002, 0).octets == bytes(range(50))
    assert slave.abort_code("10 00000000000000") is AbortCode.COMMAND


def test_sdo_server_refused_value_aborts_at_the_last_segment() -> None:
    slave = Slave()
    assert slave.ask("21 0120 00 02000000") == "60 01 20 00 00 00 00 00"
    assert slave.ask("0b 6500 0000000000").startswith("80 01 20 00")


def test_wrong_toggle_aborts_an_upload() -> None:
    slave = Slave(to_master=32)
    slave.ask("40 0220 00 00000000")
    assert slave.ask("70 00000000000000") == "80 02 20 00 00 00 03 05"
    assert slave.abort_code("60 00000000000000") is AbortCode.COMMAND


def test_sdo_server_abort_of_the_client_ends_the_transfer() -> None:
    slave = Slave(to_master=32)
    slave.ask("40 0220 00 00000000")
    assert slave.server.receive_request(bytes.fromhex("80 0220 00 00000405")) == []
    assert slave.abort_code("60 00000000000000") is AbortCode.COMMAND


def test_sdo_server_new_transfer_and_reset_end_a_transfer() -> None:
    slave = Slave(to_master=32)
    slave.ask("40 0220 00 00000000")
    slave.ask("40 0010 00 00000000")
    assert slave.abort_code("60 00000000000000") is AbortCode.COMMAND
    slave.ask("40 0220 00 00000000")
    slave.server.reset()
    assert slave.abort_code("60 00000000000000") is AbortCode.COMMAND


def test_sdo_server_short_request_has_a_mailbox_error() -> None:
    with pytest.raises(MailboxRefusedError) as caught:
        Slave().server.receive_request(bytes(7))
    assert caught.value.detail == MailboxError.SIZE_TOO_SHORT


@given(st.lists(st.binary(min_size=8, max_size=40), max_size=20))
def test_sdo_server_any_request_has_one_answer_or_ends_a_transfer(requests: list[bytes]) -> None:
    slave = Slave(64, 32)
    for request in requests:
        answers = slave.server.receive_request(request)
        assert len(answers) == (request[0] >> 5 != 4)
        assert all(len(answer) <= 32 - 6 for answer in answers)


def octets(start: int, end: int) -> str:
    return bytes(range(start, end)).hex(" ")


DESCRIBED = ObjectDictionary(
    [
        variable(0x1000, "Device type", "UDINT", RO, 0x1389),
        record(0x6000, "Inputs", {1: Entry("Level", "INT", RO | Access.TX_MAPPABLE, maximum=9)}),
        *(variable(0x2000 + n, f"Value {n}", "UINT") for n in range(40)),
    ]
)


def ask_info(octets: str, size: int = 128) -> list[str]:
    """Return the answers behind their CoE headers."""
    server = SdoInfoServer(DESCRIBED, MailboxSizes(128, size))
    answers = []
    for answer in server.receive_request(bytes.fromhex(octets)):
        header, body = decode_message(answer)
        assert header.service is CoeService.SDO_INFORMATION
        assert len(answer) <= size - 6
        answers.append(body.hex(" "))
    return answers


def test_coe_server_lists_objects() -> None:
    assert ask_info("01 00 0000 0300") == ["02 00 00 00 03 00 00 60"]
    assert ask_info("01 00 0000 0000") == ["02 00 00 00 00 00 2a 00 00 00 01 00 00 00 00 00"]


def test_list_in_fragments_that_count_down() -> None:
    answers = [bytes.fromhex(answer) for answer in ask_info("01 00 0000 0100", 43)]
    headers = [SdoInfoHeader.decode(answer) for answer in answers]
    assert {header.opcode for header in headers} == {SdoInfoOpcode.LIST_RESPONSE}
    assert [(header.incomplete, header.fragments_left) for header in headers] == [
        (1, 2), (1, 1), (0, 0)
    ]  # fmt: skip
    assert [len(answer) - 4 for answer in answers] == [30, 30, 26]
    listed = b"".join(answer[4:] for answer in answers)
    indexes = [0x1000, *range(0x2000, 0x2028), 0x6000]
    assert listed == b"".join(number.to_bytes(2, "little") for number in [1, *indexes])


def test_coe_server_describes_object() -> None:
    assert ask_info("03 00 0000 0010") == [
        "04 00 00 00 00 10 07 00 00 07 " + b"Device type".hex(" ")
    ]


def test_coe_server_describes_entry() -> None:
    assert ask_info("05 00 0000 0060 01 7f") == [
        "06 00 00 00 00 60 01 57 03 00 10 00 87 00 00 00 09 00 " + b"Level".hex(" ")
    ]


@pytest.mark.parametrize(
    ("asked", "code"),
    [
        ("03 00 0000 0030", "00 00 02 06"),
        ("05 00 0000 0060 07 00", "11 00 09 06"),
        ("01 00 0000 0600", "43 00 04 06"),
        ("03 00 0000 00", "13 00 07 06"),
        ("05 00", "13 00 07 06"),
        ("02 00 0000 0100", "01 00 04 05"),
        ("7f 00 0000 0100", "01 00 04 05"),
    ],
)
def test_sdo_info_refusal(asked: str, code: str) -> None:
    assert ask_info(asked) == [f"07 00 00 00 {code}"]


@given(st.binary(max_size=12))
def test_sdo_info_server_answers_any_request(noise: bytes) -> None:
    assert ask_info(noise.hex(), 16)


DICTIONARY = ObjectDictionary([variable(0x1000, "Device type", "UDINT", RO, 0x1389)])


def make() -> tuple[CoeServer, dict[int, bytes]]:
    written: dict[int, bytes] = {}

    def read(service: CoeService, number: int) -> bytes | None:
        return {(CoeService.TX_PDO, 1): b"tx", (CoeService.RX_PDO, 2): b"rx"}.get((service, number))

    def write(number: int, data: bytes) -> bool:
        written[number] = data
        return number == 2

    sizes = MailboxSizes()
    server = CoeServer(DICTIONARY, lambda: OdState.PREOP, sizes, read_pdo=read, write_pdo=write)
    return server, written


def ask(server: CoeServer, octets: str) -> list[str]:
    return [answer.hex(" ") for answer in server.receive_message(bytes.fromhex(octets), 0)]


def refusal(server: CoeServer, octets: str) -> str:
    with pytest.raises(MailboxRefusedError) as caught:
        ask(server, octets)
    return MailboxError(caught.value.detail).name


def test_sdo_and_sdo_information_are_answered() -> None:
    server, _ = make()
    assert ask(server, "0020 40 0010 00 00000000") == ["00 30 43 00 10 00 89 13 00 00"]
    assert ask(server, "0080 01 00 0000 0100") == ["00 80 02 00 00 00 01 00 00 10"]


def test_remote_requests_are_answered_with_the_pdo() -> None:
    server, _ = make()
    assert ask(server, "0160") == ["01 40 74 78"]
    assert ask(server, "0270") == ["02 50 72 78"]


def test_rx_pdo_is_taken_without_an_answer() -> None:
    server, written = make()
    assert ask(server, "0250 0102") == []
    assert written == {2: b"\1\2"}


@pytest.mark.parametrize("octets", ["0260", "0170", "0350 0102", "0140", "0030", "0010", "0090"])
def test_coe_server_answers_unknown_services_with_a_mailbox_error(octets: str) -> None:
    assert refusal(make()[0], octets) == "SERVICE_NOT_SUPPORTED"


def test_coe_server_without_pdos_refuses_them() -> None:
    server = CoeServer(DICTIONARY, lambda: OdState.PREOP, MailboxSizes())
    assert refusal(server, "0160") == "SERVICE_NOT_SUPPORTED"
    assert refusal(server, "0250 0102") == "SERVICE_NOT_SUPPORTED"


def test_message_without_a_header_is_too_short() -> None:
    assert refusal(make()[0], "00") == "SIZE_TOO_SHORT"


def test_emergency_and_pdo_are_sent_once() -> None:
    server, _ = make()
    server.send_emergency(0x2310, 3, b"\7")
    server.send_tx_pdo(1, b"tx")
    assert [data.hex(" ") for data in server.messages_to_send(0)] == [
        "00 10 10 23 03 07 00 00 00 00",
        "01 40 74 78",
    ]
    assert server.messages_to_send(0) == []


def test_coe_server_drops_and_counts_emergencies_beyond_the_queue() -> None:
    server, _ = make()
    for code in range(MAX_PENDING + 2):
        server.send_emergency(code)
    assert server.dropped == 2
    assert [data[2] for data in server.messages_to_send(0)] == list(range(MAX_PENDING))


def test_coe_server_reset_discards_the_queue() -> None:
    server, _ = make()
    server.send_emergency(1)
    server.reset()
    assert server.messages_to_send(0) == []


@given(st.binary(max_size=24))
def test_coe_server_any_bytes_are_answered_or_refused(noise: bytes) -> None:
    try:
        answers = make()[0].receive_message(noise, 0)
    except MailboxRefusedError:
        return
    assert all(len(answer) <= 122 for answer in answers)
