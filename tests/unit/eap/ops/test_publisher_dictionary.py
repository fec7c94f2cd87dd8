"""PDs of a publisher as its own dictionary describes them, and combined with what was seen."""

from __future__ import annotations

from hypothesis import given

from eap.codec import datatypes
from eap.ids import Destination
from eap.od.dictionary import ObjectDictionary
from eap.od.model import RO, Entry, record, variable
from eap.od.profiles.eap1000 import Var
from eap.ops.discover import DiscoveredPd, complete
from eap.ops.publisher_dictionary import PublishedPd, PublishedVariable, published_pds
from eap.pd.spec import REQUESTER, StationSpec
from tests.support.examples import examples
from tests.support.oddevice import MemoryDevice
from tests.support.stations import filled, stations

PUBLISHER = "5.23.91.23.2.1"


def mapping(*entries: int) -> dict[int, Entry]:
    return {
        0: Entry("SubIndex 000", "USINT", RO, len(entries)),
        **{n: Entry(f"Mapping {n}", "UDINT", RO, entry) for n, entry in enumerate(entries, 1)},
    }


def foreign(*entries: int, **kinds: str) -> MemoryDevice:
    """A device of another vendor: IDs and mappings as in the profile, nothing else of ours."""
    pdo = record(0x1A00, "Tx PDO", {})
    return MemoryDevice(
        ObjectDictionary(
            [
                *(
                    variable(0x6000 + n, name, kind, RO, b"\0" if kind == "BLOCK(1)" else 0)
                    for n, (name, kind) in enumerate(kinds.items())
                ),
                type(pdo)(0x1A00, "Tx PDO", pdo.code, mapping(*entries)),
                record(
                    0xD000,
                    "Tx data",
                    {3: Entry("Id", "UINT", RO, 12), 4: Entry("Version", "UINT", RO, 3)},
                ),
            ]
        )
    )


@given(stations())
@examples(40)
def test_dictionary_of_each_station_gives_its_pds(station: StationSpec) -> None:
    types = {each.name: each.type for each in station.variables}
    for name, dictionary in filled(station).items():
        found = {pd.pd_id: pd for pd in published_pds(MemoryDevice(dictionary), PUBLISHER)}
        sent = {pd.pd_id: (frame, pd) for frame in station.frames for pd in frame.pds
                if frame.port == name}  # fmt: skip
        assert found.keys() == sent.keys()
        for pd_id, (frame, pd) in sent.items():
            known = found[pd_id]
            kinds = [datatypes.parse(types[each]) for each in pd.variables]
            assert (known.name, known.version) == (pd.name, pd.version)
            assert known.length == datatypes.layout(kinds).size
            assert [each.type for each in known.variables] == [kind.text for kind in kinds]
            names = [each.name for each in known.variables]
            assert len(set(names)) == len(pd.variables)
            assert set(pd.variables) <= set(names)
            assert known.cycle_us == pd.trigger.cycle_us
            if frame.destination != REQUESTER and "tcp" not in frame.destination:
                assert known.destination == str(Destination.parse(frame.destination))


def test_foreign_dictionary_gives_names_and_types_of_mapped_entries() -> None:
    device = foreign(0x60000020, 0x60010010, count="UDINT", level="INT")
    (pd,) = published_pds(device, PUBLISHER)
    assert (pd.pd_id, pd.version, pd.length, pd.name) == (12, 3, 6, "pd12")
    assert pd.variables == (PublishedVariable("count", "UDINT"), PublishedVariable("level", "INT"))
    assert (pd.transport, pd.destination, pd.cycle_us) == ("", "", 0)


def test_padding_in_a_mapping_is_a_gap_where_no_layout_has_it() -> None:
    device = foreign(0x60000001, 0x00000007, 0x60010010, 0x00000018, flag="BOOL", level="INT")
    (pd,) = published_pds(device, PUBLISHER)
    assert [each.type for each in pd.variables] == ["BOOL", "INT", "BLOCK(3)"]
    device = foreign(0x60000001, 0x0000001F, 0x60010010, flag="BOOL", level="INT")
    (pd,) = published_pds(device, PUBLISHER)
    assert [each.type for each in pd.variables] == ["BOOL", "BIT7", "BLOCK(3)", "INT"]
    assert pd.length == 6


def test_unreadable_parts_are_left_out() -> None:
    assert list(published_pds(foreign(0x60000020, 0x70000010, count="UDINT"), PUBLISHER)) == []
    assert list(published_pds(foreign(0x60000010, count="UDINT"), PUBLISHER)) == []  # other length
    assert list(published_pds(foreign(count="UDINT"), PUBLISHER)) == []
    assert list(published_pds(MemoryDevice(ObjectDictionary([])), PUBLISHER)) == []


def test_names_that_no_plant_file_could_have_are_changed() -> None:
    device = foreign(0x60000110, 0x60010110)
    for index in (0x6000, 0x6001):
        device.dictionary.add(
            record(
                index,
                "Variable",
                {
                    Var.VALUE: Entry("Value", "INT", RO, 0),
                    Var.TYPE_NAME: Entry("Type name", "STRING(40)", RO, "INT"),
                    Var.NAME: Entry("Name", "STRING(40)", RO, "oven/inner  temp\n"),
                },
            )
        )
    (pd,) = published_pds(device, PUBLISHER)
    assert [each.name for each in pd.variables] == ["oven_inner_temp", "oven_inner_temp_2"]


def seen(pd_id: int, **fields: object) -> DiscoveredPd:
    values = {"version": 0, "length": 4, "rate_hz": 1.0, "jitter_us": 0, "destination": "10.0.0.9"}
    return DiscoveredPd(
        publisher=PUBLISHER, pd_id=pd_id, taken_by=None, transport="udp", **values | fields
    )


def test_rows_get_names_and_types_and_unseen_pds_are_rows_too() -> None:
    known = PublishedPd(PUBLISHER, 1, 0, 4, "state", (PublishedVariable("x", "DINT"),))
    unseen = known._replace(pd_id=3, name="rare", transport="udp", destination="10.0.0.9")
    rows, remarks = complete([seen(2), seen(1)], [known, unseen], [])
    assert [(row.pd_id, row.name) for row in rows] == [(1, "state"), (2, None), (3, "rare")]
    assert rows[0].variables is not None
    assert rows[1].variables is None
    assert (rows[2].received, rows[2].destination_kind) == (0, "unicast")
    assert remarks == []


def test_other_layout_than_the_dictionary_says_is_named_and_stays_a_block() -> None:
    known = PublishedPd(PUBLISHER, 1, 2, 4, "state", (PublishedVariable("x", "DINT"),))
    (row,), remarks = complete([seen(1)], [known], [])
    assert (row.name, row.variables) == ("state", None)
    seen_as, described_as = "version 0 and 4 bytes", "version 2 with 4 bytes"
    where = f"PD 1 of {PUBLISHER}: seen with {seen_as}"
    assert remarks == [f"{where}, but its dictionary describes {described_as}"]
