"""Quality of data that a station received and sends on."""

from __future__ import annotations

import pytest

from eap.codec.pd import iter_pds
from eap.pd.quality import QUALITY_MAX, find_origins
from eap.pd.spec import REQUESTER, LinkSpec, RxPdSpec, TxFrameSpec, TxPdSpec, VariableSpec, Writer
from eap.pd.station import Station
from tests.support.cyclic import MS, PEER, Wire, eap_port, image_of, octets, received, station

FIRST, SECOND = (
    RxPdSpec(name, "eap0", number, (variable,), PEER, sender_cycle_us=1000, step=1, timeout_ms=50)
    for number, name, variable in ((7, "first", "a"), (8, "second", "b"))
)


class Forwarder:
    """A station that receives ``a`` and ``b`` and sends PDs of the given variables, all 1 ms."""

    def __init__(self, *pds: tuple[str, ...], links: tuple[LinkSpec, ...] = ()) -> None:
        sent = tuple(TxPdSpec(f"p{n}", n, names) for n, names in enumerate(pds, 1))
        spec = station(
            ports=(eap_port("eap0"),),
            variables=(
                *received("a:UINT", "b:UINT"),
                VariableSpec("own", "UINT", Writer.ENGINE),
                VariableSpec("copy", "UINT", Writer.ENGINE),
                VariableSpec("flag", "BOOL", Writer.ENGINE),
            ),
            links=links,
            subscriptions=(FIRST, SECOND),
            frames=(TxFrameSpec("f", "eap0", "10.0.0.1", sent),),
        )
        self.image = image_of(spec)
        self.wire = Wire()
        self.station = Station(spec, self.image, lambda: None)
        self.wire.handlers.append(self.station.handlers["eap0"])
        self.station.connect("eap0", self.wire)
        self.now_ns = self.station.start(0)

    def cycle(self, *pds: tuple[int, bytes, int, int], count: int = 1) -> list[int]:
        """Receive one frame of *pds*, run *count* cycles, return the qualities sent last."""
        if pds:
            self.wire.waiting.append((octets(pds), self.now_ns))
        for _ in range(count):
            self.station.cycle(self.now_ns, self.now_ns)
            self.now_ns += MS
        return [header.quality for header, _ in iter_pds(self.wire.sent[-1])]


def test_forwarded_pd_carries_the_quality_of_its_source_plus_its_own_delay():
    station = Forwarder(("a",))
    assert station.cycle((7, b"\1\0", 0, 30)) == [30]  # sent on in the cycle that receives it
    assert station.cycle(count=4) == [70]
    assert station.cycle((7, b"\2\0", 0, 0)) == [0]


def test_forwarded_pd_of_data_that_never_came_has_the_largest_quality():
    station = Forwarder(("a",))
    assert station.cycle() == [QUALITY_MAX]
    assert station.cycle((7, b"\1\0", 0, 65_530)) == [65_530]
    assert station.cycle(count=2) == [QUALITY_MAX]


def test_forwarded_pd_of_several_sources_has_the_quality_of_the_oldest():
    station = Forwarder(("own", "a", "b"))
    station.cycle((7, b"\1\0", 0, 5), (8, b"\1\0", 0, 9))
    assert station.cycle((7, b"\2\0", 0, 5)) == [19]


def test_pd_of_own_values_has_quality_0_beside_a_forwarded_one():
    station = Forwarder(("own",), ("a", "flag"), ("own", "flag"))
    assert station.cycle((7, b"\1\0", 0, 12)) == [0, 12, 0]


@pytest.mark.parametrize(
    "links",
    [
        (LinkSpec("a", "own"), LinkSpec("own", "copy")),
        (LinkSpec("a", "copy", scale=2.0),),
        (LinkSpec("b", "copy", bits=4), LinkSpec("a", "copy", target_bit=8, bits=8)),
    ],
)
def test_quality_follows_links(links):
    station = Forwarder(("copy",), links=links)
    station.cycle((7, b"\1\0", 0, 3), (8, b"\1\0", 0, 1))
    assert station.cycle() == [13]


def test_polled_answer_carries_the_quality_of_its_source():
    spec = station(
        ports=(eap_port("eap0"),),
        variables=(*received("a:UINT", "b:UINT"), *received("ask:UINT")),
        subscriptions=(FIRST, SECOND, RxPdSpec("ask", "eap0", 9, ("ask",), PEER)),
        frames=(
            TxFrameSpec("f", "eap0", REQUESTER, (TxPdSpec("p", 1, ("a",), poll_request="ask"),)),
        ),
    )
    wire = Wire()
    made = Station(spec, image_of(spec), lambda: None)
    wire.handlers.append(made.handlers["eap0"])
    made.connect("eap0", wire)
    now_ns = made.start(0)
    wire.waiting.append((octets([(7, b"\1\0", 0, 4)]), now_ns))
    made.cycle(now_ns, now_ns)
    wire.waiting.append((octets([(9, b"\1\0")], cycle=1), now_ns + MS))
    made.cycle(now_ns + MS, now_ns + MS)
    assert [header.quality for header, _ in iter_pds(wire.sent[-1])] == [14]


def test_origins_are_found_through_members_and_elements():
    spec = station(
        variables=(
            *received("a:UINT", "b:UINT"),
            *(VariableSpec(name, "UINT[4]", Writer.ENGINE) for name in ("t", "u")),
        ),
        subscriptions=(FIRST, SECOND),
    )
    layout = image_of(spec).layout
    links = (LinkSpec("a", "t[2]"), LinkSpec("t[2]", "u[0]"), LinkSpec("b", "u[1]"))
    origins = {
        name: [slot.name for slot in slots] for name, slots in find_origins(layout, links).items()
    }
    assert origins == {
        "a": ["first"], "b": ["second"], "t": ["first"], "u": ["first", "second"]
    }  # fmt: skip
