"""Bus files: what may be in them, and that all that is wrong is said with its line."""

from __future__ import annotations

from pathlib import Path

import pytest

from devicebus.master.pdo import channels_from_sii
from devicebus.master.scan import scan
from eap.config.index import DescribedPdoEntry
from eap.errors import ConfigError
from eap.od.slave_config import SdoWrite, SlaveConfig
from eap.runtime import busfile
from tests.support.busline import Bench, Line, run

BUSES = Path(__file__).parents[4] / "config" / "buses"
GOOD = """\
bus: small
slaves:
  - {name: a, kind: coupler, mailbox: null}
  - name: b
    kind: analogue
    inputs:
      - {name: level, type: INT, csv: level.csv}
faults:
  - {kind: cut, slave: b, at_ms: 5}
"""


def write(tmp_path, text=GOOD):
    (tmp_path / "level.csv").write_text("1\n2\n")
    path = tmp_path / "bus.yaml"
    path.write_text(text)
    return path


@pytest.mark.parametrize("path", sorted(BUSES.glob("*.yaml")), ids=lambda path: path.stem)
def test_buses_that_are_shipped_can_be_built(path):
    result = busfile.load(path)
    assert result.findings == ()
    assert len(result.bus.build().segment.slaves) == len(result.bus.spec.slaves)


def test_coe_bus_has_three_mailboxes():
    slaves = busfile.load_or_raise(BUSES / "coe.yaml").spec.slaves
    assert [slave.mailbox.coe for slave in slaves] == [True] * 3


def test_file_with_its_resources(tmp_path):
    bus = busfile.load_or_raise(write(tmp_path))
    assert bus.resources == {"level.csv": b"1\n2\n"}
    assert bus.spec.slaves[0].mailbox is None
    segment = bus.build()
    segment.handle_timeout(0)
    assert segment.next_timeout() == 5_000_000


@pytest.mark.parametrize(
    ("old", "new", "finding"),
    [
        ("kind: coupler", "kind: cuopler", "3: kind is 'cuopler'; expected one of coupler, dig"),
        ("bus: small\n", "", "1: bus has no bus; expected the key bus"),
        ("name: b", "name: a", "4: 'a' is there twice; expected a name of its own"),
        ("name: b", "name: b\n    after: x", "5: no slave 'x' before; expected one of a"),
        ("kind: coupler,", "kind: coupler, after: b,", "3: the first slave is wired to the mast"),
        ("type: INT", "type: INTT", "4: b: 'INTT' is not a data type, did you mean INT?"),
        ("level.csv", "none.csv", "4: none.csv cannot be read: No such file or directory"),
        ("slave: b", "slave: c", "9: fault cut: no slave 'c' (one of a, b)"),
        ("name: b", "name: b\n    port: 4", "5: port is 4; expected a whole number from 1 to 3"),
    ],
)
def test_wrong_bus_file_is_a_finding_with_line(tmp_path, old, new, finding):
    result = busfile.load(write(tmp_path, GOOD.replace(old, new, 1)))
    assert result.bus is None
    found = [str(each).removeprefix(f"{tmp_path}/bus.yaml:") for each in result.findings]
    assert any(each.startswith(finding) for each in found), found


def test_master_keys_configure_the_slave(tmp_path):
    keys = """
    outputs: [{name: o}]
    master:
      optional: true
      startup: [{sdo: "0x6000:1", data: "0100"}]
      pdos: {3: []}
"""
    coupler, analogue = described(tmp_path, GOOD.replace("    inputs", f"{keys}    inputs"))
    assert coupler.config == SlaveConfig()
    assert analogue.config.optional
    assert analogue.config.writes == (SdoWrite(index=0x6000, subindex=1, data=b"\1\0"),)
    assert analogue.inputs == ()
    assert [each.name for each in analogue.outputs] == ["o", ""]


def test_master_key_outside_its_section_is_sent_there(tmp_path):
    wrong = GOOD.replace("    inputs", "    startup: []\n    inputs")
    (finding,) = busfile.load(write(tmp_path, wrong)).findings
    assert str(finding).endswith("unknown key 'startup'; expected it under the key master")


def test_section_that_is_no_mapping_names_its_keys(tmp_path):
    wrong = GOOD.replace("    inputs", "    master: {sync0: true}\n    inputs")
    (finding,) = busfile.load(write(tmp_path, wrong)).findings
    assert "sync0 is true; expected a mapping with keys of " in str(finding)


def test_finding_about_a_master_key_has_its_line(tmp_path):
    wrong = GOOD.replace("    inputs", "    master:\n      pdos: [0x1A09]\n    inputs")
    (finding,) = busfile.load(write(tmp_path, wrong)).findings
    text = "bus.yaml:7: b has no PDO '0x1A09'; expected one of 0x1A00 (Inputs)"
    assert str(finding).endswith(text)


