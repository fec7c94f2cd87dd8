"""Add-route requests: users, passwords, and the added routes."""

from __future__ import annotations

import asyncio
import logging
import os

import pytest

from eap.ams.routes import Origin
from eap.ams.spec import AmsUser, HopSpec, Role, RouteSpec, RoutingSpec, TransportKind
from eap.codec.ads import AdsError
from eap.codec.amsdiscovery import (
    TEMPORARY,
    Discovery,
    DiscoveryHeader,
    Tag,
    decode_discovery,
)
from eap.config.passwords import PasswordHash
from eap.config.users import AccountSection
from eap.ids import NetId
from eap.runtime.logins import FREE_FAILURES
from eap.runtime.store import StationStore
from eap.services.routing.station_routes import StationRoutes
from eap.services.transports.ams_discovery import RATES, RouteAdmin
from eap.services.transports.route_logins import RouteLogins
from tests.support.passwords import HASH
from tests.support.routing import station
from tests.support.vectors import load
from tests.support.virtualtime import run_virtual

ADD_ROUTE = decode_discovery(next(iter(load("ams_discovery"))).octets)
OWN = "10.0.0.1.2.1"
TOOL = NetId.parse("192.168.0.10.1.1")
ADDED = RouteSpec(
    name="myroute",
    net_id=str(TOOL),
    hop=HopSpec(TransportKind.AMS_TCP, "", "myhost:48898"),
    is_probed=False,
    is_client=True,
)


@pytest.fixture(autouse=True)
def state(tmp_path, monkeypatch):
    monkeypatch.setenv("EAP_STATE_DIR", str(tmp_path / "state"))


def routes(name="left", **told) -> StationRoutes:
    router = station(OWN, name=name)
    found = StationRoutes(router, RoutingSpec(**told), StationStore("demo", name).routes)
    found.start()
    return found


def ask(found, question=ADD_ROUTE, sender="10.0.0.5", *, is_this_host=False):
    route_admin = RouteAdmin([found], RouteLogins(), clock=lambda: 0.0)
    return asyncio.run(route_admin.handle(question, sender, is_this_host=is_this_host))


def asked(**tags) -> Discovery:
    """Return the request with other tags; None leaves one out."""
    new = {Tag[name.upper()]: data for name, data in tags.items()}
    kept = dict(ADD_ROUTE.tags) | new
    return Discovery(
        DiscoveryHeader(0, 0, 6, TOOL, 10_000),
        tuple((tag, data) for tag, data in kept.items() if data is not None),
    )


def user(tmp_path, content="1\n", name="Administrator") -> AmsUser:
    file = tmp_path / f"password-{name}"
    file.write_text(content)
    return AmsUser(name, str(file))


def test_a_program_of_this_host_adds_a_route_that_is_kept(caplog):
    with caplog.at_level(logging.INFO):
        assert ask(routes(), is_this_host=True) == AdsError.NONE
    again = routes()
    assert again.added == (ADDED,)
    assert [route.origin for route in again.router.table] == [Origin.ADDED]
    assert caplog.messages == [
        "route 'myroute' requested by 10.0.0.5: added, to 192.168.0.10.1.1 at myhost:48898"
    ]


def test_others_are_refused_as_long_as_there_are_no_users(caplog):
    found = routes()
    assert ask(found) == AdsError.ACCESS
    assert found.added == ()
    assert "the station has no users, so only this host may add routes" in caplog.text


@pytest.mark.parametrize("content", ["1", "1\n", "1\r\n", "1\nmore\n"])
@pytest.mark.parametrize("is_this_host", [True, False])
def test_user_with_password_adds_a_route(tmp_path, content, is_this_host):
    others = user(tmp_path, "x", "operator")
    found = routes(users=(others, user(tmp_path, content)))
    assert ask(found, is_this_host=is_this_host) == AdsError.NONE
    assert found.added == (ADDED,)


@pytest.mark.parametrize(
    "tags",
    [{"password": b"2\0"}, {"password": b""}, {"password": None}, {"user": b"admin\0"},
     {"user": None}, {"password": b"11\0"}, {"user": b"operator\0"}],
)  # fmt: skip
@pytest.mark.parametrize("is_this_host", [True, False])
def test_wrong_password_is_denied_from_this_host_too(tmp_path, caplog, tags, is_this_host):
    found = routes(users=(user(tmp_path, "x", "operator"), user(tmp_path)))
    assert ask(found, asked(**tags), is_this_host=is_this_host) == AdsError.ACCESS
    assert found.added == ()
    assert "or the password is wrong" in caplog.text


