"""Differences between two dictionaries of one port, in an order in which they can be written.

What refers to others is let go before they go, and set after they are there: that takes writes
which a person need not see.  Written one after the other into the old dictionary in PreOp, the
changes make the new one of it, and no frame is ever longer than in one of the two.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from enum import StrEnum

import msgspec

from eap.device.eap_dictionary import EapDictionary
from eap.device.eap_rules import MappingEntry
from eap.device.stored import Configuration, configuration
from eap.od.profiles import eap1000 as profile
from eap.od.profiles.eap1000 import FrameSub, Rx, Tx, Var
from eap.od.profiles.table import Form, ProfileObject, to_text

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
    """Of the object and the entry, for people."""
    old: str
    """Value in words; empty if there is none."""
    new: str
    data: bytes
    """What is to be written."""
    interim: bool = False
    """Whether people see no difference: it makes way for others, or repeats what they undo."""


def compare(old: EapDictionary, new: EapDictionary) -> list[EntryChange]:
    """Return what makes the configuration of *new* out of that of *old*."""
    return list(_Comparison(old, new).run())


class _Comparison:
    def __init__(self, old: EapDictionary, new: EapDictionary) -> None:
        self._old_dictionary, self._new_dictionary = old, new
        self._old, self._new = _kept(old), _kept(new)
        self._blank = new.blank()

    def run(self) -> Iterator[EntryChange]:
        """Yield all changes in their order."""
        yield from self._static()
        yield from self._removed(profile.TX_FRAME)
        yield from self._cut_lists()
        rewritten = self._mappings_to_write()
        yield from self._emptied(rewritten)
        yield from self._detached()
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
        """Shorten the lists of frames that lose a PD or change its place."""
        row = profile.TX_FRAME
        for index in self._both(row):
            if self._is_rewritten(index):
                data = bytes((row.fixed_count,))
                yield self._change(index, 0, data, interim=data != self._new[index][0])

    def _is_rewritten(self, index: int) -> bool:
        """Tell whether the list of a frame is more than continued."""
        before, after = self._old[index], self._new[index]
        return any(after.get(sub) != before[sub] for sub in before if sub >= FrameSub.TXPD)

    def _mappings_to_write(self) -> list[int]:
        """Return the mappings that change, or map variables whose type does or that go."""
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

    def _detached(self) -> Iterator[EntryChange]:
        """Let go references that change, and those between PDs that all go."""
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
        """Return what the object at *index* holds when its turn to be written comes."""
        after = self._new[index]
        if index in self._old:
            before = dict(self._old[index])
        else:
            fresh = self._blank.make(row, index)
            before = {sub: entry.octets for sub, entry in fresh.entries.items()}
        if row in profile.VARIABLES and before[Var.TYPE_NAME] != after[Var.TYPE_NAME]:
            entry = self._new_dictionary[index].entries[Var.DEFAULT]
            before |= {Var.DEFAULT_GIVEN: _NONE, Var.DEFAULT: entry.default}
        if row is profile.TX_FRAME and index in self._old and self._is_rewritten(index):
            before = {sub: octets for sub, octets in before.items() if sub < FrameSub.TXPD}
        if row is profile.RX_PD and before[Rx.PUBLISHER] != after[Rx.PUBLISHER]:
            before[Rx.SOURCE] = b""  # as writing the publisher does
        for subindex in _REFERENCES.get(row.first, ()):
            if before[subindex] != after[subindex]:
                before[subindex] = bytes(2)
        return before

    def _mapping(self, index: int) -> Iterator[EntryChange]:
        after = self._new.get(index, {})
        for subindex in sorted(after)[1:]:
            if not any(after[subindex]):
                continue  # a hole in one that is being written; no client can write it
            is_same = self._old.get(index, {}).get(subindex) == after[subindex]
            yield self._change(index, subindex, interim=is_same)
        if after and after[0] != _NONE:
            yield self._change(index, 0, interim=self._old.get(index, {}).get(0) == after[0])

    def _change(
        self, index: int, subindex: int, data: bytes | None = None, *, interim: bool = False
    ) -> EntryChange:
        """Make the change that writes *data*, or what the new dictionary has."""
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
        """Return the names of an object and of what it is about, such as ``TxPD 0 (state)``."""
        dictionary = self._new_dictionary if index in self._new else self._old_dictionary
        title, own = profile.row_of(index).title(index), dictionary.name_of(index)
        return f"{title} ({own})" if own else title

    def _name(self, index: int, subindex: int) -> str:
        """Return the names of object and entry, such as ``TxPD 0 (state): Cycle time``."""
        row = profile.row_of(index).row(subindex) if subindex else None
        entry = "number of entries" if row is None else row.numbered(subindex)
        return f"{self._title(index)}: {entry}"


def _kept(dictionary: EapDictionary) -> Configuration:
    """Return the configuration without mappings that hold nothing: they are as good as none."""
    return {
        index: entries
        for index, entries in configuration(dictionary).items()
        if not (profile.row_of(index).mapping and len(entries) == 1)
    }


def _text(dictionary: EapDictionary, index: int, subindex: int, octets: bytes | None) -> str:
    if octets is None:
        return ""
    row = profile.row_of(index).row(subindex)
    kind = dictionary[index].entries[subindex].kind
    return to_text(row.form if row is not None else Form.PLAIN, kind, octets)