def test_port_that_is_taken(tmp_path):
    text = GOOD.replace("faults:", "  - {name: c, kind: coupler, after: a}\nfaults:")
    (finding,) = busfile.load(write(tmp_path, text)).findings
    assert finding.message == "port 1 of a has a cable to b already"


@pytest.mark.parametrize("text", ["", "[]", "bus: x\nslaves: []\n"])
def test_no_bus_at_all(tmp_path, text):
    with pytest.raises(ConfigError, match=r"bus\.yaml"):
        busfile.load_or_raise(write(tmp_path, text))


def test_resource_that_is_too_large(tmp_path, monkeypatch):
    monkeypatch.setattr(busfile, "MAX_RESOURCE", 2)
    (finding, *_) = busfile.load(write(tmp_path)).findings
    assert "too large" in finding.message


def described(tmp_path, text=GOOD):
    return busfile.describe(write(tmp_path, text)).slaves


def test_bus_description_equals_master_scan(tmp_path):
    coupler, analogue = described(tmp_path)
    assert (coupler.name, coupler.vendor, coupler.product) == ("a", 0x0E5A, 1)
    assert (coupler.inputs, coupler.outputs) == ((), ())
    assert analogue.product == 3
    assert analogue.inputs == (DescribedPdoEntry("level", "INT", 0x6000, 1, 16, 3),)


def test_description_of_bits_has_their_padding(tmp_path):
    digital = "digital\n    outputs: [{name: x}, {name: y}]\n    mailbox: null"
    text = GOOD.replace("analogue", digital).replace("type: INT", "type: BOOL")
    [_, slave] = described(tmp_path, text)
    assert [(e.name, e.type, e.index, e.bit_length) for e in slave.outputs] == [
        ("x", "BOOL", 0x7000, 1),
        ("y", "BOOL", 0x7000, 1),
        ("", "", 0, 6),
    ]
    assert [e.bit_length for e in slave.inputs] == [1, 7]


def test_bus_description_leaves_open_values_none(tmp_path):
    given = "name: b\n    revision: 0x10000\n    serial: 5\n    alias: 6"
    first, second = described(tmp_path, GOOD.replace("name: b", given))
    assert (first.revision, first.serial, first.alias) == (None, None, None)
    assert (second.revision, second.serial, second.alias) == (0x10000, 5, 6)


def test_slaves_are_in_the_order_in_which_frames_come_to_them(tmp_path):
    branch = "  - {name: c, kind: coupler, after: a, port: 3}\n  - {name: d, kind: coupler}\n"
    text = GOOD.replace("faults:", f"{branch}faults:")
    assert [slave.name for slave in described(tmp_path, text)] == ["a", "c", "d", "b"]
    names = [slave.name for slave in busfile.describe(BUSES / "io.yaml").slaves]
    assert names == ["coupler", "inputs", "outputs", "level"]


def test_findings_take_the_place_of_a_description(tmp_path):
    path = write(tmp_path, GOOD.replace("kind: coupler", "kind: x"))
    assert busfile.describe(path) == busfile.load(path).findings
    assert busfile.describe(path)


@pytest.mark.parametrize("path", sorted(BUSES.glob("*.yaml")), ids=lambda path: path.stem)
def test_a_master_finds_a_bus_as_it_is_described(path):
    expected = busfile.describe(path).slaves
    found = run(Line(Bench(), busfile.load_or_raise(path).build().segment), scan())
    assert [slave.station for slave in found] == [1001 + n for n in range(len(expected))]
    for slave, known in zip(found, expected, strict=True):
        assert (slave.identity.vendor, slave.identity.product) == (known.vendor, known.product)
        channels = channels_from_sii(slave.sii)
        for is_output, entries in ((True, known.outputs), (False, known.inputs)):
            assert [(e.index, e.subindex, e.bit_length) for e in entries] == [
                (entry.index, entry.subindex, entry.bit_length)
                for channel in channels
                if channel.is_output is is_output
                for pdo in channel.pdos
                for entry in pdo.entries
            ]


def test_digest_tells_what_is_simulated(tmp_path):
    def digest(text):
        result = busfile.describe(write(tmp_path, text))
        assert not isinstance(result, tuple), result
        return result.digest

    before = digest(GOOD)
    named = GOOD.replace("bus: small", "bus: large")
    configured = GOOD.replace("csv: level.csv}", "csv: level.csv}\n    master: {optional: true}")
    assert digest(named) == digest(configured) == before
    assert configured != GOOD
    assert digest(GOOD.replace("name: level", "name: height")) != before
    (tmp_path / "level.csv").write_text("3\n")
    assert busfile.describe(tmp_path / "bus.yaml").digest != before
