"""How the connections of a listener are shared out."""

from __future__ import annotations

import pytest

from eap.appliance.services.ams.ams_shares import (
    MAX_CONNECTIONS,
    MAX_FOREIGN,
    MAX_OF_HOST,
    Shares,
    is_this_host,
)

OWN = "10.0.9.9"


def take(shares: Shares, host: str, count: int) -> str | None:
    for _ in range(count):
        why_not = shares.take(host, OWN)
        if why_not is not None:
            return why_not
    return None


@pytest.mark.parametrize("host", [OWN, "127.0.0.1"])
def test_programs_of_this_host_may_have_all(host: str) -> None:
    shares = Shares()
    assert take(shares, host, MAX_CONNECTIONS) is None
    why_not = f"there are {MAX_CONNECTIONS} already"
    assert shares.take(host, OWN) == shares.take("10.0.0.1", OWN) == why_not


def test_one_foreign_host_leaves_room_for_others() -> None:
    shares = Shares()
    assert take(shares, "10.0.0.1", MAX_OF_HOST) is None
    assert take(shares, "10.0.0.1", 1) == f"10.0.0.1 has {MAX_OF_HOST} already"
    assert take(shares, "10.0.0.2", 1) is None


def test_all_foreign_hosts_leave_room_for_this_one() -> None:
    shares = Shares()
    for number in range(MAX_FOREIGN):
        assert take(shares, f"10.0.0.{number}", 1) is None
    assert take(shares, "10.0.1.1", 1) == f"other hosts have {MAX_FOREIGN} already"
    assert take(shares, "127.0.0.1", MAX_CONNECTIONS - MAX_FOREIGN) is None


@pytest.mark.parametrize(("host", "limit"), [(OWN, MAX_CONNECTIONS), ("10.0.0.1", MAX_OF_HOST)])
def test_a_place_that_is_given_back_can_be_taken(host: str, limit: int) -> None:
    shares = Shares()
    for _ in range(3):
        assert take(shares, host, limit) is None
        assert take(shares, host, 1) is not None
        for _ in range(limit):
            shares.give_back(host)
    assert (shares._by_host, shares._foreign, shares._total) == ({}, 0, 0)


def test_this_host_is_known_by_its_address() -> None:
    assert is_this_host("127.9.2.1", "127.0.0.1")
    assert is_this_host("10.0.0.1", "10.0.0.1")
    assert not is_this_host("10.0.0.2", "10.0.0.1")
