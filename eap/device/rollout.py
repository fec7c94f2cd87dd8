"""Order in which stations change over, so that none receives a PD that it does not expect.

Rule 1: a station that receives a PD whose layout changes first accepts the old and the new layout
side by side.  If no other station depends on the rest of its new specification, it takes that over,
too.
Rule 2: then the senders change over, beginning with those that receive no old layout any more.
Rule 3: at the end no station accepts an old layout any longer.
Rule 4: among the orders that are left, a new PD is accepted before it is sent, and a PD that ends
is accepted until it is not sent any more.  While a rate changes, the receiver expects the smaller
one, so that no PD counts as lost that was never to be sent.

A station only ever runs its old or its new specification, either of them with alternates; so a
station needs at most three steps.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from itertools import chain
from math import inf
from typing import NamedTuple

from msgspec.structs import replace

from eap.codec import datatypes
from eap.pd.spec import (
    PortKind,
    RxAlternateSpec,
    RxPdSpec,
    SentVariableSpec,
    StationSpec,
    TxPdSpec,
)


class PdKey(NamedTuple):
    """Key of a PD: the NetID of the port that sends it, and its id."""

    publisher: str
    pd_id: int


class PdVariable(NamedTuple):
    """One variable; *bit_offset* counts from the start of the data."""

    name: str
    type: str
    bit_offset: int


class PdLayout(NamedTuple):
    """A version, and the variables that it stands for; *size* in bytes."""

    version: int
    size: int
    variables: tuple[PdVariable, ...]
    any_version: bool = False
    """True if a receiver accepts any other version, too."""


def lay_out(version: int, variables: Iterable[tuple[str, str]]) -> PdLayout:
    """Return the layout of *variables*, given by name and type in PDO order."""
    kinds = [(name, datatypes.parse(text)) for name, text in variables]
    plan = datatypes.layout(kind for _, kind in kinds)
    rows = zip(kinds, plan.bit_offsets, strict=True)
    return PdLayout(
        version, plan.size, tuple(PdVariable(name, kind.text, bit) for (name, kind), bit in rows)
    )


def sent_pds(spec: StationSpec) -> Iterator[tuple[PdKey, TxPdSpec, PdLayout]]:
    """Yield every PD that *spec* sends."""
    net_ids = {port.name: str(port.net_id) for port in spec.ports}
    types = types_of(spec)
    for frame in spec.frames:
        for pd in frame.pds:
            layout = lay_out(pd.version, ((name, types[name]) for name in pd.variables))
            yield PdKey(net_ids[frame.port], pd.pd_id), pd, layout


def types_of(spec: StationSpec) -> dict[str, str]:
    """Return the type of every variable of *spec* by name."""
    return {variable.name: variable.type for variable in spec.variables}


def bus_variables(station: StationSpec) -> set[str]:
    """Return the names of the variables that buses add to *station*.

    They are not configured in the dictionary; a Tx variable of the same name is one of them.
    """
    prefixes = tuple(f"{port.name}." for port in station.ports if port.kind is PortKind.BUS)
    return {each.name for each in station.variables if each.name.startswith(prefixes)}


def kept_versions(old: StationSpec, new: StationSpec) -> list[str]:
    """Return a message for every PD whose layout changes while its version does not.

    A subscriber that does not change, too, discards such a PD for its length or, worse, reads other
    variables from it than were sent.
    """
    before = {key: layout for key, _, layout in sent_pds(old)}
    lines = []
    for key, pd, layout in sent_pds(new):
        harm = _harm(before[key], layout) if key in before else ""
        if harm:
            lines.append(
                f"PD {pd.name!r} (id {pd.pd_id}) {harm}, but its version stays {pd.version}: "
                f"expected another version, so that every subscriber can tell"
            )
    return lines


def _harm(old: PdLayout, new: PdLayout) -> str:
    """Return the effect on a subscriber that reads *new* as *old*, empty for none."""
    if old.version != new.version:
        return ""
    if old.size != new.size:
        return (
            f"changes from {old.size} to {new.size} bytes, for which subscribers outside this "
            f"change discard it"
        )
    places = {each.name: (each.type, each.bit_offset) for each in old.variables}
    moved = any(
        places.get(each.name, (each.type, each.bit_offset)) != (each.type, each.bit_offset)
        for each in new.variables
    )
    if moved or [each[1:] for each in old.variables] != [each[1:] for each in new.variables]:
        return "keeps its size with other variables in it, which subscribers misread"
    return ""


class Step(NamedTuple):
    """Change of one station: *spec* is its next specification, *why* the reason for users."""

    station: str
    spec: StationSpec
    why: str


def steps(old: Mapping[str, StationSpec], new: Mapping[str, StationSpec]) -> list[Step]:
    """Return the steps from *old* to *new* in which receivers accept every PD that is sent.

    Stations that are equal in both, or only in one of them, need no step.  Between two steps the
    frames in flight have to arrive: configure a station, wait for its answer, continue.

    Args:
        old: Running specifications by station; they may hold alternates of an aborted change.
        new: Next specifications, in which every subscription accepts the PD of its publisher.
    """
    return _Rollout(old, new).run()


def without_alternates(spec: StationSpec) -> StationSpec:
    """Return *spec* without the alternates of a change in progress."""
    pds = tuple(replace(pd, alternates=()) for pd in spec.subscriptions)
    return spec if pds == spec.subscriptions else replace(spec, subscriptions=pds)


class _SentPds:
    """PDs that all stations send at one moment."""

    def __init__(self, specs: Mapping[str, StationSpec]) -> None:
        self._sent: dict[str, dict[PdKey, list[PdLayout]]] = {}
        self._senders: dict[int, dict[str, None]] = {}
        for name, spec in specs.items():
            self.update(name, spec)

    def update(self, station: str, spec: StationSpec) -> None:
        """Replace the PDs of *station* by those of *spec*."""
        sent = self._sent[station] = {}
        for key, _, layout in sent_pds(spec):
            sent.setdefault(key, []).append(layout)
            self._senders.setdefault(key.pd_id, {})[station] = None

    def sent_by(self, station: str) -> dict[PdKey, list[PdLayout]]:
        """Return the layouts of the PDs that *station* sends."""
        return self._sent.get(station, {})

    def received_by(self, station: str, pd: RxPdSpec) -> Iterator[tuple[str, PdKey, PdLayout]]:
        """Yield sender, key and layout of each PD that *pd* of *station* receives."""
        for sender in self._senders.get(pd.pd_id, {}):
            # A station changes its sending and its receiving side in one step.
            if sender == station:
                continue
            sent = self._sent[sender]
            keys = [key for key in sent if key.pd_id == pd.pd_id]
            for key in [PdKey(pd.publisher, pd.pd_id)] if pd.publisher else keys:
                yield from ((sender, key, layout) for layout in sent.get(key, ()))


class _Rollout:
    """The steps so far, and the specifications that run after them."""

    def __init__(self, old: Mapping[str, StationSpec], new: Mapping[str, StationSpec]) -> None:
        self._current = dict(old)
        self._new = new
        self._now = _SentPds(old)
        self._later = _SentPds(new)
        self._changed = [name for name in old if name in new and old[name] != new[name]]
        self._steps: list[Step] = []

    def run(self) -> list[Step]:
        senders = {name for name in self._changed if self._sends_differently(name)}
        waiting = []
        for name in self._changed:
            # Receivers first: a PD with a layout that no one accepts yet would be discarded.
            prepared = self._accept_layouts(name, self._current[name], self._later)
            if prepared == self._current[name]:
                waiting.append(name)
            elif name in senders or self._ending_senders(name) or self._faster_senders(name):
                self._step(name, prepared, "accepts old and new layouts; sends as before")
                waiting.append(name)
            else:
                self._change(name)
        self._change_in_order(waiting, senders)
        for name in self._changed:
            if self._current[name] != self._new[name]:
                self._step(name, self._new[name], "accepts no old layouts any more")
        return self._steps

    def _change_in_order(self, waiting: list[str], senders: set[str]) -> None:
        """Change all of *waiting* over: first those that need no alternates, then senders."""
        left = dict.fromkeys(waiting)
        old_senders = {name: self._senders_of_old(name) for name in waiting}
        best_after = {
            name: old_senders[name] | self._ending_senders(name) | self._faster_senders(name)
            for name in waiting
        }
        for name in waiting:
            for sender in (
                self._beginning_senders(name) | self._slower_senders(name)
            ) & best_after.keys():
                best_after[sender].add(name)
        while left:
            # Prefer stations that wait for no other, then those that lose no PD, then any sender.
            best = (name for name in left if not best_after[name] & left.keys())
            free = (name for name in left if not old_senders[name] & left.keys())
            name = next(chain(best, free, (name for name in left if name in senders), left))
            del left[name]
            self._change(name)

    def _change(self, name: str) -> None:
        """Change *name* to its new specification, with alternates for old layouts still sent."""
        new = self._accept_layouts(name, self._new[name], self._now)
        more = "" if new == self._new[name] else "; accepts old layouts too"
        self._step(name, new, f"runs the new configuration{more}")

    def _step(self, name: str, spec: StationSpec, why: str) -> None:
        self._current[name] = spec
        self._now.update(name, spec)
        self._steps.append(Step(name, spec, why))

    def _sends_differently(self, name: str) -> bool:
        now = self._now.sent_by(name)
        return any(now.get(key) != sent for key, sent in self._later.sent_by(name).items())

    def _senders_of_old(self, name: str) -> set[str]:
        """Return the senders of layouts that *name* will not accept after its change."""
        spec = self._new[name]
        types = types_of(spec)
        return {
            sender
            for pd in spec.subscriptions
            for sender, _, layout in self._now.received_by(name, pd)
            if not _accepts(_accepted_layouts(pd, types), layout)
        }

    def _ending_senders(self, name: str) -> set[str]:
        """Return the senders to *name* of PDs that end."""
        return _only_in(self._now, self._later, self._current[name])

    def _beginning_senders(self, name: str) -> set[str]:
        """Return the senders to *name* of PDs that begin."""
        return _only_in(self._later, self._now, self._new[name])

    def _slower_senders(self, name: str) -> set[str]:
        """Return the senders to *name* of PDs whose steps grow or are no longer fixed."""
        return self._senders_with_step(name, lambda old, new: old < new)

    def _faster_senders(self, name: str) -> set[str]:
        """Return the senders to *name* of PDs whose steps shrink."""
        return self._senders_with_step(name, lambda old, new: old > new)

    def _senders_with_step(self, name: str, compare: Callable[[float, float], bool]) -> set[str]:
        # No fixed step counts as infinitely rare: nothing can be lost then.
        old = {pd.name: pd.step or inf for pd in self._current[name].subscriptions}
        return {
            sender
            for pd in self._new[name].subscriptions
            if pd.name in old and compare(old[pd.name], pd.step or inf)
            for sender, _, _ in self._now.received_by(name, pd)
        }

    def _accept_layouts(self, name: str, spec: StationSpec, wire: _SentPds) -> StationSpec:
        """Return *spec* with alternates for the layouts on *wire* that *name* does not accept."""
        types = types_of(spec)
        pds = tuple(self._with_alternates(name, pd, types, wire) for pd in spec.subscriptions)
        return spec if pds == spec.subscriptions else replace(spec, subscriptions=pds)

    def _with_alternates(
        self, name: str, pd: RxPdSpec, types: Mapping[str, str], wire: _SentPds
    ) -> RxPdSpec:
        for _, _, layout in wire.received_by(name, pd):
            forms = _accepted_layouts(pd, types)
            if not _accepts(forms, layout):
                ours = self._own_names(name, pd, forms)
                if ours is not None:
                    pd = replace(pd, alternates=(*pd.alternates, _alternate(ours, layout)))
        return pd

    def _own_names(
        self, name: str, pd: RxPdSpec, forms: list[PdLayout]
    ) -> dict[tuple[str, str], str] | None:
        """Return the names in *pd* of *name* for the variables of its sender, by name and type.

        They follow from a layout that both have, now or later; None if there is none.  A PD that no
        station sends yet has no names, because it has no values to keep up to date.
        """
        for wire in (self._now, self._later):
            for _, _, layout in wire.received_by(name, pd):
                for form in forms:
                    if _accepts([form], layout):
                        return _names(form, layout)
        return None if any(self._now.received_by(name, pd)) else {}


def _only_in(wire: _SentPds, other: _SentPds, spec: StationSpec) -> set[str]:
    """Return the senders to *spec* of PDs that are on *wire* and not on *other*."""
    return {
        sender
        for pd in spec.subscriptions
        for sender, key, _ in wire.received_by(spec.name, pd)
        if key not in other.sent_by(sender)
    }


def _accepted_layouts(pd: RxPdSpec, types: Mapping[str, str]) -> list[PdLayout]:
    """Return the layout of *pd* itself and those of its alternates, with local names."""
    own = lay_out(pd.version, ((name, types[name]) for name in pd.variables))
    return [own._replace(any_version=pd.ignore_version)] + [
        lay_out(each.version, ((v.name, v.type) for v in each.variables)) for each in pd.alternates
    ]


def _accepts(forms: list[PdLayout], layout: PdLayout) -> bool:
    """Return whether one of *forms* accepts a PD of *layout*."""
    return any(
        form.size == layout.size and (form.any_version or form.version == layout.version)
        for form in forms
    )


def _names(form: PdLayout, layout: PdLayout) -> dict[tuple[str, str], str]:
    """Return the names in *form* of the variables of *layout* at equal offsets."""
    # Equal offset and type is all that a receiver can know: names are not on the wire.
    places = {(each.bit_offset, each.type): each.name for each in form.variables}
    return {
        (each.name, each.type): places[each.bit_offset, each.type]
        for each in layout.variables
        if (each.bit_offset, each.type) in places
    }


def _alternate(ours: dict[tuple[str, str], str], layout: PdLayout) -> RxAlternateSpec:
    """Return *layout* as an alternate with the local name of each variable, empty for none."""
    variables = (
        # pop: a variable that is sent twice fills its local one only once.
        SentVariableSpec(ours.pop((each.name, each.type), ""), each.type)
        for each in layout.variables
    )
    return RxAlternateSpec(layout.version, tuple(variables))
