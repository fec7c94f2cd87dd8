from __future__ import annotations

from contextlib import suppress
from pathlib import Path

import msgspec
import pytest
from hypothesis import Phase, given, settings
from msgspec.structs import replace

from eap.device.configuration import read_configuration
from eap.device.eap_dictionary import EapDictionary
from eap.device.eap_spec import fill
from eap.ids import InterfaceUri, NetId
from eap.od.profiles.eap1000 import (
    MAX_ENTRIES,
    RX_PD,
    RX_VARIABLE,
    TX_FRAME,
    TX_PD,
    TX_VARIABLE,
    FrameSub,
    Tx,
    Var,
)
from eap.pd.device import DeviceFault, FaultCode
from eap.pd.spec import (
    PortKind,
    PortSpec,
    RxPdSpec,
    StationSpec,
    TxFrameSpec,
    TxPdSpec,
    VariableSpec,
    Writer,
)
from tests.support.examples import examples
from tests.support.stations import BLANK, filled, stations

FEATURES = Path(__file__).parents[4] / "docs" / "features.md"


def _names(dictionary: EapDictionary, row) -> list[str]:
    return [dictionary.name_of(index) for index in dictionary.members(row)]


@pytest.fixture
def forwarding() -> StationSpec:
    """One that has a variable of its own, receives on one port and sends on by the other."""
    return replace(
        BLANK,
        variables=(
            VariableSpec("own", "UINT"),
            VariableSpec("got", "REAL", Writer.ENGINE),
            VariableSpec("bus0.state", "BYTE", Writer.ENGINE),
        ),
        ports=(
            *BLANK.ports,
            PortSpec(
                "bus0",
                PortKind.BUS,
                InterfaceUri.parse("sim:///b.yaml"),
                NetId.parse("127.0.9.1.4.1"),
            ),
        ),
        subscriptions=(RxPdSpec("from", "eap0", 1, ("got",)),),
        frames=(
            TxFrameSpec(
                "to", "eap1", "01:01:05:04:00:00", (TxPdSpec("out", 1, ("got", "bus0.state")),)
            ),
        ),
    )


def test_each_port_has_what_is_its_own(forwarding):
    ports = filled(forwarding)
    assert _names(ports["eap0"], TX_VARIABLE) == ["own"]
    assert _names(ports["eap0"], RX_VARIABLE) == ["got"]
    assert _names(ports["eap0"], RX_PD) == ["from"]
    assert _names(ports["eap1"], TX_VARIABLE) == ["got", "bus0.state"]
    assert _names(ports["eap1"], TX_PD) == ["out"]
    assert _names(ports["eap1"], TX_FRAME) == ["to"]
    assert not ports["eap0"].members(TX_FRAME, TX_PD)


def test_object_of_same_name_keeps_its_index(forwarding):
    before = filled(forwarding)
    frame = forwarding.frames[0]
    more = (TxPdSpec("new", 2, ("got",)), *frame.pds)
    after = replace(
        forwarding,
        variables=(VariableSpec("first", "UINT"), *forwarding.variables),
        frames=(replace(frame, pds=more),),
    )
    ports = filled(after, before)
    assert ports["eap0"].name_of(0x6000) == "own"
    assert ports["eap0"].name_of(0x6001) == "first"
    assert ports["eap1"].name_of(0xD000) == "out"
    assert ports["eap1"].name_of(0xD001) == "new"
    assert ports["eap1"][0xD000].entries[Tx.PDO_INDEX].value == 0x1A00
    assert ports["eap1"][0xD001].entries[Tx.PDO_INDEX].value == 0x1A01


@examples(30)
@given(stations())
def test_filling_like_itself_changes_nothing(station: StationSpec):
    before = filled(station)
    for name, each in filled(station, before).items():
        assert read_configuration(each) == read_configuration(before[name])


