"""The dictionary of a master with slaves that only say their numbers."""

from __future__ import annotations

import struct
from typing import Any

import pytest

from eap.device.eap_dictionary import DeviceIdentity
from eap.device.live_dictionaries import MasterDictionary
from eap.od.abort import AbortCode, SdoAbortError
from eap.od.info import ListType, object_list
from eap.od.model import OdState
from eap.od.profiles.master1100 import MasterLive

OP = OdState.OP


class Values:
    """Slaves from 1001 on."""

    def __init__(self, count: int = 3) -> None:
        self.count = count
        self.written: list[Any] = []

    def configured(self) -> range:
        return range(1001, 1001 + self.count)

    def detected(self) -> range:
        return range(1001, 1000 + self.count)

    def of_configured(self, station: int, key: MasterLive) -> Any:
        return {
            MasterLive.ADDRESS: station,
            MasterLive.NAME: f"slave {station}",
            MasterLive.TYPE: "EL1008",
        }.get(key, 5)

    def of_detected(self, station: int, key: MasterLive) -> Any:
        return station if key is MasterLive.ADDRESS else 6

    def of_diagnosis(self, station: int, key: MasterLive) -> Any:
        return 8

    def of_master(self, key: MasterLive) -> Any:
        sizes = {MasterLive.DETECT_REQUEST: 2, MasterLive.DETECT_RESPONSE: 6}
        return bytes(sizes[key]) if key in sizes else 0

    def write_slave(self, station: int, key: MasterLive, value: int) -> None:
        self.written.append((station, key, value))

    def write_master(self, key: MasterLive, data: bytes) -> None:
        self.written.append((key, data))


def dictionary(values: Values | None = None, **more: bool) -> MasterDictionary:
    return MasterDictionary(values or Values(), DeviceIdentity(device_name="M"), **more)


def refusal(call: Any, *arguments: Any) -> int:
    with pytest.raises(SdoAbortError) as caught:
        call(*arguments)
    return caught.value.code


def test_objects_of_slaves() -> None:
    od = dictionary()
    assert od.upload(0x1000, 0, OP) == struct.pack("<HH", 5001, 1100)
    assert od.upload(0x1008, 0, OP) == b"M"
    assert od.upload(0x8002, 1, OP) == struct.pack("<H", 1003)
    assert od.upload(0x8000, 3, OP) == b"slave 1001"
    assert od.upload(0x9001, 1, OP) == struct.pack("<H", 1002)
    assert od.upload(0xA000, 1, OP) == b"\x08\0"
    assert refusal(od.upload, 0x8003, 1, OP) == AbortCode.NO_OBJECT
    assert refusal(od.upload, 0x9002, 1, OP) == AbortCode.NO_OBJECT


def test_gaps_and_what_lies_behind() -> None:
    od = dictionary()
    assert refusal(od.upload, 0x8000, 20, OP) == AbortCode.NOT_STORED
    assert refusal(od.upload, 0x8000, 38, OP) == AbortCode.NO_SUBINDEX
    assert refusal(od.upload, 0xA000, 18, OP) == AbortCode.NO_SUBINDEX
    full = dictionary(full=True)
    assert full.upload(0x8000, 40, OP) == b"\1"
    assert full.upload(0xA000, 18, OP) == struct.pack("<I", 8)


def test_writes_reach_the_master() -> None:
    values = Values()
    od = dictionary(values)
    od.download(0xA001, 2, b"\4\0", OP)
    od.download(0xF002, 1, b"\1\0", OP)
    od.download(0xF200, 16, b"\1", OP)
    assert values.written == [
        (1002, MasterLive.AL_CONTROL, 4),
        (MasterLive.DETECT_REQUEST, b"\1\0"),
        (MasterLive.RESET, b"\1"),
    ]
    assert refusal(od.download, 0xA001, 1, b"\4\0", OP) == AbortCode.READ_ONLY


def test_lists_hold_255_addresses_each() -> None:
    od = dictionary(Values(300))
    assert od.upload(0xF020, 0, OP) == b"\xff"
    assert od.upload(0xF020, 255, OP) == struct.pack("<H", 1255)
    assert od.upload(0xF021, 45, OP) == struct.pack("<H", 1300)
    assert od.upload(0xF041, 0, OP) == bytes((44,))
    assert refusal(od.upload, 0xF022, 0, OP) == AbortCode.NO_OBJECT
    assert dictionary(Values(0)).upload(0xF020, 0, OP) == b"\0"


SIZES = {
    0x8000: 2 + 2 + 16 + 32 + 5 * 4 + 2 + 2 + 3,
    0x9000: 22,
    0xA000: 2 + 6 + 2 + 8 + 16 + 12 + 1,
}


@pytest.mark.parametrize("padded", [False, True])
@pytest.mark.parametrize("index", SIZES)
def test_up_to_the_usual_extent_both_ways_to_pad_agree(index, padded) -> None:
    assert len(dictionary(padded=padded).upload_complete(index, 0, OP)) == SIZES[index]


@pytest.mark.parametrize(
    ("index", "layout"),
    [
        (0x8000, "<BxH16s32sIIIIIHHBBBxHH?"),
        (0xA000, "<BxHHHBB4H4IIII?xI?"),
        (0xF002, "<Bx2sBx6s"),
        (0xF120, "<BxIIIIH"),
    ],
)
def test_padded_as_a_known_client_expects_it(index, layout) -> None:
    od = dictionary(full=True, padded=True)
    assert len(od.upload_complete(index, 0, OP)) == struct.calcsize(layout)


def test_the_detect_command_has_no_complete_access_as_with_twincat() -> None:
    assert refusal(dictionary().upload_complete, 0xF002, 0, OP) == AbortCode.PARAMETER


def test_everything_is_described() -> None:
    od = dictionary()
    indexes = [item.index for item in od]
    assert indexes == sorted(indexes)
    assert len(od) == len(indexes)
    assert {0x8000, 0x8002, 0x9001, 0xA002, 0xF002, 0xF020, 0xF040, 0xF120, 0xF200} <= set(indexes)
    assert 0x8003 not in od
    assert all(index in od for index in indexes)
    listed = struct.unpack(f"<{len(indexes)}H", object_list(od, ListType.ALL)[-2 * len(indexes) :])
    assert [*listed] == indexes
