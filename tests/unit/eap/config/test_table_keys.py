"""Keys that the table of the EAP profile names, and the sections of the plant file."""

from __future__ import annotations

import pytest
from msgspec import inspect

from eap.codec import datatypes
from eap.config import structs
from eap.od.profiles import eap1000
from eap.od.profiles.table import OWN_TYPE
from eap.pd import spec

SECTIONS = {
    "stations": (structs.StationSection, spec.StationSpec),
    "ports": (structs.PortSection, spec.PortSpec),
    "variables": (structs.VariableSection, spec.VariableSpec),
    "subscribe.variables": (structs.VariableSection, spec.VariableSpec),
    "frames": (structs.FrameSection, spec.TxFrameSpec),
    "publish": (structs.PublishSection, spec.TxPdSpec),
    "subscribe": (structs.SubscribeSection, spec.RxPdSpec),
}
ROWS = [(row, each) for row in eap1000.ALL for each in row.entries if each.key or each.field]


def _struct_of(kind):
    kinds = kind.types if isinstance(kind, inspect.UnionType) else (kind,)
    return next(each for each in kinds if isinstance(each, inspect.StructType))


def _field(struct, path):
    """Return the type of the field at *path* as the file writes it, without None."""
    kind = inspect.type_info(struct)
    for name in path.split("."):
        fields = {each.encode_name: each.type for each in _struct_of(kind).fields}
        assert name in fields, f"{struct.__name__} has no {path}"
        kind = fields[name]
    kinds = kind.types if isinstance(kind, inspect.UnionType) else (kind,)
    return next(each for each in kinds if not isinstance(each, inspect.NoneType))


@pytest.mark.parametrize(("row", "entry"), ROWS, ids=lambda each: getattr(each, "name", ""))
def test_key_and_field_of_an_entry_exist_and_its_type_holds_what_the_file_may_say(row, entry):
    section, record = SECTIONS[row.section]
    if entry.field:
        _field(record, entry.field)
    if not entry.key:
        return
    told = _field(section, entry.key)
    if entry.kind != OWN_TYPE and isinstance(told, inspect.IntType) and told.le is not None:
        low, high = datatypes.parse(entry.kind).scalar_range
        assert (entry.minimum or low) <= told.ge
        assert told.le <= (entry.maximum or high)


def test_every_key_of_what_is_sent_and_received_is_in_the_table():
    named = {}
    for row, entry in ROWS:
        named.setdefault(row.section, set()).add(entry.key.partition(".")[0])
    not_shown = {
        "frames": {"port"},
        "publish": {"frame"},
        "subscribe": {"port", "foreign"},
    }
    for section, others in not_shown.items():
        kind = inspect.type_info(SECTIONS[section][0])
        keys = {each.encode_name for each in kind.fields} - {"at"}
        assert keys - named[section] == others
