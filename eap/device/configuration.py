"""Configuration of a dictionary: stored form, and the changes between two configurations.

A configuration is everything that a client can write in PreOp, by index and sub-index.  Live
values, computed values and those given at the start are not part of it.  A configuration is
restored whole or not at all.

Changes come in an order in which a client can write them: references are cleared before their
target goes, and set after it exists.  Some of these writes are of no interest to users
(``interim``). Written one after the other into the old dictionary in PreOp, the changes produce the
new one, and no frame is ever longer than in one of the two.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from enum import StrEnum
from typing import Any, TypeAlias

import msgspec

from eap.device import eap_rules
from eap.device.eap_dictionary import EapDictionary
from eap.device.eap_rules import MappingEntry
from eap.errors import ConfigError
from eap.od.abort import AbortCode, SdoAbortError
from eap.od.dictionary import check_value
from eap.od.model import Entry, ObjectCode
from eap.od.profiles import eap1000 as profile
from eap.od.profiles.eap1000 import FrameSub, Rx, Tx, Var
from eap.od.profiles.table import CONFIG, Form, ProfileObject, to_text

VERSION = 2

Configuration: TypeAlias = dict[int, dict[int, bytes]]
"""Bytes of all entries that are kept, by index and sub-index."""


class StoredError(ConfigError):
    """Stored data that is not a configuration of this dictionary."""


class _Stored(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """JSON form: indexes and bytes in hexadecimal digits."""

    version: int
    profile: int
    objects: dict[str, dict[int, str]]


def read_configuration(dictionary: EapDictionary) -> Configuration:
    """Return the configuration of *dictionary*."""
    found: Configuration = {}
    for item in dictionary:
        kept = {sub: each.octets for sub, each in item.entries.items() if _is_kept(each)}
        if kept:
            found[item.index] = kept
    return found


def restore_configuration(
    dictionary: EapDictionary, kept: Mapping[int, Mapping[int, bytes]]
) -> None:
    """Replace the configuration of *dictionary* by *kept*.

    Raises:
        SdoAbortError: an entry does not exist or cannot hold its value; nothing has changed.
    """
    # Built aside, so that an error leaves the dictionary unchanged.
    wanted = dictionary.blank()
    _put_all(wanted, kept)
    adopt_configuration(dictionary, wanted)


def adopt_configuration(dictionary: EapDictionary, wanted: EapDictionary) -> None:
    """Replace the configuration of *dictionary* by that of *wanted*, another one of the same port.

    Objects that are equal in both are not touched: usually most objects of a large station.
    """
    before, after = read_configuration(dictionary), read_configuration(wanted)
    changed = {index: kept for index, kept in after.items() if before.get(index) != kept}
    for index in before:
        row = profile.row_of(index)
        # Removed and made again: entries that the new object does not give have their defaults
        # then.
        if row.dynamic and (index in changed or index not in after):
            dictionary.remove(index)
        elif row.list_row is not None and index in changed:
            dictionary.resize(index, row.fixed_count)
    _put_all(dictionary, changed)


def dump_configuration(dictionary: EapDictionary) -> dict[str, Any]:
    """Return the configuration as plain values for JSON."""
    objects = {
        f"{index:04X}": {subindex: octets.hex() for subindex, octets in entries.items()}
        for index, entries in read_configuration(dictionary).items()
    }
    plain: dict[str, Any] = msgspec.to_builtins(
        _Stored(VERSION, dictionary.identity.module_profile, objects), str_keys=True
    )
    return plain


def load_configuration(dictionary: EapDictionary, plain: object) -> None:
    """Restore the result of :func:`dump_configuration`.

    Raises:
        StoredError: the data has another version or profile, or is invalid; nothing has changed.
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
    # Another kind of port gives the same indexes another meaning.
    if stored.profile != dictionary.identity.module_profile:
        detail = f"profile {stored.profile}, this is {dictionary.identity.module_profile}"
        raise StoredError(f"stored configuration: {detail}")
    try:
        restore_configuration(dictionary, kept)
    except SdoAbortError as exc:
        raise StoredError(f"stored configuration: {exc}") from None


def _is_kept(entry: Entry) -> bool:
    # "&" of two flags creates an object; this runs for every entry of a station.
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
        # Sub-index 0 last: it is checked against the entries that exist.
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
        # Only a mapping can have more entries written than it counts, see eap_dictionary.
        if octets[0] != last and not (row.mapping and octets[0] < last):
            raise SdoAbortError(AbortCode.VALUE, index, 0, f"{octets[0]} of {last} entries")
    else:
        try:
            is_usual = eap_rules.checked(row, subindex, entry, octets) == octets
        except ValueError as exc:
            raise SdoAbortError(AbortCode.VALUE, index, subindex, str(exc)) from None
        # Stored data went through the same rules when it was written: another form is a damaged
        # file.
        if not is_usual:
            raise SdoAbortError(AbortCode.VALUE, index, subindex, "not in its usual form")
    dictionary.put(index, subindex, octets)


