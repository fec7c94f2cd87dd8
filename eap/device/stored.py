"""The configuration of a dictionary as a whole: out and in again, as octets or for JSON.

Everything is kept that a client can write in PreOp, by index and sub-index; what is live, computed
or given at the start is not.  A configuration is taken back whole or not at all.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, TypeAlias

import msgspec

from eap.device import eap_rules
from eap.device.eap_dictionary import EapDictionary
from eap.errors import ConfigError
from eap.od.abort import AbortCode, SdoAbortError
from eap.od.dictionary import check_value
from eap.od.model import Entry, ObjectCode
from eap.od.profiles import eap1000 as profile
from eap.od.profiles.table import CONFIG, ProfileObject

VERSION = 1

Configuration: TypeAlias = dict[int, dict[int, bytes]]
"""Octets of all entries that are kept, by index and sub-index."""


class StoredError(ConfigError):
    """Stored data that is no configuration of this dictionary."""


class _Stored(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """As JSON: indexes and octets in hexadecimal digits."""

    version: int
    profile: int
    objects: dict[str, dict[int, str]]


def configuration(dictionary: EapDictionary) -> Configuration:
    """Return everything of *dictionary* that is kept."""
    found: Configuration = {}
    for item in dictionary:
        kept = {sub: each.octets for sub, each in item.entries.items() if _is_kept(each)}
        if kept:
            found[item.index] = kept
    return found


def restore(dictionary: EapDictionary, kept: Mapping[int, Mapping[int, bytes]]) -> None:
    """Give *dictionary* the configuration *kept*, and nothing of what it had.

    Raises:
        SdoAbortError: there is no such entry, or it cannot hold that; nothing has changed then.
    """
    wanted = dictionary.blank()
    _put_all(wanted, kept)
    adopt(dictionary, wanted)


def adopt(dictionary: EapDictionary, wanted: EapDictionary) -> None:
    """Give *dictionary* the configuration of *wanted*, another one of the same port.

    Objects that are the same in both are not touched: most of a large station usually are.
    """
    before, after = configuration(dictionary), configuration(wanted)
    changed = {index: kept for index, kept in after.items() if before.get(index) != kept}
    for index in before:
        row = profile.row_of(index)
        if row.dynamic and (index in changed or index not in after):
            dictionary.remove(index)
        elif row.list_row is not None and index in changed:
            dictionary.resize(index, row.fixed_count)
    _put_all(dictionary, changed)


def dump(dictionary: EapDictionary) -> dict[str, Any]:
    """Return the configuration as plain values for JSON."""
    objects = {
        f"{index:04X}": {subindex: octets.hex() for subindex, octets in entries.items()}
        for index, entries in configuration(dictionary).items()
    }
    plain: dict[str, Any] = msgspec.to_builtins(
        _Stored(VERSION, dictionary.identity.module_profile, objects), str_keys=True
    )
    return plain


def load(dictionary: EapDictionary, plain: object) -> None:
    """Take back what :func:`dump` gave.

    Raises:
        StoredError: it is of another version or profile, or no configuration; nothing has changed.
    """
    try:
        stored = msgspec.convert(plain, _Stored, str_keys=True)
        kept = {
            int(index, 16): {sub: bytes.fromhex(digits) for sub, digits in entries.items()}
            for index, entries in stored.objects.items()
        }
    except ValueError as exc:
        raise StoredError(f"no stored configuration: {exc}") from None
    if stored.version != VERSION:
        detail = f"version {stored.version}, this release knows {VERSION}"
        raise StoredError(f"stored configuration: {detail}")
    if stored.profile != dictionary.identity.module_profile:
        detail = f"profile {stored.profile}, this is {dictionary.identity.module_profile}"
        raise StoredError(f"stored configuration: {detail}")
    try:
        restore(dictionary, kept)
    except SdoAbortError as exc:
        raise StoredError(f"stored configuration: {exc}") from None


def _is_kept(entry: Entry) -> bool:
    # Of flags Python makes objects; there are as many entries as a station has of everything.
    return int.__and__(entry.access, CONFIG) == CONFIG


def _put_all(dictionary: EapDictionary, kept: Mapping[int, Mapping[int, bytes]]) -> None:
    for index, entries in sorted(kept.items()):
        row = profile.find(index)
        if row is None or not (row.dynamic or index in dictionary):
            raise SdoAbortError(AbortCode.NO_OBJECT, index, 0, "the profile has none there")
        if row.dynamic:
            dictionary.make(row, index)
        if row.list_row is not None:
            dictionary.grow(index, min(max(entries, default=0), row.list_row.last))
        for subindex, octets in sorted(entries.items(), key=lambda pair: pair[0] or 0x100):
            _put(dictionary, row, index, subindex, octets)


def _put(
    dictionary: EapDictionary, row: ProfileObject, index: int, subindex: int, octets: bytes
) -> None:
    entry = dictionary.entry(index, subindex)
    if not _is_kept(entry):
        raise SdoAbortError(AbortCode.READ_ONLY, index, subindex)
    check_value(entry, index, subindex, octets)
    if subindex == 0 and row.code is not ObjectCode.VAR:
        last = max(dictionary[index].entries)
        if octets[0] != last and not (row.mapping and octets[0] < last):
            raise SdoAbortError(AbortCode.VALUE, index, 0, f"{octets[0]} of {last} entries")
    else:
        try:
            is_usual = eap_rules.checked(row, subindex, entry, octets) == octets
        except ValueError as exc:
            raise SdoAbortError(AbortCode.VALUE, index, subindex, str(exc)) from None
        if not is_usual:
            raise SdoAbortError(AbortCode.VALUE, index, subindex, "not in its usual form")
    dictionary.put(index, subindex, octets)
