"""Hypothesis strategies for stations as plant files describe them, and their dictionaries."""

from __future__ import annotations

from typing import Any

from hypothesis import strategies as st

from eap.codec import datatypes
from eap.device.eap_dictionary import EapDictionary
from eap.device.eap_spec import fill
from eap.ids import InterfaceUri, NetId
from eap.pd.spec import (
    REQUESTER,
    Authentication,
    CounterSource,
    LengthCheck,
    LinkSpec,
    OnChangeSpec,
    PortKind,
    PortSpec,
    RxPdSpec,
    StationSpec,
    Substitute,
    TriggerSpec,
    TxFrameSpec,
    TxPdSpec,
    VariableSpec,
    Wake,
    Writer,
)

CYCLE_US = 10_000
TYPES = (
    "BOOL", "BIT3", "SINT", "UINT", "UDINT", "LINT", "REAL", "LREAL", "INT24", "UINT[3]",
    "REAL[2]", "STRING(5)", "BLOCK(7)", "BLOCK(100)", "BOOL[3]", "TIME", "LTIME[1..2]",
    "WSTRING(3)",
    "S<24/8:a@0 INT,f@2.1 BIT3,on@3 BOOL,p@4 P<3/1:x@0 BYTE,y@1 INT>[2],d@12 DT,r@16 LREAL>",
)  # fmt: skip
PORTS = (
    PortSpec(
        "eap0", PortKind.EAP, InterfaceUri.parse("udp://127.0.9.1"), NetId.parse("127.0.9.1.2.1")
    ),
    PortSpec(
        "eap1", PortKind.EAP, InterfaceUri.parse("ethernet://eth0"), NetId.parse("127.0.9.1.3.1")
    ),
)
BLANK = StationSpec("station", NetId.parse("127.0.9.1.1.1"), CYCLE_US, PORTS)
DESTINATIONS = {
    "udp": ("10.0.0.2", "10.0.0.2:4000", "239.1.2.3", "255.255.255.255", "tcp://10.0.0.3:5"),
    "ethernet": (
        "01:01:05:04:00:00",
        "02:00:00:00:00:07",
        "ff:ff:ff:ff:ff:ff",
        "5.5.5.5.2.1",
    ),
}
UNICAST = {"10.0.0.2", "10.0.0.2:4000", "02:00:00:00:00:07", "5.5.5.5.2.1"}


def empty(station: StationSpec = BLANK) -> dict[str, EapDictionary]:
    """Return an empty dictionary for each EAP port."""
    names = [port.name for port in station.ports if port.kind is PortKind.EAP]
    return {name: EapDictionary(station, name) for name in names}


def filled(
    station: StationSpec, like: dict[str, EapDictionary] | None = None
) -> dict[str, EapDictionary]:
    """Return the dictionaries of *station*."""
    dictionaries = empty(station)
    for name, each in dictionaries.items():
        fill(each, like[name] if like is not None else None)
    return dictionaries


def _default(draw: st.DrawFn, text: str) -> Any:
    kind = datatypes.parse(text)
    if draw(st.booleans()):
        return None
    if text.startswith("STRING"):
        return draw(st.text("abcxyz äö", max_size=3))
    if text.startswith("BLOCK"):
        return draw(st.binary(min_size=kind.size, max_size=kind.size)).hex()
    octets = bytes(draw(st.lists(st.integers(0, 0x3F), min_size=kind.size, max_size=kind.size)))
    return kind.to_plain(kind.decode(octets, 0))


@st.composite
def _variables(draw: st.DrawFn, prefix: str, count: int, writer: Writer) -> list[VariableSpec]:
    made = []
    for number in range(count):
        text = draw(st.sampled_from(TYPES))
        made.append(
            VariableSpec(
                f"{prefix}{number}",
                text,
                writer,
                _default(draw, text),
                draw(st.sampled_from(["", "degC"])),
                draw(st.sampled_from(["", "what it is"])),
            )
        )
    return made


@st.composite
def _triggers(draw: st.DrawFn) -> TriggerSpec:
    event = draw(st.booleans())
    match draw(st.integers(0, 3)):
        case 0:
            return TriggerSpec(event=event)
        case 1:
            return TriggerSpec(cycle_us=draw(st.integers(1, 5)) * CYCLE_US, event=event)
        case 2:
            divider = draw(st.integers(1, 9))
            modulo = draw(st.integers(0, divider - 1))
            return TriggerSpec(divider=divider, modulo=modulo, event=event)
    inhibit = draw(st.sampled_from([0, 500, 5000]))
    return TriggerSpec(on_change=OnChangeSpec(draw(st.sampled_from([0, 7])), inhibit), event=event)


def _fits(variables: list[VariableSpec], names: tuple[str, ...], limit: int) -> bool:
    types = {each.name: datatypes.parse(each.type) for each in variables}
    return datatypes.layout([types[name] for name in names]).size <= limit


