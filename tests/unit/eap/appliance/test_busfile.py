"""Bus files: what may be in them, and that all that is wrong is said with its line."""

from __future__ import annotations

from pathlib import Path

import pytest

from eap.appliance import busfile
from eap.errors import ConfigError

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
def test_finding(tmp_path, old, new, finding):
    result = busfile.load(write(tmp_path, GOOD.replace(old, new, 1)))
    assert result.bus is None
    found = [str(each).removeprefix(f"{tmp_path}/bus.yaml:") for each in result.findings]
    assert any(each.startswith(finding) for each in found), found


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
