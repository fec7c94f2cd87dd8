"""Plan of another configuration for a running station: its changes, checked before it is applied.

Nothing here runs anything: a plan holds dictionaries as they would be, for which nothing runs yet.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from typing import Any, NamedTuple

from msgspec.structs import asdict

from eap.device.configuration import (
    EntryChange,
    StoredError,
    compare,
    dump_configuration,
    load_configuration,
)
from eap.device.eap_dictionary import DeviceIdentity, EapDictionary
from eap.device.eap_spec import fill, read_back
from eap.device.rollout import bus_variables, kept_versions, without_alternates
from eap.pd.device import DeviceFault
from eap.pd.handover import describe_port_changes, needs_new_start, port_changes
from eap.pd.spec import (
    GatewayAddress,
    GatewaySpec,
    LinkSpec,
    PortKind,
    Source,
    StationSpec,
    Target,
    VariableSpec,
)
from eap.runtime.bus_change import describe_bus_changes
from eap.runtime.socket_plan import EVERY_ADDRESS
from eap.runtime.store import Configuration


class Plan(NamedTuple):
    """Changes that another configuration would make."""

    spec: StationSpec
    changes: list[tuple[str, EntryChange]]
    """Each with its port, in an order in which they could be written."""
    station: list[str]
    """Changes beside the dictionaries."""
    refused: list[str]
    """Reasons for which it cannot be applied."""
    dictionaries: Mapping[str, EapDictionary]
    """As they would be."""

    @property
    def is_empty(self) -> bool:
        """True if nothing would change."""
        return not (self.changes or self.station)

    def objects(self) -> dict[str, Any]:
        """Return the planned objects of the dictionaries, for the store."""
        return dump_all(self.dictionaries)


def eap_ports(spec: StationSpec) -> list[str]:
    """Return the names of the ports that have a dictionary."""
    return [port.name for port in spec.ports if port.kind is PortKind.EAP]


def dump_all(dictionaries: Mapping[str, EapDictionary]) -> dict[str, Any]:
    """Return the objects of *dictionaries*, for the store."""
    return {name: dump_configuration(each) for name, each in dictionaries.items()}


def fill_all(
    dictionaries: Mapping[str, EapDictionary],
    objects: Mapping[str, Any],
    like: Mapping[str, EapDictionary] | None = None,
) -> None:
    """Fill *dictionaries* with their stored objects, else from the specification of their station.

    Args:
        dictionaries: Empty ones, by port.
        objects: Stored objects, by port.
        like: Other dictionaries; an object with the same name there gets the same index.

    Raises:
        DeviceFault: there is no room for all of it.
    """
    for name, dictionary in dictionaries.items():
        # Stored objects keep the indexes that clients know; a new dictionary may number them
        # otherwise.
        if name in objects:
            try:
                load_configuration(dictionary, objects[name])
            except StoredError:
                pass
            else:
                continue
        fill(dictionary, None if like is None else like.get(name))


def make_plan(
    now: StationSpec, dictionaries: Mapping[str, EapDictionary], wanted: StationSpec,
    objects: Mapping[str, Any],
) -> Plan:  # fmt: skip
    """Return the plan to run *wanted*, with *objects* where they are given."""
    refused = find_refusals(now, wanted)
    if refused:
        return Plan(wanted, [], [], refused, {})
    identity = _identity_of(dictionaries)
    fresh = {name: EapDictionary(wanted, name, identity=identity) for name in eap_ports(wanted)}
    try:
        fill_all(fresh, objects, dictionaries)
        # As PreOp to SafeOp would: what cannot be read back must not be stored either.
        read_back(wanted, fresh)
    except DeviceFault as exc:
        return Plan(wanted, [], [], [str(exc)], {})
    except LookupError as exc:
        reason = f"the specification of {wanted.name} refers to {exc}, which it does not describe"
        return Plan(wanted, [], [], [reason], {})
    changes = [
        (name, change)
        for name, new in fresh.items()
        for change in compare(dictionaries.get(name) or new.blank(), new)
    ]
    return Plan(wanted, changes, describe_rest(now, wanted), [], fresh)


def _identity_of(dictionaries: Mapping[str, EapDictionary]) -> DeviceIdentity:
    """Return the identity that all ports of a station have."""
    return next((each.identity for each in dictionaries.values()), DeviceIdentity())


def plan_rollback(
    now: StationSpec, dictionaries: Mapping[str, EapDictionary], previous: Configuration | None,
    wanted: StationSpec | None = None,
) -> Plan:  # fmt: skip
    """Return the plan to run the previous configuration again.

    That is *wanted* if there are alternates to it, or else *wanted* is what runs now, with others.
    """
    if wanted is not None and without_alternates(wanted) == without_alternates(now):
        return make_plan(now, dictionaries, wanted, dump_all(dictionaries))
    if previous is None:
        reason = "there is nothing to go back to: it has run nothing else"
        return Plan(now, [], [], [reason], {})
    if wanted is not None and without_alternates(wanted) != without_alternates(previous.spec):
        return Plan(now, [], [], ["meanwhile it would go back to something else"], {})
    return make_plan(now, dictionaries, wanted or previous.spec, previous.objects)


def find_refusals(old: StationSpec, new: StationSpec) -> list[str]:
    """Return the changes that a running station cannot make; any of them prevents all others."""
    refused = needs_new_start(old, new)
    if old.net_id != new.net_id:
        refused.append(
            f"the station's router: net_id {old.net_id} -> {new.net_id}: restart the appliance"
        )
    changes = port_changes(old, new)
    for port in (*changes.gone, *changes.added):
        # Its AMS sockets occupy the port numbers at every address, for all stations.
        if port.interface.host == EVERY_ADDRESS:
            refused.append(
                f"port {port.name}: {port.interface} comes and goes at a start only: restart the"
                f" appliance"
            )
    return refused


def describe_rest(old: StationSpec, new: StationSpec) -> list[str]:
    """Return the changes beside the objects of the dictionaries, one line each."""
    on_bus = bus_variables(old) | bus_variables(new)
    return [
        *kept_versions(old, new),
        *describe_port_changes(old, new),
        *describe_bus_changes(old, new),
        *_gateway_changes(old, new),
        *_differences("source of", _source_name, old.sources, new.sources),
        *_differences("target of", _source_name, old.targets, new.targets),
        *_differences("link", _link_name, old.links, new.links),
        *_differences("variable", _variable_name, _chosen(old, on_bus), _chosen(new, on_bus)),
    ]


def _gateway_changes(old: StationSpec, new: StationSpec) -> Iterator[str]:
    before = {port.name: port.gateway or GatewaySpec() for port in old.ports}
    for port in new.ports:
        was, becomes = before.get(port.name), port.gateway or GatewaySpec()
        if was is None or was == becomes:
            continue
        settings = asdict(was)
        for field, value in asdict(becomes).items():
            if field != "addresses" and value != settings[field]:
                yield f"gateway of {port.name}: {field} {settings[field]} -> {value}"
        yield from _differences(
            f"gateway of {port.name}: address", _address_name, was.addresses, becomes.addresses
        )


def _address_name(address: GatewayAddress) -> str:
    return f"0x{address.address:04X}"


def _chosen(spec: StationSpec, names: set[str]) -> tuple[VariableSpec, ...]:
    return tuple(each for each in spec.variables if each.name in names)


def _source_name(source: Source | Target) -> str:
    return source.variable


def _link_name(link: LinkSpec) -> str:
    bits = f" bit {link.source_bit}" if link.source_bit else ""
    target_bits = f" bit {link.target_bit}" if link.target_bit else ""
    return f"{link.source}{bits} to {link.target}{target_bits}"


def _variable_name(variable: VariableSpec) -> str:
    return variable.name


def _differences(
    what: str, name_of: Callable[[Any], str], old: tuple[Any, ...], new: tuple[Any, ...]
) -> Iterator[str]:
    before = {name_of(each): each for each in old}
    after = {name_of(each): each for each in new}
    for name in before:
        if name not in after:
            yield f"{what} {name}: removed"
    for name, each in after.items():
        if name not in before:
            yield f"{what} {name}: added"
        elif before[name] != each:
            yield f"{what} {name}: changed"