def test_unreadable_password_denies_all(tmp_path, caplog):
    found = routes(users=(AmsUser("Administrator", str(tmp_path / "gone")),))
    assert ask(found, asked(password=b"\0")) == AdsError.ACCESS
    assert "password of user Administrator: " in caplog.text
    os.mkfifo(tmp_path / "pipe")
    pipe = routes(users=(AmsUser("Administrator", str(tmp_path / "pipe")),))
    assert ask(pipe, asked(password=b"\0")) == AdsError.ACCESS
    assert "pipe: a password is kept in a regular file" in caplog.text
    empty = routes(users=(user(tmp_path, "\n"),))
    assert ask(empty, asked(password=b"\0")) == AdsError.ACCESS
    assert "its first line is empty" in caplog.text


@pytest.mark.parametrize(
    ("tags", "change"),
    [
        ({"host": None}, {"hop": HopSpec(TransportKind.AMS_TCP, "", "10.0.0.5:48898")}),
        (
            {"host": b"10.0.0.7:4000\0"},
            {"hop": HopSpec(TransportKind.AMS_TCP, "", "10.0.0.7:4000")},
        ),
        ({"route_name": None}, {"name": "myhost"}),
        ({"net_id": bytes((10, 0, 0, 1, 7, 7))}, {"net_id": "10.0.0.1.7.7", "octets": 6}),
    ],
)
def test_missing_fields_have_defaults(tags, change):
    found = routes()
    assert ask(found, asked(**tags), is_this_host=True) == AdsError.NONE
    [spec] = found.added
    assert {name: getattr(spec, name) for name in change} == change


@pytest.mark.parametrize(
    ("tags", "why"),
    [
        ({"net_id": None}, "the request has no NetID"),
        ({"net_id": b"12345"}, "the request has no NetID"),
        ({"net_id": bytes(6)}, "the request has no NetID"),
        ({"host": b"a b\0"}, "'a b' is no name of a host"),
        ({"host": b"239.1.1.1\0"}, "'239.1.1.1' is not the IPv4 address of a host"),
        ({"net_id": bytes(NetId.parse(OWN))}, "NetID 10.0.0.1.2.1 belongs to this station"),
    ],
)
def test_impossible_route_is_refused(caplog, tags, why):
    found = routes()
    assert ask(found, asked(**tags), is_this_host=True) == AdsError.VALUE
    assert found.added == ()
    assert why in caplog.text


def test_a_route_of_the_plant_file_stays_as_it_is():
    written = RouteSpec(
        name="tool", net_id=str(TOOL), hop=HopSpec(TransportKind.UDP, "eap0", "1.1.1.1")
    )
    found = routes(routes=(written,))
    assert ask(found, is_this_host=True) == AdsError.NONE
    assert found.added == ()


def test_a_temporary_route_is_gone_after_a_new_start():
    found = routes()
    options = TEMPORARY.to_bytes(4, "little")
    assert ask(found, asked(options=options), is_this_host=True) == AdsError.NONE
    assert found.added == (ADDED,)
    assert routes().added == ()


def test_a_route_that_cannot_be_kept_is_not_added(monkeypatch, caplog):
    monkeypatch.setenv("EAP_STATE_DIR", "/dev/null/x")
    found = routes()
    assert ask(found, is_this_host=True) == AdsError.INTERNAL
    assert found.added == ()
    assert "not added: station left: added routes cannot be kept" in caplog.text


def test_all_stations_of_an_address_get_the_route():
    both = [routes(), routes("right")]
    taking = RouteAdmin(both, RouteLogins()).handle(ADD_ROUTE, "127.0.0.1", is_this_host=True)
    assert asyncio.run(taking) == AdsError.NONE
    assert [each.added for each in both] == [(ADDED,), (ADDED,)]


def test_sender_is_audited():
    found, entries = routes(), []
    found.router.on_audit.append(entries.append)
    ask(found, asked(user=b"maria\0"))
    ask(found, is_this_host=True)
    refused = entries[0]
    assert (refused.endpoint, str(refused.header.target)) == (
        ("ams-udp", "10.0.0.5"),
        "10.0.0.1.1.1",
    )
    assert refused.operations[0].operation == ("myroute", str(TOOL), "myhost", "maria")
    assert refused.operations[0].decision.why.startswith("refused: the station has no users")
    assert [each.operations[0].result for each in entries] == [AdsError.ACCESS, AdsError.NONE]
    assert [each.operations[0].decision.is_allowed for each in entries] == [False, True]


