from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from eap.ams.routes import MAX_FOUND, MAX_LEARNED, Origin, Route, RouteTable
from eap.ids import Endpoint, NetId

A, B, C = (Endpoint("tcp", name) for name in "abc")


def route(net_id: str, hop: Endpoint = A, **more: object) -> Route:
    return Route(NetId.parse(net_id), hop.connection, hop, **more)


def hop_of(table: RouteTable, net_id: str) -> Endpoint | None:
    found = table.find(NetId.parse(net_id))
    return found and found[0].hop


def test_longest_match_is_taken() -> None:
    table = RouteTable([
        route("0.0.0.0.0.0", Endpoint("mqtt", "rest"), octets=0),
        route("5.1.1.1.2.1", A),
        route("5.1.1.1.3.1", B, octets=5),
        route("5.1.1.1.3.2", C, octets=6),
    ])  # fmt: skip
    assert hop_of(table, "5.1.1.1.3.2") == C
    assert hop_of(table, "5.1.1.1.3.9") == B
    assert hop_of(table, "5.1.1.1.9.9") == A
    assert hop_of(table, "5.1.1.2.3.2") == Endpoint("mqtt", "rest")
    assert [table.find(NetId.parse(each))[1] for each in ("5.1.1.1.3.2", "5.1.1.1.3.9")] == [6, 5]
    assert hop_of(RouteTable([route("5.1.1.1.3.2", octets=6)]), "5.1.1.1.3.1") is None


def test_find_follows_changes_of_the_table() -> None:
    table = RouteTable([route("5.1.1.1.1.1", A)])
    assert hop_of(table, "5.1.1.1.2.1") == A
    assert hop_of(table, "6.1.1.1.1.1") is None
    table.add(route("5.1.1.1.2.1", B, octets=6))
    table.add(route("6.1.1.1.1.1", C))
    assert (hop_of(table, "5.1.1.1.2.1"), hop_of(table, "6.1.1.1.1.1")) == (B, C)
    table.remove(NetId.parse("5.1.1.1.2.1"), B)
    assert hop_of(table, "5.1.1.1.2.1") == A


def test_table_keeps_a_limited_number_of_found_routes() -> None:
    table = RouteTable([route("5.1.1.1.1.1", A)])
    for number in range(3 * MAX_FOUND):
        assert table.find(NetId((6, 0, 0, 0, number >> 8, number & 0xFF))) is None
        assert len(table._found) <= MAX_FOUND
    assert hop_of(table, "5.1.1.1.1.1") == A


def test_configured_routes_go_before_learned_ones() -> None:
    table = RouteTable([route("5.1.1.1.1.1", B, origin=Origin.LEARNED)])
    table.add(route("5.1.1.1.1.1", C, origin=Origin.ADDED))
    assert hop_of(table, "5.1.1.1.1.1") == C
    table.add(route("5.1.1.1.1.1", A))
    assert hop_of(table, "5.1.1.1.1.1") == A
    table.remove(NetId.parse("5.1.1.1.1.1"), A)
    assert hop_of(table, "5.1.1.1.1.1") == C
    assert not table.remove(NetId.parse("5.1.1.1.1.1"), A)
    assert len(table) == 2


def test_learned_route_never_replaces_a_configured_one() -> None:
    table = RouteTable([route("5.1.1.1.1.1", A)])
    assert not table.add(route("5.1.1.1.1.1", A, origin=Origin.LEARNED, expires_at_ns=5))
    assert [each.origin for each in table] == [Origin.STATIC]
    assert table.expire(9) == []


def test_learned_route_never_bypasses_a_configured_one() -> None:
    table = RouteTable([route("5.1.1.1.1.1", A), route("0.0.0.0.0.0", C, octets=0)])
    for net_id in ("5.1.1.1.2.1", "6.1.1.1.1.1"):
        table.add(route(net_id, B, origin=Origin.LEARNED))
    assert hop_of(table, "5.1.1.1.2.1") == A
    assert hop_of(table, "6.1.1.1.1.1") == B
    table.remove(NetId.parse("5.1.1.1.1.1"), A)
    assert hop_of(table, "5.1.1.1.2.1") == B


def test_learned_routes_expire_unless_renewed() -> None:
    table = RouteTable([route("5.1.1.1.1.1", A)])
    assert table.next_timeout() is None
    for expires_at_ns in (10, 20):
        assert table.add(
            route("6.1.1.1.1.1", B, origin=Origin.LEARNED, expires_at_ns=expires_at_ns)
        )
    assert table.next_timeout() == 10
    assert table.expire(9) == []
    assert table.expire(10) == []
    assert table.next_timeout() == 20
    assert [each.hop for each in table.expire(25)] == [B]
    assert hop_of(table, "6.1.1.1.1.1") is None
    assert table.next_timeout() is None


def test_learned_routes_are_limited() -> None:
    table = RouteTable()
    for number in range(MAX_LEARNED):
        net_id = NetId(number.to_bytes(4, "big") + b"\1\1")
        assert table.add(Route(net_id, "x", A, Origin.LEARNED, octets=6))
    assert not table.add(route("9.9.9.9.1.1", A, origin=Origin.LEARNED))
    assert table.add(route("9.9.9.9.1.1", A))


