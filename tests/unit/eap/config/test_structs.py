from __future__ import annotations

import re
import textwrap
from pathlib import Path

import msgspec
import pytest

from eap.config import structs
from eap.config.index import ExpectedBus
from eap.config.load import load
from eap.pd import spec

REPOSITORY = Path(__file__).parents[4]
SECTIONS = [
    *structs.Section.__subclasses__(),
    spec.OnChangeSpec,
    *spec.Source.__args__,
]


@pytest.mark.parametrize("section", SECTIONS, ids=lambda section: section.__name__)
def test_the_reference_has_every_key(section):
    text = (REPOSITORY / "docs/plant-file.md").read_text()
    keys = [field.encode_name for field in msgspec.structs.fields(section)]
    missing = [key for key in keys if key not in ("at", "variable") and f"`{key}`" not in text]
    assert not missing


def test_the_reference_has_every_measure_and_kind():
    text = (REPOSITORY / "docs/plant-file.md").read_text()
    names = [*spec.Measure, *spec.Substitute, *spec.Wake, *spec.PortKind]
    names += [source.__struct_config__.tag for source in spec.Source.__args__]
    assert not [name for name in names if f"`{name}`" not in text]


LINE = """\
plant: line
stations:
  - name: mixer
    net_id: 10.0.0.1.1.1
    ports:
      - {name: eap0, kind: eap, interface: "udp://10.0.0.1", net_id: 10.0.0.1.2.1}
      - {name: bus0, kind: bus, interface: "ethernet://eth1", net_id: 10.0.0.1.3.1}
"""
OTHERS = """\
  - name: mill
    net_id: 10.0.0.2.1.1
    ports:
      - {name: eap0, kind: eap, interface: "udp://10.0.0.2", net_id: 10.0.0.2.2.1}
      - {name: bus0, kind: bus, interface: "ethernet://eth1", net_id: 10.0.0.2.3.1}
  - name: saw
    net_id: 10.0.0.3.1.1
    ports:
      - {name: eap0, kind: eap, interface: "ethernet://eth0", net_id: 10.0.0.3.2.1}
"""


def examples(*keys):
    """Return the examples of the reference that begin with one of *keys*."""
    text = (REPOSITORY / "docs/plant-file.md").read_text()
    found = re.findall(r"```yaml\n(.*?)```", text, re.DOTALL)
    return [each for each in found if each.startswith(tuple(f"{key}:\n" for key in keys))]


@pytest.mark.parametrize("example", examples("routes", "access", "users", "secure_ads"))
def test_the_examples_of_the_reference_are_right(example, tmp_path):
    for name in ("certificates/plant.pem", "certificates/works.pem", "certificates/mixer.pem"):
        touch(tmp_path / name)
    for name in ("mixer", "mixer.key", "administrator"):
        touch(tmp_path / "secrets" / name)
    plant = tmp_path / "plant.yaml"
    plant.write_text(LINE + textwrap.indent(example, "    ") + OTHERS)
    result = load(plant, lambda path: ExpectedBus())
    assert [str(finding) for finding in result.findings] == []
    told = result.plant.routing["mixer"]
    written = [route for route in told.routes if not route.is_derived]
    assert written or told.mqtt or told.access or told.users


def test_examples_cover_all_keys_of_routing():
    assert len(examples("routes", "access", "users", "secure_ads")) == 5


def touch(file):
    file.parent.mkdir(exist_ok=True)
    file.touch()