def test_mappings_that_others_share_are_not_taken_over(forwarding):
    before = filled(forwarding)
    like = before["eap1"]
    like.make(TX_PD, 0xD001)
    like.put(0xD001, Tx.PDO_INDEX, b"\x00\x1a")
    like.put(0xD001, Tx.NAME, b"second")
    second = TxPdSpec("second", 2, ("got",))
    frame = forwarding.frames[0]
    after = replace(forwarding, frames=(replace(frame, pds=(*frame.pds, second)),))
    ports = filled(after, before)
    assert ports["eap1"][0xD001].entries[Tx.PDO_INDEX].value == 0x1A01


def test_more_pdos_than_the_first_range_holds_go_to_the_further_one():
    pds = tuple(TxPdSpec(f"pd{number}", number, ("own",)) for number in range(600))
    frames = tuple(
        TxFrameSpec(f"f{number}", "eap0", "10.0.0.2", pds[number : number + 60])
        for number in range(0, 600, 60)
    )
    station = replace(BLANK, variables=(VariableSpec("own", "UINT"),), frames=frames)
    dictionary = filled(station)["eap0"]
    assert dictionary[0xD1FF].entries[Tx.PDO_INDEX].value == 0x1BFF
    assert dictionary[0xD200].entries[Tx.PDO_INDEX].value == 0x3000


def test_a_default_is_kept_as_the_type_has_it():
    station = replace(BLANK, variables=(VariableSpec("own", "REAL[2]", default=[1, 2.5]),))
    entries = filled(station)["eap0"][0x6000].entries
    assert entries[Var.DEFAULT_GIVEN].value is True
    assert entries[Var.DEFAULT].value == (1.0, 2.5)


@pytest.mark.parametrize(
    ("variables", "sent", "index", "reason"),
    [
        ([VariableSpec("n" * 256, "UINT")], [], 0x6000, "at most 255 bytes"),
        ([VariableSpec("own", "UINT")], ["own"] * 255, 0x1A00, "at most 254 entries"),
        ([VariableSpec(f"v{n}", "BIT1") for n in range(4097)], [], 0x6000, "at most 4096"),
    ],
)
def test_specification_too_large_is_refused_with_its_object(variables, sent, index, reason):
    frames = (TxFrameSpec("f", "eap0", "10.0.0.2", (TxPdSpec("pd", 1, tuple(sent)),)),)
    station = replace(BLANK, variables=tuple(variables), frames=frames if sent else ())
    with pytest.raises(DeviceFault, match=reason) as caught:
        fill(EapDictionary(station, "eap0"))
    assert caught.value.code == FaultCode.NO_ROOM
    assert caught.value.index == index


def test_a_frame_lists_as_many_pds_as_its_object_has_entries():
    most = MAX_ENTRIES - FrameSub.TXPD + 1
    assert f"a list of more than {most} PDs in a frame" in FEATURES.read_text(encoding="utf-8")
    pds = tuple(TxPdSpec(f"pd{number}", number, ("own",)) for number in range(most + 1))
    frames = (TxFrameSpec("f", "eap0", "tcp://10.0.0.2", pds),)
    station = replace(BLANK, variables=(VariableSpec("own", "BIT1"),), frames=frames)
    with pytest.raises(DeviceFault, match=f"{most + 1} entries, at most {most}"):
        filled(station)


def test_stations_strategy_varies_each_field_of_frames_and_pds():
    """Properties see a new field only if ``tests/support/stations.py`` fills it."""
    seen: dict[type, set[str]] = {TxFrameSpec: set(), TxPdSpec: set(), RxPdSpec: {"alternates"}}
    # A dictionary has no entry for alternates: they last only while a sender changes.
    every = {kind: set(kind.__struct_fields__) for kind in seen}

    class AllSeenError(Exception):
        """Ends the search."""

    @settings(max_examples=800, phases=[Phase.generate])
    @given(stations())
    def collect(station: StationSpec) -> None:
        pds = [pd for frame in station.frames for pd in frame.pds]
        for record in (*station.frames, *pds, *station.subscriptions):
            fields = msgspec.structs.fields(record)
            seen[type(record)] |= {f.name for f in fields if getattr(record, f.name) != f.default}
        if seen == every:
            raise AllSeenError

    with suppress(AllSeenError):
        collect()
    assert seen == every
