"""Layouts of a station's PDs, and their versions, by which a receiver tells them apart."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import NamedTuple

from eap.codec import datatypes, pdo
from eap.pd.spec import PortKind, StationSpec, TxPdSpec


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
    """A version, and the variables that it stands for; *size* in octets."""

    version: int
    size: int
    variables: tuple[PdVariable, ...]
    any_version: bool = False
    """Of what is received: whether another version fits as well."""


def lay_out(version: int, variables: Iterable[tuple[str, str]]) -> PdLayout:
    """Return the layout of *variables*, given by name and type in PDO order."""
    kinds = [(name, datatypes.parse(text)) for name, text in variables]
    plan = pdo.layout(kind for _, kind in kinds)
    rows = zip(kinds, plan.bit_offsets, strict=True)
    return PdLayout(
        version, plan.size, tuple(PdVariable(name, kind.text, bit) for (name, kind), bit in rows)
    )


def sent_pds(spec: StationSpec) -> Iterator[tuple[PdKey, TxPdSpec, PdLayout]]:
    """Yield every PD that *spec* sends."""
    net_ids = {port.name: port.net_id for port in spec.ports}
    types = types_of(spec)
    for frame in spec.frames:
        for pd in frame.pds:
            layout = lay_out(pd.version, ((name, types[name]) for name in pd.variables))
            yield PdKey(net_ids[frame.port], pd.pd_id), pd, layout


def types_of(spec: StationSpec) -> dict[str, str]:
    """Return the type of every variable of *spec* by name."""
    return {variable.name: variable.type for variable in spec.variables}


def bus_variables(station: StationSpec) -> set[str]:
    """Return the names of the variables that *station* has because of its buses.

    They are not configured here; a Tx variable of the same name is one of them.
    """
    prefixes = tuple(f"{port.name}." for port in station.ports if port.kind is PortKind.BUS)
    return {each.name for each in station.variables if each.name.startswith(prefixes)}


def kept_versions(old: StationSpec, new: StationSpec) -> list[str]:
    """Return a line for people on every PD whose layout changes while its version does not.

    A subscriber that is not changed too then discards the PD for its length or, worse, reads other
    variables out of it than were sent.
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
    """Return what happens to who takes *new* for *old*, empty for nothing."""
    if old.version != new.version:
        return ""
    if old.size != new.size:
        return (
            f"changes from {old.size} to {new.size} octets, for which subscribers outside this "
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
