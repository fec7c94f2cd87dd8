from __future__ import annotations

from hypothesis import given, settings

from eap.device.difference import compare
from eap.device.stored import configuration, copy
from eap.od.model import OdState
from eap.pd.spec import StationSpec
from tests.support.stations import empty, filled, stations


def _kept(dictionary):
    return {
        index: entries
        for index, entries in configuration(dictionary).items()
        if not (0x1600 <= index <= 0x3DFF and entries == {0: b"\0"})
    }


@settings(max_examples=30)
@given(stations(), stations())
def test_changes_written_in_their_order_make_the_new_dictionary(
    before: StationSpec, after: StationSpec
):
    for like in (None, filled(before)):
        new = filled(after, like)
        for name, old in filled(before).items():
            for change in compare(old, new[name]):
                old.download(change.index, change.subindex, change.data, OdState.PREOP)
            assert _kept(old) == _kept(new[name])
            assert compare(old, new[name]) == []


@settings(max_examples=30)
@given(stations())
def test_a_blank_station_is_filled_by_downloads_alone(station: StationSpec):
    for name, new in filled(station).items():
        old = empty()[name]
        for change in compare(old, new):
            assert not change.interim
            old.download(change.index, change.subindex, change.data, OdState.PREOP)
        assert configuration(old) == configuration(new)


@settings(max_examples=30)
@given(stations())
def test_a_copy_does_not_differ(station: StationSpec):
    for each in filled(station).values():
        assert compare(each, copy(each)) == []
