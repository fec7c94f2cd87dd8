from __future__ import annotations

from pathlib import Path

import msgspec
import pytest

from eap.config import structs
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
    keys += section.LATER if issubclass(section, structs.Section) else []
    missing = [key for key in keys if key not in ("at", "variable") and f"`{key}`" not in text]
    assert not missing


def test_the_reference_has_every_measure_and_kind():
    text = (REPOSITORY / "docs/plant-file.md").read_text()
    names = [*spec.Measure, *spec.Substitute, *spec.Wake, *spec.PortKind]
    names += [source.__struct_config__.tag for source in spec.Source.__args__]
    assert not [name for name in names if f"`{name}`" not in text]
