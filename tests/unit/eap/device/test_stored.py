from __future__ import annotations

import msgspec
import pytest
from hypothesis import given

from eap.device.eap_dictionary import EapDictionary
from eap.device.stored import (
    StoredError,
    adopt,
    configuration,
    dump,
    load,
    restore,
)
from eap.od.abort import AbortCode, SdoAbortError
from eap.od.model import OdState
from eap.od.profiles.eap1000 import FrameSub, Tx, Var
from eap.pd.spec import StationSpec
from tests.support.downloads import OP, copy, receiver, sender, variable, write
from tests.support.examples import examples
from tests.support.stations import BLANK, empty, filled, stations


@examples(30)
@given(stations())
def test_what_is_dumped_comes_back_whole(station: StationSpec):
    for name, each in filled(station).items():
        other = empty()[name]
        load(other, msgspec.json.decode(msgspec.json.encode(dump(each))))
        assert configuration(other) == configuration(each)
        assert dump(other) == dump(each)


def test_a_mapping_that_is_being_written_is_kept_as_it_is(udp):
    sender(udp)
    write(udp, 0x1A00, 0, 0)
    write(udp, 0x1A00, 2, 0x6000_0110)
    other = copy(udp)
    assert list(other[0x1A00].entries) == [0, 1, 2]
    assert other[0x1A00].max_subindex == 0


def test_a_copy_is_another_one(udp):
    other = copy(sender(udp))
    write(other, 0xD000, Tx.PD_ID, 9)
    assert udp[0xD000].entries[Tx.PD_ID].value == 1


def test_restoring_replaces_everything_and_keeps_what_is_not_configuration(udp):
    sender(udp)
    udp.show_status(8, None)
    write(udp, 0xF811, 3, "239.1.1.1")
    write(udp, 0xF800, 8, 5000)
    kept = configuration(receiver(EapDictionary(BLANK, "eap0")))
    restore(udp, kept)
    assert configuration(udp) == kept
    assert 0x8000 not in udp
    assert udp.upload(0xF100, 1, OP) == b"\x08\0"
    restore(udp, {})
    assert configuration(udp) == configuration(EapDictionary(BLANK, "eap0"))


def test_adopting_touches_only_what_differs(udp):
    sender(udp)
    write(udp, 0xF811, 2, "239.1.1.1")
    wanted = copy(udp)
    write(wanted, 0xD000, Tx.PD_ID, 9)
    write(wanted, 0xF811, 0, 1)
    write(wanted, 0xF811, 1, "239.1.1.2")
    variable(wanted, 0x6005, "more")
    same = [udp[index] for index in (0x6000, 0x1A00, 0x8000)]
    adopt(udp, wanted)
    assert configuration(udp) == configuration(wanted)
    assert [udp[each.index] for each in same] == same
    adopt(udp, udp.blank())
    assert configuration(udp) == configuration(udp.blank())


def test_rights_that_the_configuration_grants_are_restored(udp):
    sender(udp)
    write(udp, 0x8000, FrameSub.CHANGEABLE, 1)
    other = copy(udp)
    write(other, 0x8000, FrameSub.DESTINATION_IP, b"\1\2\3\4", OP)
    restore(other, configuration(sender(EapDictionary(BLANK, "eap0"))))
    with pytest.raises(SdoAbortError) as caught:
        write(other, 0x8000, FrameSub.DESTINATION_IP, b"\1\2\3\4", OP)
    assert caught.value.code == AbortCode.DEVICE_STATE


@pytest.mark.parametrize(
    ("code", "kept"),
    [
        (AbortCode.NO_OBJECT, {0x5000: {0: b"\0"}}),
        (AbortCode.NO_SUBINDEX, {0xD000: {99: b"\0"}}),
        (AbortCode.NO_SUBINDEX, {0x1A00: {255: bytes(4)}}),
        (AbortCode.READ_ONLY, {0xD000: {Tx.PDO_LENGTH: b"\0\0"}}),
        (AbortCode.READ_ONLY, {0x1018: {1: bytes(4)}}),
        (AbortCode.TOO_SHORT, {0xD000: {Tx.PD_ID: b"\0"}}),
        (AbortCode.TOO_HIGH, {0xF810: {9: b"\x02"}}),
        (AbortCode.VALUE, {0x6000: {Var.NAME: b"a b"}}),
        (AbortCode.VALUE, {0x6000: {Var.TYPE_NAME: b"u16"}}),
        (AbortCode.VALUE, {0x1A00: {0: b"\x05", 1: bytes(4)}}),
        (AbortCode.VALUE, {0x8000: {0: b"\x20"}}),
    ],
)
def test_what_no_dictionary_has_is_refused_and_changes_nothing(udp, code, kept):
    sender(udp)
    before = configuration(udp)
    with pytest.raises(SdoAbortError) as caught:
        restore(udp, {0x6000: {Var.NAME: b"fine"}, **kept})
    assert caught.value.code == code
    assert configuration(udp) == before


@pytest.mark.parametrize(
    ("data", "reason"),
    [
        (b"[]", "no stored configuration"),
        (b'{"version": 1}', "no stored configuration"),
        (b'{"version": 2, "profile": 1000, "objects": {}}', "version 2, this release knows 1"),
        (b'{"version": 1, "profile": 9000, "objects": {}}', "profile 9000, this is 1000"),
        (b'{"version": 1, "profile": 1000, "objects": {"x": {}}}', "no stored configuration"),
        (b'{"version": 1, "profile": 1000, "objects": {"6000": {"5": "0"}}}', "no stored"),
        (b'{"version": 1, "profile": 1000, "objects": {"5000": {"0": "00"}}}', "does not exist"),
        (b'{"version": 1, "profile": 1000, "objects": {}, "more": 1}', "no stored configuration"),
    ],
)
def test_what_is_no_configuration_is_refused_with_the_reason(udp, data, reason):
    sender(udp)
    before = dump(udp)
    with pytest.raises(StoredError, match=reason):
        load(udp, msgspec.json.decode(data))
    assert dump(udp) == before


def test_the_plain_form_is_for_json(udp):
    variable(udp, 0x6000, "level")
    plain = dump(udp)
    assert plain["objects"]["6000"]["5"] == b"level".hex()
    other = EapDictionary(BLANK, "eap0")
    load(other, plain)
    assert other.upload(0x6000, Var.NAME, OdState.OP) == b"level"
