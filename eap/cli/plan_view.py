"""Changes of a plant as lines for people.

island-02
  ~ 0xD000:07 TxPD 0 (state): Cycle time  10000 -> 20000 us
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from eap.cli.words import count
from eap.ids import ObjectId

if TYPE_CHECKING:
    from eap.appliance.commands.plant_change import Done
    from eap.appliance.commands.plant_link import StationPlan
    from eap.device.rollout import Step

_SIGNS = {"added": "+", "removed": "-", "changed": "~"}
_EMPTY = '""'


def plan_lines(plans: Sequence[StationPlan], order: Sequence[Step]) -> Iterator[str]:
    """Yield what differs, station by station, and what would be done in which order."""
    for each in plans:
        if each.differs:
            yield each.station
            yield from (f"  {line}" for line in map(change_line, _with_ports(each.changes)))
            yield from (f"  * {note}" for note in each.notes)
            yield from (f"  ! {reason}" for reason in each.refused)
    refusing = [each.station for each in plans if each.refused]
    differing = [each for each in plans if each.differs]
    if not differing:
        yield f"nothing differs: {_stations(plans)} as the file says"
        return
    kinds = [change["change"] for each in differing for change in each.changes]
    numbers = ", ".join(
        f"{kinds.count(kind)} {kind}" for kind in ("added", "removed", "changed") if kind in kinds
    )
    others = len(plans) - len(differing)
    yield (
        f"{count(len(differing), 'station')} of {len(plans)} to change"
        + (f" ({numbers})" if numbers else "")
        + (f", {others} as the file says" if others else "")
    )
    if refusing:
        yield f"cannot be applied: {', '.join(refusing)} refused"
    elif len(order) > 1:
        yield "'eapctl apply' goes these steps:"
        for number, step in enumerate(order, 1):
            yield f"  {number}. {step.station} {step.why}"


def change_line(change: dict[str, Any]) -> str:
    """Return one change of an object."""
    kind = change["change"]
    old, new = change["old"], change["new"]
    values = f"{old or _EMPTY} -> {new or _EMPTY}" if kind == "changed" else new
    unit = f" {change['unit']}" if values and change["unit"] else ""
    what = f"{_SIGNS[kind]} {ObjectId(change['index'], change['subindex'])} {change['name']}"
    return f"{what}  {values}{unit}".rstrip()


def done_lines(done: Done) -> Iterator[str]:
    """Yield what one step did."""
    outcome = done.outcome
    yield f"{done.station} {done.why}: {'ok' if outcome.ok else 'refused'}"
    for result in _with_ports(outcome.results):
        verdict = "ok" if result["ok"] else result["reason"]
        yield f"  {change_line(result)}  {verdict}"
    yield from (f"  ! {reason}" for reason in outcome.refused)


def end_lines(
    taken: Sequence[Done],
    refusing: Mapping[str, Sequence[str]],
    stations: int,
    *,
    is_broken_off: bool = False,
) -> Iterator[str]:
    """Yield what came of all steps, and what to do about it if these were not all.

    Args:
        taken: The steps.
        refusing: Why stations were not asked at all.
        stations: How many there are.
        is_broken_off: Whether there would have been more, had the appliance answered.
    """
    for name, reasons in refusing.items():
        yield f"{name} cannot change while it runs"
        yield from (f"  ! {reason}" for reason in reasons)
    refused = [each.station for each in taken if not each.outcome.ok]
    changed = dict.fromkeys(each.station for each in taken if each.outcome.ok)
    if not changed:
        yield "nothing was changed"
    else:
        others = stations - len(changed)
        rest = f", {others} as before" if others else ""
        yield f"{count(len(changed), 'station')} changed{rest}"
    if changed and (refused or is_broken_off):
        what = f"{', '.join(refused)} refused" if refused else "broken off"
        yield f"{what}: changed until then {_are(changed)}"
        yield "'eapctl apply' goes on with it, 'eapctl rollback' brings back what ran before"


def _are(names: Iterable[str]) -> str:
    listed = list(names)
    return f"{'is' if len(listed) == 1 else 'are'} {', '.join(listed)}"


def _with_ports(changes: Sequence[dict[str, Any]]) -> Iterator[dict[str, Any]]:
    """Yield *changes*, each with its port in front of its name if there is more than one port."""
    several = len({change["port"] for change in changes}) > 1
    for change in changes:
        yield change | {"name": f"{change['port']}: {change['name']}"} if several else change


def _stations(plans: Iterable[StationPlan]) -> str:
    names = [each.station for each in plans]
    return f"{names[0]} is" if len(names) == 1 else f"all {len(names)} stations are"
