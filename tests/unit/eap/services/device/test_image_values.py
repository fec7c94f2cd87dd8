"""Live entries from a real image."""

from __future__ import annotations

import pytest
from msgspec.structs import replace

from eap.device.eap_dictionary import EapDictionary
from eap.device.eap_spec import fill
from eap.net.image_file import StationImage, create_image
from eap.od.model import OdState
from eap.od.profiles import eap1000 as profile
from eap.od.profiles.eap1000_keys import EapLive
from eap.pd.layout import plan_layout
from eap.pd.spec import VariableSpec, Writer
from eap.pd.words import (
    PD_DROP_INDEX,
    REASON_INDEX,
    FrameWord,
    PdDropReason,
    Reason,
    RxWord,
    StationWord,
    TxWord,
)
from eap.services.device.image_values import ImageValues


@pytest.fixture
def values(images):
    return {name: ImageValues(image) for name, image in images.items()}


def number(values, key: EapLive, name: str = "") -> int:
    octets = values.octets(key, name)
    assert octets is not None
    return int.from_bytes(octets, "little")


def test_values_of_variables(values, files):
    image = files["left"].image
    with image.writing(Writer.APPLICATION):
        image.write("running", True)
        image.write("setpoint", [1.5, -2])
        image.write("name", "xyz")
    left = values["left"]
    assert left.octets(EapLive.VALUE, "running") == b"\1"
    assert left.octets(EapLive.VALUE, "setpoint") == image.encode("setpoint", [1.5, -2])
    assert left.octets(EapLive.VALUE, "name") == b"xyz" + bytes(5)
    assert left.octets(EapLive.VALUE, "nobody") is None


def test_counters_of_one_moment_do_not_change_and_values_of_programs_do(values, files):
    image = files["right"].image
    first = image.layout.rx[0].words
    right = values["right"]

    def arrive(count: int) -> None:
        image.words[first + RxWord.RECEIVED] = image.words[first + RxWord.LAST_CYCLE] = count

    def seen() -> tuple[int, int]:
        keys = EapLive.RX_RECEIVED, EapLive.RX_CYCLE_INDEX
        return tuple(number(right, key, "left-state") for key in keys)

    arrive(5)
    with right.consistent_values():
        received, _ = seen()
        arrive(6)
        assert seen() == (received, 5)
    assert seen() == (6, 6)
    left = values["left"]
    with left.consistent_values(), files["left"].image.writing(Writer.APPLICATION):
        files["left"].image.write("state.VarCtrl", 2)
    with left.consistent_values():
        assert number(left, EapLive.TX_VAR_CTRL, "state") == 2


def test_counters_of_the_station(values, files):
    words = files["left"].image.words
    words[StationWord.CYCLE] = 70_000
    words[StationWord.LATENESS_MAX_NS] = 12_345
    words[StationWord.DISCARDED + PD_DROP_INDEX[PdDropReason.UNKNOWN_ID]] = 9
    left = values["left"]
    assert number(left, EapLive.STATION_CYCLE) == 70_000
    assert number(left, EapLive.STATION_LATENESS_MAX) == 12_345
    assert number(left, EapLive.STATION_DISCARDED_UNKNOWN_ID) == 9
    assert number(left, EapLive.STATION_DISCARDED_TRUNCATED) == 0


def test_frames_and_pds_that_are_sent(values, files):
    image = files["left"].image
    (frame,), (pd,) = image.layout.frames, image.layout.tx
    image.words[frame.words + FrameWord.WHOLE] = 10
    image.words[frame.words + FrameWord.UNSENT] = 1
    image.words[frame.words + FrameWord.SKIPPED] = 2
    image.words[pd.words + TxWord.SKIPPED] = 3
    image.words[pd.words + TxWord.REASON + REASON_INDEX[Reason.EVENT]] = 4
    with image.writing(Writer.APPLICATION):
        image.write("out.FrameCtrl", 1)
        image.write("state.VarCtrl", 2)
    left = values["left"]
    assert number(left, EapLive.FRAME_WHOLE, "out") == 10
    assert number(left, EapLive.FRAME_STATE, "out") == 1
    assert number(left, EapLive.FRAME_SKIPPED, "out") == 2
    assert number(left, EapLive.FRAME_CTRL, "out") == 1
    assert number(left, EapLive.TX_VAR_CTRL, "state") == 2
    assert number(left, EapLive.TX_SKIPPED, "state") == 3
    assert number(left, EapLive.TX_SENT_CYCLE, "state") == 10
    assert number(left, EapLive.TX_SENT_EVENT, "state") == 4
    assert number(left, EapLive.TX_LAST_REASON, "state") == REASON_INDEX[Reason.CYCLE]