_NONE = b"\0"
_REFERENCES = {
    profile.TX_PD.first: (Tx.PDO_INDEX, Tx.POLL_REQUEST_RXPD),
    profile.RX_PD.first: (Rx.PDO_INDEX, Rx.POLL_REQUEST_TXPD),
}
_PDS = (profile.TX_PD, profile.RX_PD)


class ChangeKind(StrEnum):
    """Kind of change of an entry."""

    ADDED = "added"
    REMOVED = "removed"
    CHANGED = "changed"


class EntryChange(msgspec.Struct, frozen=True):
    """One entry, or with sub-index 0 the length of a list or a whole object, and its download."""

    kind: ChangeKind
    index: int
    subindex: int
    name: str
    """Name of the object and the entry."""
    old: str
    """Value as text; empty if there is none."""
    new: str
    data: bytes
    """Data of the download."""
    interim: bool = False
    """True if the write is an interim step, such as clearing an entry that is set later."""


def compare(old: EapDictionary, new: EapDictionary) -> list[EntryChange]:
    """Return the changes from the configuration of *old* to that of *new*."""
    return list(_Comparison(old, new).run())


class _Comparison:
    def __init__(self, old: EapDictionary, new: EapDictionary) -> None:
        self._old_dictionary, self._new_dictionary = old, new
        self._old, self._new = _without_empty_mappings(old), _without_empty_mappings(new)
        self._blank = new.blank()

    def run(self) -> Iterator[EntryChange]:
        """Yield all changes in their order."""
        yield from self._static()
        # Frames first: as long as they list a PD, it cannot be deleted.
        yield from self._removed(profile.TX_FRAME)
        # Before anything grows: no interim frame is longer than the old or the new one.
        yield from self._cut_lists()
        rewritten = self._mappings_to_write()
        yield from self._emptied(rewritten)
        yield from self._cleared_references()
        for row in (*_PDS, *profile.VARIABLES):
            yield from self._removed(row)
        for row in profile.VARIABLES:
            yield from self._written(row)
        for index in rewritten:
            yield from self._mapping(index)
        for row in (*_PDS, profile.TX_FRAME):
            yield from self._written(row)

    def _static(self) -> Iterator[EntryChange]:
        for row in profile.STATIC:
            before, after = self._old.get(row.first, {}), self._new.get(row.first, {})
            if row.list_row is None:
                for subindex in after:
                    if before[subindex] != after[subindex]:
                        yield self._change(row.first, subindex)
            elif before != after:
                if before[0] != _NONE:
                    yield self._change(row.first, 0, _NONE, interim=after[0] != _NONE)
                for subindex in sorted(after)[1:]:
                    yield self._change(row.first, subindex)

    def _members(self, row: ProfileObject, kept: Configuration) -> list[int]:
        return [index for index in sorted(kept) if row.first <= index <= row.last]

    def _removed(self, row: ProfileObject) -> Iterator[EntryChange]:
        for index in self._members(row, self._old):
            if index not in self._new:
                yield self._change(index, 0, _NONE)

    def _both(self, row: ProfileObject) -> list[int]:
        return [index for index in self._members(row, self._old) if index in self._new]

    def _cut_lists(self) -> Iterator[EntryChange]:
        """Shorten the lists of frames that lose a PD or move one."""
        row = profile.TX_FRAME
        for index in self._both(row):
            if self._is_rewritten(index):
                data = bytes((row.fixed_count,))
                yield self._change(index, 0, data, interim=data != self._new[index][0])

    def _is_rewritten(self, index: int) -> bool:
        """Return whether the list of a frame changes other than at its end."""
        before, after = self._old[index], self._new[index]
        return any(after.get(sub) != before[sub] for sub in before if sub >= FrameSub.TXPD)

    def _mappings_to_write(self) -> list[int]:
        """Return the mappings that change, or whose variables change their type or are removed."""
        moved = {
            index
            for row in profile.VARIABLES
            for index in self._members(row, self._old)
            if self._old[index][Var.TYPE_NAME] != self._new.get(index, {}).get(Var.TYPE_NAME)
        }
        return [
            index
            for row in profile.MAPPINGS
            for index in sorted({*self._members(row, self._old), *self._members(row, self._new)})
            if self._old.get(index) != self._new.get(index)
            or any(
                MappingEntry.decode(int.from_bytes(word, "little")).target in moved
                for subindex, word in self._old[index].items()
                if subindex
            )
        ]

    def _emptied(self, rewritten: Iterable[int]) -> Iterator[EntryChange]:
        for index in rewritten:
            if index in self._old:
                yield self._change(index, 0, _NONE, interim=index in self._new)

    def _cleared_references(self) -> Iterator[EntryChange]:
        """Clear references that change, and those between PDs that are all removed."""
        for row in _PDS:
            for index in self._members(row, self._old):
                goes = index not in self._new
                for subindex in _REFERENCES[row.first]:
                    before = self._old[index][subindex]
                    after = self._new.get(index, {}).get(subindex, before)
                    if any(before) and (before != after or (goes and subindex != Tx.PDO_INDEX)):
                        yield self._change(index, subindex, bytes(2), interim=goes or any(after))

    def _written(self, row: ProfileObject) -> Iterator[EntryChange]:
        for index in self._members(row, self._new):
            after = self._new[index]
            before = self._before(row, index)
            changed = [sub for sub in after if sub and before.get(sub) != after[sub]]
            for subindex in changed or ([] if index in self._old else [min(after, key=bool)]):
                yield self._change(index, subindex)

    def _before(self, row: ProfileObject, index: int) -> dict[int, bytes]:
        """Return the entries of the object at *index* immediately before it is written."""
        after = self._new[index]
        if index in self._old:
            before = dict(self._old[index])
        else:
            fresh = self._blank.make(row, index)
            before = {sub: entry.octets for sub, entry in fresh.entries.items()}
        if row in profile.VARIABLES and before[Var.TYPE_NAME] != after[Var.TYPE_NAME]:
            entry = self._new_dictionary[index].entries[Var.DEFAULT]
            # Writing another type resets the default.
            before |= {Var.DEFAULT_GIVEN: _NONE, Var.DEFAULT: entry.default}
        if row is profile.TX_FRAME and index in self._old and self._is_rewritten(index):
            # _cut_lists has emptied the list of the frame.
            before = {sub: octets for sub, octets in before.items() if sub < FrameSub.TXPD}
        if row is profile.RX_PD and before[Rx.PUBLISHER] != after[Rx.PUBLISHER]:
            before[Rx.SOURCE] = b""  # as writing the publisher does
        for subindex in _REFERENCES.get(row.first, ()):
            if before[subindex] != after[subindex]:
                # _cleared_references has cleared it.
                before[subindex] = bytes(2)
        return before

    def _mapping(self, index: int) -> Iterator[EntryChange]:
        after = self._new.get(index, {})
        for subindex in sorted(after)[1:]:
            if not any(after[subindex]):
                continue  # a hole in a mapping that is being written; no client can write 0 there
            is_same = self._old.get(index, {}).get(subindex) == after[subindex]
            yield self._change(index, subindex, interim=is_same)
        if after and after[0] != _NONE:
            yield self._change(index, 0, interim=self._old.get(index, {}).get(0) == after[0])

    def _change(
        self, index: int, subindex: int, data: bytes | None = None, *, interim: bool = False
    ) -> EntryChange:
        """Return the change that writes *data*, or the value of the new dictionary."""
        before = self._old.get(index, {}).get(subindex)
        after = self._new.get(index, {}).get(subindex)
        goes = index not in self._new and subindex == 0
        kind = ChangeKind.CHANGED if before is not None else ChangeKind.ADDED
        if goes:
            kind = ChangeKind.REMOVED
        octets = after if data is None else data
        later = self._new_dictionary if index in self._new else self._old_dictionary
        shown = after if data is None or not interim else data
        old_text = _text(self._old_dictionary, index, subindex, before)
        new_text = "" if goes else _text(later, index, subindex, shown)
        is_again = kind is ChangeKind.CHANGED and old_text == new_text  # of a variable's other type
        return EntryChange(
            kind,
            index,
            subindex,
            self._title(index) if goes else self._name(index, subindex),
            old_text,
            new_text,
            octets or b"",
            interim or is_again,
        )

    def _title(self, index: int) -> str:
        """Return the title of an object and the name of its subject, such as ``TxPD 0 (state)``."""
        dictionary = self._new_dictionary if index in self._new else self._old_dictionary
        title, own = profile.row_of(index).title(index), dictionary.name_of(index)
        return f"{title} ({own})" if own else title

    def _name(self, index: int, subindex: int) -> str:
        """Return the names of object and entry, such as ``TxPD 0 (state): Cycle time``."""
        row = profile.row_of(index).row(subindex) if subindex else None
        entry = "number of entries" if row is None else row.numbered(subindex)
        return f"{self._title(index)}: {entry}"


def _without_empty_mappings(dictionary: EapDictionary) -> Configuration:
    """Return the configuration without empty mappings, which map nothing."""
    return {
        index: entries
        for index, entries in read_configuration(dictionary).items()
        if not (profile.row_of(index).mapping and len(entries) == 1)
    }


def _text(dictionary: EapDictionary, index: int, subindex: int, octets: bytes | None) -> str:
    if octets is None:
        return ""
    row = profile.row_of(index).row(subindex)
    kind = dictionary[index].entries[subindex].kind
    return to_text(row.form if row is not None else Form.PLAIN, kind, octets)
