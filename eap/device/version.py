"""Versions of PDs: the one sign by which a receiver knows that its variables lie elsewhere now."""

from __future__ import annotations

from eap.device.pdlayout import PdLayout, sent_pds
from eap.pd.spec import StationSpec


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