def test_pds_that_are_received(values, files):
    image = files["right"].image
    (pd,) = image.layout.rx
    right = values["right"]
    assert number(right, EapLive.RX_QUALITY, "left-state") == 0xFFFF
    assert number(right, EapLive.RX_CYCLE_INDEX, "left-state") == 0
    image.words[StationWord.CYCLE] = 5
    image.words[pd.words + RxWord.RECEIVED] = 7
    image.words[pd.words + RxWord.LOST] = 1 << 40
    image.words[pd.words + RxWord.LAST_CYCLE] = 0x1_0002
    image.words[pd.words + RxWord.ARRIVED_IN_CYCLE] = 3
    image.words[pd.words + RxWord.STATE] = 1
    image.words[pd.words + RxWord.JITTER_MAX_US] = 1 << 40
    image.words[pd.words + RxWord.DISCARDED + PD_DROP_INDEX[PdDropReason.VERSION]] = 2
    assert number(right, EapLive.RX_RECEIVED, "left-state") == 7
    assert number(right, EapLive.RX_LOST, "left-state") == 1 << 40
    assert number(right, EapLive.RX_CYCLE_INDEX, "left-state") == 2
    assert number(right, EapLive.RX_QUALITY, "left-state") == 200
    assert number(right, EapLive.RX_STATE, "left-state") == 1
    assert number(right, EapLive.RX_JITTER_MAX, "left-state") == 0xFFFFFFFF
    assert number(right, EapLive.RX_DISCARDED_VERSION, "left-state") == 2


def test_frame_state_of_a_missing_subscriber(values, files):
    image = files["left"].image
    first = image.layout.frames[0].words
    image.words[first + FrameWord.UNSENT] = 1
    image.words[first + FrameWord.PRESENCE] = 2
    assert number(values["left"], EapLive.FRAME_STATE, "out") == 5


def test_values_of_objects_that_do_not_run_are_none(values):
    for key in (EapLive.FRAME_STATE, EapLive.TX_SKIPPED, EapLive.RX_LOST):
        assert values["left"].octets(key, "nobody") is None


def test_newest_image_counts(values, files, stations):
    left = values["left"]
    assert number(left, EapLive.FRAME_STATE, "out") == 0
    spec = replace(stations[0], variables=(*stations[0].variables, VariableSpec("more", "UINT")))
    with create_image(files["left"].path, plan_layout(spec)) as fresh:
        fresh.image.words[fresh.image.layout.frames[0].words + FrameWord.UNSENT] = 4
        assert number(left, EapLive.FRAME_STATE, "out") == 4
        assert left.octets(EapLive.VALUE, "more") == bytes(2)


def test_image_that_is_gone_shows_nothing(stations, files):
    image = StationImage(files["left"].path)
    values = ImageValues(image)
    image.image.words[StationWord.RETIRED] = 1
    files["left"].path.unlink()
    assert values.octets(EapLive.VALUE, "running") is None
    image.close()


def test_every_live_entry_of_the_profile_is_served(values):
    names = ("out", "state", "left-state")
    unserved = {
        row.live
        for each in profile.ALL
        for row in each.entries
        if row.live and row.kind
        if all(one.octets(row.live, name) is None for one in values.values() for name in names)
    }
    assert unserved == set()


def test_a_dictionary_shows_them(stations, values, files):
    dictionary = EapDictionary(stations[0], "eap0", values["left"])
    fill(dictionary)
    words = files["left"].image.words
    words[StationWord.CYCLE] = 77
    assert dictionary.upload(0xF110, 1, OdState.OP) == (77).to_bytes(8, "little")
    value = next(
        item.entries[1]
        for item in dictionary
        if item.entries.get(5) and item.entries[5].octets == b"name"
    )
    assert value.octets == b"abc".ljust(8, b"\0")
