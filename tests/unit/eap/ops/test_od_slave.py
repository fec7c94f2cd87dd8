"""Objects of slaves, through their mailboxes."""

from __future__ import annotations

import pytest

from eap.od.abort import AbortCode, SdoAbortError
from eap.ops.od_devices import SlaveOd
from tests.support.loopbus import LoopBus


@pytest.fixture
def sensor():
    with LoopBus("coe").session() as session:
        yield SlaveOd(session, "sensor")


def test_od_of_slave_lists_objects(sensor):
    names = {each.index: (each.name, each.code) for each in sensor.objects()}
    assert names[0x8001] == ("Calibration", "VAR")


def test_od_of_slave_describes_entries(sensor):
    found = sensor.describe(0x8000)
    first = found.entries[1]
    assert [each.subindex for each in found.entries] == [0, 1, 2]
    assert (first.name, first.kind and first.kind.text, first.access) == ("Filter", "UDINT", "rw")
    assert sensor.entry(0x1018, 1).access == "r"
    assert sensor.entry(0x8000, 9) is None
    assert sensor.entry(0x9999, 0) is None


def test_read_and_write(sensor):
    sensor.write(0x8000, 1, bytes((7, 0, 0, 0)))
    assert sensor.read(0x8000, 1) == bytes((7, 0, 0, 0))
    assert sensor.read(0x8000, 0, complete=True)[2:6] == bytes((7, 0, 0, 0))


def test_od_of_slave_raises_abort(sensor):
    with pytest.raises(SdoAbortError) as caught:
        sensor.write(0x1018, 1, bytes(4))
    assert caught.value.code == AbortCode.READ_ONLY


def test_od_of_slave_reads_contents(sensor):
    found = {(each.object.index, each.entry.subindex): each for each in sensor.contents()}
    assert found[0x8000, 1].octets == (50).to_bytes(4, "little")
    assert not any(each.error for each in found.values())
