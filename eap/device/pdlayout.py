"""What the PDs of a station look like to those who receive them."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import NamedTuple

from eap.codec import datatypes, pdo
from eap.pd.spec import StationSpec, TxPdSpec


class PdKey(NamedTuple):
    """What a PD is known by: the NetID of the port that sends it, and its id."""

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