def test_virtual_net_ids_stand_for_real_ones() -> None:
    virtual = route("10.0.0.1.1.1", A, real=NetId.parse("5.1.1.1.1.1"))
    assert virtual.to_real(NetId.parse("10.0.0.1.1.1")) == NetId.parse("5.1.1.1.1.1")
    assert virtual.to_real(NetId.parse("10.0.0.1.3.2")) == NetId.parse("5.1.1.1.3.2")
    table = RouteTable([virtual])
    assert table.to_virtual(NetId.parse("5.1.1.1.3.2"), A) == NetId.parse("10.0.0.1.3.2")
    assert table.to_virtual(NetId.parse("5.1.1.1.3.2"), B) == NetId.parse("5.1.1.1.3.2")
    assert table.to_virtual(NetId.parse("7.1.1.1.3.2"), A) == NetId.parse("7.1.1.1.3.2")
    plain = route("5.1.1.1.1.1")
    assert plain.to_real(plain.net_id) == plain.net_id
    assert plain.to_virtual(plain.net_id) is None
    table.remove(virtual.net_id, A)
    assert table.to_virtual(NetId.parse("5.1.1.1.3.2"), A) == NetId.parse("5.1.1.1.3.2")


def test_routes_that_cannot_be_are_refused() -> None:
    with pytest.raises(ValueError, match="3 bytes to match"):
        route("5.1.1.1.1.1", octets=3)
    with pytest.raises(ValueError, match="default route"):
        route("5.1.1.1.1.1", octets=0, real=NetId(bytes(6)))


def test_routes_that_are_never_taken_are_named() -> None:
    table = RouteTable([route("5.1.1.1.1.1", A), route("5.1.1.1.1.1", B), route("7.1.1.1.1.1", C)])
    table.add(route("0.0.0.0.0.0", A, octets=0))
    table.add(route("0.0.0.0.0.0", B, octets=0))
    found = table.warnings({NetId.parse("7.1.1.1.1.1")})
    assert found[0] == (
        "route c (7.1.1.1.1.1, c by tcp) is never taken: the NetID is one of this station"
    )
    assert (
        "route b (5.1.1.1.1.1, b by tcp) is not taken for 5.1.1.1.1.1:"
        " a (5.1.1.1.1.1, a by tcp) is before it"
    ) in found
    assert any("NetIDs 5.1.1.1.x.x without a route of their own" in each for each in found)
    assert any("NetIDs without a route:" in each for each in found)
    harmless = RouteTable([route("5.1.1.1.1.1"), route("6.1.1.1.1.1"), route("5.1.1.1.2.1")])
    assert harmless.warnings() == []


octet = st.integers(1, 3)
net_ids = st.builds(lambda a, b, c: NetId((5, 1, 1, a, b, c)), octet, octet, octet)
routes = st.builds(
    Route,
    net_ids,
    st.just("r"),
    st.sampled_from([A, B, C]),
    st.sampled_from(Origin),
    st.sampled_from([6, 5, 4, 0]),
)


@given(st.lists(routes, max_size=20), st.lists(st.tuples(net_ids, st.sampled_from([A, B, C]))),
       net_ids)  # fmt: skip
def test_find_equals_linear_search(
    given_routes: list[Route], removed: list[tuple[NetId, Endpoint]], target: NetId
) -> None:
    table = RouteTable(given_routes)
    for key in removed:
        table.remove(*key)

    def match(each: Route) -> int:
        for level in (6, 5, 4):
            if level >= each.octets and each.octets and each.net_id[:level] == target[:level]:
                return level
        return 0 if each.octets == 0 else -1

    def goes_before_default(each: Route) -> int:
        if match(each) == 0:
            return 0
        return 1 if each.origin is Origin.LEARNED else 2

    fits = [each for each in table if match(each) >= 0]
    found = table.find(target)
    if not fits:
        assert found is None
        return
    best = max(fits, key=lambda each: (goes_before_default(each), match(each), -each.origin))
    assert found is not None
    assert (match(found[0]), found[0].origin) == (match(best), best.origin)
    assert found[1] == match(best)


def test_next_name_is_that_of_the_router_at_the_hop() -> None:
    near, far = NetId.parse("5.1.1.2.1.1"), NetId.parse("5.1.1.3.1.1")
    beyond = Route(far, "far", A, router=near)
    nameless = Route(NetId.parse("5.1.1.4.1.1"), "farther", B, router=near)
    rest = Route(NetId(bytes(6)), "default", A, octets=0, router=near)
    unknown = Route(NetId(bytes(6)), "default", C, octets=0)
    table = RouteTable([beyond, nameless, unknown])
    assert table.next_name(beyond) == "5.1.1.2.1.1"
    assert table.describe_hop(unknown) == f"default ({C})"
    direct = Route(near, "near", A)
    table.add(direct)
    assert [table.next_name(each) for each in (direct, beyond, rest)] == ["near"] * 3
    assert table.next_name(nameless) == "5.1.1.2.1.1", "the route to near is by another hop"
    assert table.describe_hop(beyond) == f"near ({A})"
    assert table.describe_beyond(beyond) == f"near ({A}) or from behind it"
    assert table.describe_beyond(direct) == f"near ({A})"


def test_next_name_of_a_virtual_net_id_is_that_of_its_route() -> None:
    real = NetId.parse("5.1.1.2.1.1")
    virtual = Route(NetId.parse("10.2.2.2.1.1"), "near", A, real=real, router=real)
    assert RouteTable([virtual]).next_name(virtual) == "near"
