from __future__ import annotations

import pytest

from eap.device.difference import ChangeKind, compare
from eap.device.fault import DeviceFault, FaultCode
from eap.device.staged import Staged
from eap.device.stored import configuration, copy
from eap.errors import LocalProtocolError
from eap.od.abort import AbortCode, SdoAbortError
from eap.od.profiles.eap1000keys import Tx
from tests.support.downloads import OP, sender, write
from tests.support.stations import BLANK, empty


@pytest.fixture
def ports():
    ports = empty()
    sender(ports["eap0"])
    return ports


def test_nothing_changes_until_commit(ports):
    before = configuration(ports["eap0"])
    staged = Staged(BLANK, ports)
    staged.download("eap0", 0xD000, Tx.PD_ID, b"\x09\0")
    assert configuration(ports["eap0"]) == before
    (change,) = staged.changes()["eap0"]
    assert (change.kind, change.index, change.subindex) == (ChangeKind.CHANGED, 0xD000, Tx.PD_ID)
    assert staged.check().frames[0].pds[0].pd_id == 9
    assert configuration(ports["eap0"]) == before
    spec = staged.commit()
    assert spec.frames[0].pds[0].pd_id == 9
    assert ports["eap0"].upload(0xD000, Tx.PD_ID, OP) == b"\x09\0"


def test_what_cannot_run_is_not_committed(ports):
    before = configuration(ports["eap0"])
    staged = Staged(BLANK, ports)
    staged.download("eap0", 0x1A00, 0, b"\0")
    with pytest.raises(DeviceFault) as caught:
        staged.commit()
    assert caught.value.code == FaultCode.EMPTY_PDO
    assert configuration(ports["eap0"]) == before
    staged.download("eap0", 0x8000, 0, b"\0")
    staged.download("eap0", 0xD000, 0, b"\0")
    assert staged.commit().frames == ()


def test_what_was_dropped_or_committed_is_over(ports):
    staged = Staged(BLANK, ports)
    staged.download("eap0", 0xD000, Tx.PD_ID, b"\x09\0")
    staged.drop()
    for call in (staged.commit, staged.changes):
        with pytest.raises(LocalProtocolError, match="is over"):
            call()
    assert ports["eap0"][0xD000].entries[Tx.PD_ID].value == 1


def test_changes_are_written_until_one_is_refused(ports):
    other = copy(ports["eap0"])
    write(other, 0xD000, Tx.VERSION, 3)
    staged = Staged(BLANK, ports)
    staged.write("eap0", compare(ports["eap0"], other))
    assert staged.check().frames[0].pds[0].version == 3
    with pytest.raises(SdoAbortError) as caught:
        staged.download("eap0", 0xD000, 0, b"\0")
    assert caught.value.code == AbortCode.PARAMETER


def test_the_originals_stay_the_same_objects(ports):
    asked: list[int] = []
    original = ports["eap0"]
    original.on_request = asked.append
    Staged(BLANK, ports).commit()
    write(ports["eap0"], 0xF200, 1, 8)
    assert ports["eap0"] is original
    assert asked == [8]
