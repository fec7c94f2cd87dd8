"""Roles of the clients of the control socket."""

from __future__ import annotations

import grp
import os
import pwd
import socket
from typing import Any

import pytest

from eap.ams.spec import Role
from eap.codec.ads import AdsRange, IndexGroup
from eap.codec.ams import AmsCommand
from eap.config.users import PlantUserSection
from eap.control.protocol import Request
from eap.runtime.logins import Principal
from eap.services.control import control_server
from eap.services.control.control_server import ControlPeer, PeerRoles

USERS = (
    PlantUserSection(name="anna", role=Role.ENGINEER, unix=("anna",)),
    PlantUserSection(name="shift", role=Role.OPERATOR, groups=("operators",)),
    PlantUserSection(name="panel", role=Role.ENGINEER, networks=("10.0.0.5",)),
)


@pytest.fixture
def host(monkeypatch):
    """User database with anna (700) and the operator otto (701)."""
    names, groups = {700: "anna", 701: "otto"}, {700: "anna", 80: "operators"}

    def account(uid):
        return pwd.struct_passwd((names[uid], "x", uid, uid, "", "", ""))

    monkeypatch.setattr(pwd, "getpwuid", account)
    monkeypatch.setattr(
        os, "getgrouplist", lambda name, gid: [gid, *([80] if name == "otto" else [])]
    )
    monkeypatch.setattr(grp, "getgrgid", lambda gid: grp.struct_group((groups[gid], "x", gid, [])))


def identify(monkeypatch, uid: int, users=USERS) -> Principal | None:
    monkeypatch.setattr(control_server, "process_of", lambda _: (9, uid))
    roles, (ours, theirs) = PeerRoles(users), socket.socketpair()
    with ours, theirs:
        peer = roles.own_peer(theirs) or roles.identify(theirs)
    assert peer is None or peer.text == f"uid {uid}, pid 9"
    return peer and peer.user


def test_peer_of_a_socket_has_its_process():
    ours, theirs = socket.socketpair()
    with ours, theirs:
        peer = PeerRoles().own_peer(theirs)
    assert peer == (f"uid {os.getuid()}, pid {os.getpid()}", ("", Role.ENGINEER))


def test_role_is_that_of_the_user_or_of_its_groups(monkeypatch, host):
    assert identify(monkeypatch, 700) == ("anna", Role.ENGINEER)
    assert identify(monkeypatch, 701) == ("shift", Role.OPERATOR)
    assert identify(monkeypatch, 702) is None
    assert identify(monkeypatch, 701, USERS[:1]) is None


def test_own_user_and_root_may_do_everything_and_so_may_all_without_users(monkeypatch):
    everything = Principal("", Role.ENGINEER)
    assert identify(monkeypatch, 0) == everything
    assert identify(monkeypatch, os.geteuid()) == everything
    assert identify(monkeypatch, 702, ()) == everything


def denied(role: Role, method: str, *, changes: bool = False, **params: Any) -> str:
    peer = ControlPeer("", Principal("otto", role))
    request = Request(v=1, method=method, params=params)
    roles = PeerRoles(USERS, ["press/set*"])
    return roles.reason_denied(peer, request, is_change=lambda: changes)


READ = AdsRange(IndexGroup.SDO, 0x10180001, 4).encode().hex()


@pytest.mark.parametrize(
    ("role", "method", "params"),
    [
        (Role.VIEWER, "status", {}),
        (Role.VIEWER, "subscribe", {"station": "press"}),
        (Role.VIEWER, "bus_ask", {"conversation": 1}),
        (Role.VIEWER, "bus_transfer", {"datagrams": []}),
        (Role.VIEWER, "ams_ask", {"command": AmsCommand.READ, "data": READ}),
        (Role.OPERATOR, "write", {"station": "press", "values": {"setpoint": 1}}),
        (Role.ENGINEER, "write", {"station": "press", "values": {"mode": 1}}),
        (Role.ENGINEER, "stop", {}),
        (Role.ENGINEER, "bus_ask", {"conversation": 1, "changes": True}),
    ],
)
def test_role_allows(role, method, params):
    assert denied(role, method, **params) == ""


@pytest.mark.parametrize(
    ("role", "method", "params", "why"),
    [
        (Role.VIEWER, "write", {"values": {}}, "otto is viewer, and write needs operator"),
        (Role.OPERATOR, "stop", {}, "otto is operator, and stop needs engineer"),
        (Role.OPERATOR, "fill", {}, "needs engineer"),
        (Role.OPERATOR, "note_logins", {}, "needs engineer"),
        (Role.OPERATOR, "a_method_of_a_later_release", {}, "needs engineer"),
        (Role.VIEWER, "bus_ask", {"changes": True}, "needs engineer"),
        (Role.OPERATOR, "bus_transfer", {"changes": True}, "needs engineer"),
        (Role.VIEWER, "ams_ask", {"command": AmsCommand.WRITE, "data": READ}, "needs engineer"),
        (Role.VIEWER, "ams_ask", {"command": AmsCommand.READ, "data": "0"}, "needs engineer"),
        (Role.VIEWER, "ams_ask", {"command": AmsCommand.READ, "data": 7}, "needs engineer"),
        (
            Role.OPERATOR,
            "write",
            {"station": "press", "values": {"setpoint": 1, "mode": 1}},
            "press/mode is set by engineers only",
        ),
        (
            Role.ENGINEER,
            "write",
            {"values": {}, "origin": {"user": "anna", "host": "10.0.0.9"}},
            "only programs of the appliance's user act for other users",
        ),
    ],
)
def test_role_denies(role, method, params, why):
    assert why in denied(role, method, **params)