class AdminHarness:
    """A route admin with a clock; *ask* returns the results of some requests of one sender."""

    def __init__(self) -> None:
        self.now = 0.0
        self.route_admin = RouteAdmin([routes()], RouteLogins(), clock=lambda: self.now)

    def ask(self, sender, count=1, *, is_this_host=False):
        takings = [
            self.route_admin.handle(ADD_ROUTE, sender, is_this_host=is_this_host)
            for _ in range(count)
        ]
        return [asyncio.run(each) for each in takings]


def test_route_admin_sender_guesses_passwords_is_limited():
    route_admin = AdminHarness()
    burst = RATES.source.burst
    assert route_admin.ask("10.0.0.5", burst + 2) == [AdsError.ACCESS] * burst + [None] * 2
    route_admin.now = 2.0
    assert route_admin.ask("10.0.0.5", 3) == [AdsError.ACCESS] * 2 + [None]


def test_route_admin_flood_of_one_sender_others_are_answered():
    route_admin = AdminHarness()
    route_admin.ask("10.0.0.5", 10 * RATES.source.burst)
    assert route_admin.ask("10.0.0.6") == [AdsError.ACCESS]
    assert route_admin.ask("127.0.0.1", is_this_host=True) == [AdsError.NONE]


def test_route_admin_flood_of_many_senders_known_ones_and_this_host_are_answered():
    route_admin = AdminHarness()
    assert route_admin.ask("10.0.0.5") == [AdsError.ACCESS]
    answers = [route_admin.ask(f"10.1.{number // 250}.{number % 250}") for number in range(5000)]
    assert answers.count([AdsError.ACCESS]) == RATES.new.burst - 1
    assert route_admin.ask("10.0.0.5") == [AdsError.ACCESS]
    assert route_admin.ask("127.0.0.1", is_this_host=True) == [AdsError.NONE]


def test_route_admin_known_senders_are_limited_together_and_new_ones_are_answered():
    route_admin = AdminHarness()
    senders = [f"10.0.0.{number}" for number in range(1, 30)]
    for sender in senders:
        route_admin.ask(sender)
        route_admin.now += 1.0
    answers = [
        each for sender in senders for each in route_admin.ask(sender, RATES.source.burst - 2)
    ]
    assert answers.count(AdsError.ACCESS) == RATES.known.burst
    assert route_admin.ask("10.0.1.1") == [AdsError.ACCESS]


@pytest.mark.parametrize(
    ("keys", "result"),
    [
        ({}, AdsError.NONE),
        ({"password": HASH}, AdsError.ACCESS),
        ({"password": ""}, AdsError.ACCESS),
        ({"role": Role.OPERATOR}, AdsError.ACCESS),
    ],
)
def test_user_without_a_file_is_an_engineer_of_the_plant(keys, result):
    right = {"role": Role.ENGINEER, "password": str(PasswordHash.of("1", bytes(16)))}
    account = AccountSection(name="Administrator", **(right | keys))
    found = routes(users=(AmsUser("Administrator"),))
    route_admin = RouteAdmin([found], RouteLogins([account]), clock=lambda: 0.0)
    assert asyncio.run(route_admin.handle(ADD_ROUTE, "10.0.0.5", is_this_host=False)) == result


def test_wrong_passwords_lock_the_user_out_at_its_host_and_are_reported(tmp_path, caplog):
    found, logins = routes(users=(user(tmp_path),)), RouteLogins()
    entries = []
    found.router.on_audit.append(entries.append)

    def try_route(request, sender="10.0.0.5"):
        route_admin = RouteAdmin([found], logins, clock=lambda: 0.0)
        return asyncio.run(route_admin.handle(request, sender, is_this_host=False))

    for _ in range(FREE_FAILURES):
        assert try_route(asked(password=b"guessed\0")) == AdsError.ACCESS
    assert try_route(ADD_ROUTE) == AdsError.ACCESS  # the right one, too late
    assert try_route(ADD_ROUTE, "10.0.0.6") == AdsError.NONE
    why = entries[-2].operations[0].decision.why
    assert why == "refused: locked after wrong passwords: user 'Administrator', for 30 s"
    refused = []

    async def report():
        async def send(news):
            refused.extend(news)
            raise asyncio.CancelledError

        with pytest.raises(asyncio.CancelledError):
            await logins.logins.report(send)

    run_virtual(report())
    assert [(each.user, each.host, str(each.why), each.count) for each in refused] == [
        ("Administrator", "10.0.0.5", "wrong", FREE_FAILURES),
        ("Administrator", "10.0.0.5", "locked", 1),
    ]
