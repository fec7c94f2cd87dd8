"""What is kept of a station that was configured while it ran, and the file it is kept in."""

from __future__ import annotations

import time
from functools import cache
from typing import Any

import msgspec

from eap.aoe.spec import RoutingSpec
from eap.appliance.durable import digest, seal, unseal
from eap.errors import ConfigError
from eap.pd.device import DeviceState
from eap.pd.spec import Record, StationSpec

VERSION = 1


class Configuration(Record, frozen=True, kw_only=True):
    """One whole configuration of a station."""

    base: str
    """``digest_of`` the station in the plant file that was in force then."""
    spec: StationSpec
    """What the engine runs."""
    objects: dict[str, Any] = msgspec.field(default_factory=dict)
    """Content of the dictionary of each EAP port, by its name; a port that is missing here has
    what follows from *spec*."""


class Stored(Configuration, frozen=True, kw_only=True):
    """The configuration in force and the one before it."""

    state: DeviceState = DeviceState.OP
    """Asked for last."""
    applied: str = ""
    """``digest_of`` the station in the appliance's own plant file, if that was applied while it ran
    (and edited before); empty if it was not."""
    previous: Configuration | None = None
    """For a rollback."""
    cause: str = ""
    """Which change brought it; the same at all stations that one ``apply`` changed."""
    undone: bool = False
    """Whether *cause* was rolled back: *previous* is what it had brought."""


def new_cause() -> str:
    """Return a name for a change; those of later changes sort behind it."""
    return f"{time.time_ns():020d}"


def digest_of(spec: StationSpec | RoutingSpec) -> str:
    """Return what tells *spec* from any other.

    Fields that hold their defaults do not count: a release that adds one does not change it.
    """
    return digest(msgspec.json.encode(_lean(spec)))


def encode_stored(stored: Stored) -> bytes:
    """Return the octets of a file."""
    return seal(msgspec.json.encode(stored), VERSION)


def decode_stored(data: bytes) -> Stored:
    """Read the octets of a file; raise ConfigError that says what is wrong with them."""
    content = unseal(data, VERSION)
    try:
        return msgspec.json.decode(content, type=Stored)
    except msgspec.MsgspecError as exc:
        raise ConfigError(f"it holds no configuration: {exc}") from None


def _lean(value: Any) -> Any:
    """Return *value* for JSON, records without the fields that hold their defaults."""
    if isinstance(value, msgspec.Struct):
        tag, defaults = _outline(type(value))
        lean = {"kind": tag} if tag is not None else {}
        for name, default in defaults:
            held = getattr(value, name)
            if held != default:
                lean[name] = _lean(held)
        return lean
    if isinstance(value, tuple):
        return [_lean(each) for each in value]
    return value


@cache
def _outline(kind: type[msgspec.Struct]) -> tuple[Any, tuple[tuple[str, Any], ...]]:
    """Return the tag of records of *kind*, and their fields with their defaults."""
    fields = msgspec.structs.fields(kind)
    return kind.__struct_config__.tag, tuple((field.name, field.default) for field in fields)
