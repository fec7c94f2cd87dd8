"""Objects of devices that ADS reaches."""

from __future__ import annotations

from contextlib import ExitStack

import pytest

from eap.errors import ControlError
from eap.ops.od_devices import AdsOd
from eap.ops.routing import AmsDevice, AmsRefusedError, open_ams
from tests.support.adstarget import TARGET, AdsTarget
from tests.support.oddevice import mixer


@pytest.fixture
def target(tmp_path, monkeypatch):
    monkeypatch.setenv("EAP_RUNTIME_DIR", str(tmp_path))
    with ExitStack() as stack:
        yield AdsTarget(mixer(), stack)


@pytest.fixture
def far(target):
    with open_ams(TARGET, None) as device:
        yield AdsOd(device)


def test_od_by_ads_lists_objects(far):
    names = {each.index: (each.name, each.code, each.max_subindex) for each in far.objects()}
    assert names[0xD000] == ("TxPD 0", "RECORD", 7)


@pytest.mark.parametrize("octets", [b"", b"\1", b"\1\0", b"\1\0\0"])
def test_list_without_objects(far, monkeypatch, octets):
    monkeypatch.setattr(AmsDevice, "demand", lambda *_: octets)
    assert far.objects() == []


def test_od_by_ads_describes_entries(far):
    found = far.describe(0xD000)
    cycle = next(each for each in found.entries if each.subindex == 7)
    assert (cycle.kind and cycle.kind.text, cycle.access) == ("UDINT", "rw")
    assert far.entry(0xD000, 99) is None


def test_read_and_write(far):
    far.write(0xD000, 7, (20_000).to_bytes(4, "little"))
    assert far.read(0xD000, 7) == (20_000).to_bytes(4, "little")
    whole = far.read(0xD000, 0, complete=True)
    assert far.read(0xD000, 1, complete=True) == whole[2:]
    far.write(0xD000, 0, whole, complete=True)
    with pytest.raises(ControlError, match="from subindex 0 on"):
        far.write(0xD000, 1, whole[2:], complete=True)


def test_od_by_ads_raises_refusals(far, target):
    with pytest.raises(AmsRefusedError, match=r"0x9999:00: there is no such object or entry"):
        far.read(0x9999, 0)
    target.error = 0x1B
    with pytest.raises(AmsRefusedError, match="host unreachable"):
        far.entry(0xD000, 7)


def test_od_by_ads_reads_contents(far):
    found = {(each.object.index, each.entry.subindex): each for each in far.contents()}
    assert found[0xD000, 7].octets == far.read(0xD000, 7)