@st.composite
def stations(draw: st.DrawFn) -> StationSpec:
    """Any station with two EAP ports whose every detail is drawn."""
    own = draw(_variables("own", draw(st.integers(0, 5)), Writer.APPLICATION))
    counter = [VariableSpec("counter", "UDINT", Writer.ENGINE)]
    follower = [VariableSpec("follower", "UDINT", Writer.ENGINE)]
    received = draw(_variables("got", draw(st.integers(0, 6)), Writer.ENGINE))
    ports = tuple(_port(draw, port) for port in PORTS)
    # Each PD takes some of what is received; a variable belongs to one PD.
    subscriptions, left = [], [each.name for each in received]
    for number in range(draw(st.integers(0, len(left)))):
        count = draw(st.integers(1, 3))
        names, left = tuple(left[:count]), left[count:]
        if names:
            subscriptions.append(_subscription(draw, number, names))
    unreceived = set(left)
    received = [each for each in received if each.name not in unreceived]
    variables = [*own, *counter, *follower, *received]
    frames, used = [], 0
    for number in range(draw(st.integers(0, 3))):
        port = draw(st.sampled_from(ports))
        requests = [each.name for each in subscriptions if each.port == port.name]
        answers = bool(requests) and draw(st.booleans())
        gate = not answers and draw(st.integers(0, 4)) == 0
        pds = []
        for _ in range(draw(st.integers(1, 3))):
            names = tuple(draw(st.lists(st.sampled_from(variables), min_size=1, max_size=6)))
            pds.append(
                TxPdSpec(
                    name=f"pd{used}",
                    pd_id=used + 1,
                    variables=tuple(each.name for each in names),
                    version=draw(st.integers(0, 3)),
                    trigger=TriggerSpec() if answers or gate else draw(_triggers()),
                    poll_request=draw(st.sampled_from(requests)) if answers else "",
                    changeable=draw(st.booleans()),
                )
            )
            used += 1
        scheme = port.interface.scheme
        target = REQUESTER if answers else draw(st.sampled_from(DESTINATIONS[scheme]))
        is_net_id = target.count(".") == 5
        is_monitored = target in UNICAST and draw(st.booleans())
        has_ip = is_monitored and scheme == "ethernet" and draw(st.booleans())
        frames.append(
            TxFrameSpec(
                name=f"frame{number}",
                port=port.name,
                destination=target,
                pds=tuple(pds),
                divider=4 if gate else 0,
                modulo=draw(st.integers(0, 3)) if gate else 0,
                changeable=draw(st.booleans()),
                mac=draw(st.sampled_from(("", "02:00:00:00:00:08"))) if is_net_id else "",
                monitor_interval_ms=draw(st.sampled_from([100, 5000])) if is_monitored else 0,
                monitor_ip="10.0.0.9" if has_ip else "",
                sign=draw(st.booleans()),
            )
        )
    return StationSpec(
        name="station",
        net_id=NetId.parse("127.0.9.1.1.1"),
        cycle_us=CYCLE_US,
        ports=ports,
        phase_us=draw(st.integers(0, CYCLE_US - 1)),
        variables=tuple(variables),
        sources=(CounterSource("counter"),),
        frames=tuple(frames),
        subscriptions=tuple(_asking(draw, subscriptions, frames)),
        links=(LinkSpec("counter", "follower"),),
    )


def _port(draw: st.DrawFn, port: PortSpec) -> PortSpec:
    is_udp = port.interface.scheme == "udp"
    vlan = 0 if is_udp else draw(st.sampled_from([0, 7, 4094]))
    groups = ("239.1.2.3", "224.0.0.9") if is_udp else ("01:00:5e:00:00:01",)
    return PortSpec(
        port.name,
        port.kind,
        port.interface,
        port.net_id,
        vlan_id=vlan,
        vlan_priority=draw(st.integers(0, 7)) if vlan else 0,
        join=tuple(draw(st.lists(st.sampled_from(groups), max_size=2, unique=True))),
        broadcast=is_udp and draw(st.booleans()),
        tcp=is_udp and draw(st.booleans()),
        wake=draw(st.sampled_from(Wake)),
        eap_sm=draw(st.booleans()),
        length=draw(st.sampled_from(LengthCheck)),
        profile=draw(st.sampled_from((0, 5002))),
    )


def _subscription(draw: st.DrawFn, number: int, names: tuple[str, ...]) -> RxPdSpec:
    return RxPdSpec(
        name=f"rx{number}",
        port=draw(st.sampled_from(PORTS)).name,
        pd_id=number + 1,
        variables=names,
        publisher=draw(st.sampled_from(["", "1.2.3.4.5.6"])),
        version=draw(st.integers(0, 3)),
        ignore_version=draw(st.booleans()),
        timeout_ms=draw(st.sampled_from([0, 50])),
        substitute=draw(st.sampled_from(Substitute)),
        sender_cycle_us=draw(st.sampled_from([0, 500])),
        step=draw(st.integers(0, 2)),
        changeable=draw(st.booleans()),
        source=draw(st.sampled_from(["", "10.0.0.1", "02:00:00:00:00:01"])),
        auth=draw(st.sampled_from(Authentication)),
    )


def _asking(
    draw: st.DrawFn, subscriptions: list[RxPdSpec], frames: list[TxFrameSpec]
) -> list[RxPdSpec]:
    """Make answers of some subscriptions that are no requests."""
    requests = {pd.poll_request for frame in frames for pd in frame.pds}
    made = []
    for each in subscriptions:
        questions = [
            pd.name
            for frame in frames
            for pd in frame.pds
            if frame.port == each.port and not pd.poll_request
        ]
        if questions and each.name not in requests and draw(st.booleans()):
            question = draw(st.sampled_from(questions))
            fields = {name: getattr(each, name) for name in each.__struct_fields__}
            made.append(RxPdSpec(**fields | {"poll_request": question, "step": 0}))
        else:
            made.append(each)
    return made
