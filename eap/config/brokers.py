"""Brokers of a plant file: by which MQTT networks stations reach each other."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

from eap.aoe.spec import MqttSpec, TlsSpec
from eap.config.structs import Route, Station, Tls
from eap.ids import parse_host

URL = "mqtt://HOST[:PORT], or mqtts:// with TLS"
_PORTS = {"mqtt": 1883, "mqtts": 8883}


class Broker(NamedTuple):
    """Where a broker listens."""

    host: str
    port: int
    is_secret: bool
    """Whether it is reached by TLS although no ``tls`` says how."""


def parse_url(text: str) -> Broker:
    """Read the URL of a broker; raise ValueError if it is none."""
    scheme, separator, rest = text.partition("://")
    if not separator or scheme not in _PORTS:
        raise ValueError(f"{text!r} is no broker")
    if "@" in rest or "/" in rest:
        raise ValueError(f"{text!r} has more than a host and a port")
    host, port = parse_host(rest, _PORTS[scheme])
    return Broker(host, port, scheme == "mqtts")


def brokers_of(station: Station) -> list[Route]:
    """Return the entries of *station* that name a broker."""
    return [route for route in station.routes if route.mqtt]


def find_network(station: Station, network: str) -> Route | None:
    """Return by which entry *station* takes part in *network*."""
    return next((each for each in brokers_of(station) if each.network == network), None)


def shared_network(station: Station, other: Station) -> str:
    """Return the network by which two stations reach each other, empty if there is none.

    A network is the same if its name is: stations may know a broker, or the brokers of a cluster,
    by different addresses.
    """
    for each in brokers_of(station):
        if each.network and find_network(other, each.network) is not None:
            return each.network
    return ""


def broker_spec(route: Route, folder: Path) -> MqttSpec:
    """Return what services need to know of the broker of *route*; its files are in *folder*."""
    broker = parse_url(route.mqtt)
    tls = route.tls or (Tls() if broker.is_secret else None)
    return MqttSpec(
        network=route.network,
        host=broker.host,
        port=broker.port,
        user=route.user,
        password_file=_path(folder, route.password_file),
        tls=None if tls is None else _tls(tls, folder),
        client_id=route.client_id,
        no_retain=route.no_retain,
        is_unidirectional=route.unidirectional,
        qos=route.qos,
        is_prefixed=route.prefix,
    )


def _tls(tls: Tls, folder: Path) -> TlsSpec:
    return TlsSpec(
        ca=_path(folder, tls.ca),
        certificate=_path(folder, tls.certificate),
        key=_path(folder, tls.key),
        check_name=tls.check_name,
    )


def _path(folder: Path, file: str) -> str:
    return str((folder / file).resolve()) if file else ""
