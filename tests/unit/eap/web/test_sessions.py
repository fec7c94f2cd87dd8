from __future__ import annotations

from msgspec.structs import replace

from eap.ams.spec import Role
from eap.runtime.logins import Principal
from eap.web.sessions import SESSION_S, Sessions
from tests.support.webplant import USERS

KEY = bytes(range(32))


def sessions(users=USERS, key=KEY) -> Sessions:
    return Sessions(key, {each.name: each for each in users})


def test_session_is_found_until_it_expires():
    some = sessions()
    token = some.begin("otto", "n", 1000.0)
    assert some.find(token, 1000.0 + SESSION_S - 1) == Principal("otto", Role.OPERATOR)
    assert some.find(token, 1000.0 + SESSION_S) is None


def test_session_outlives_a_restart_and_not_another_password_user_or_key():
    token = sessions().begin("otto", "n", 0.0)
    assert sessions().find(token, 1.0) is not None
    changed = [replace(each, password="scrypt$other") for each in USERS]
    assert sessions(changed).find(token, 1.0) is None
    assert sessions(USERS[:1]).find(token, 1.0) is None
    assert sessions(key=bytes(32)).find(token, 1.0) is None


def test_role_is_the_present_one():
    token = sessions().begin("otto", "n", 0.0)
    promoted = [replace(each, role=Role.ENGINEER) for each in USERS]
    assert sessions(promoted).find(token, 1.0) == Principal("otto", Role.ENGINEER)


def test_every_changed_character_of_a_token_makes_it_wrong():
    some = sessions()
    token = some.begin("otto", "nonce", 0.0)
    for position in range(len(token)):
        other = "A" if token[position] != "A" else "B"
        assert some.find(token[:position] + other + token[position + 1 :], 1.0) is None, position
    for wrong in (
        "",
        ".",
        "x",
        token + "x",
        token + "=",
        "=" + token,
        "\n" + token,
        "é.é",
        "x" * 9999,
    ):
        assert some.find(wrong, 1.0) is None


def test_ended_session_is_found_no_more():
    some = sessions()
    token, other = some.begin("otto", "1", 0.0), some.begin("otto", "2", 0.0)
    some.end(token)
    assert (some.find(token, 1.0), some.find(other, 1.0) is None) == (None, False)


def test_csrf_tokens_differ_by_session():
    some = sessions()
    assert (
        len({some.csrf(""), some.csrf("a"), some.csrf("b"), sessions(key=bytes(32)).csrf("")}) == 4
    )
