"""Handover to a child process: everything arrives unchanged."""

from __future__ import annotations

import os

import pytest

from eap.ids import InterfaceUri, NetId
from eap.pd.spec import CounterSource, PortKind, PortSpec, StationSpec, VariableSpec, Writer
from eap.runtime.handover import (
    EngineOptions,
    Handover,
    PortName,
    SegmentHandover,
    SharedSocket,
    SocketKind,
)

PORT = PortSpec(
    "eap0", PortKind.EAP, InterfaceUri.parse("udp://127.0.0.1"), NetId.parse("1.2.3.4.5.6")
)
STATION = StationSpec(
    "a",
    NetId.parse("1.1.1.1.1.1"),
    1000,
    (PORT,),
    variables=(VariableSpec("x", "UINT", Writer.ENGINE, default=3),),
    sources=(CounterSource("x"),),
)


def handover() -> Handover:
    shared = SharedSocket(SocketKind.UDP, "127.0.0.1", 34980, owners=(PortName("a", "eap0"),))
    options = EngineOptions(realtime=False, cpu=1)
    return Handover(7, "/run/eap/demo", "demo", "demo.yaml", (STATION,), (shared,), options=options)


def test_crosses_in_a_file_without_a_name():
    fd = handover().to_descriptor()
    assert Handover.from_descriptor(fd) == handover()
    with pytest.raises(OSError, match="Bad file descriptor"):
        os.fstat(fd)


def test_a_segment_gets_its_own():
    given = SegmentHandover(7, "/plants/io.yaml", "digest", "/run/digest.slaves", 5, 6)
    assert SegmentHandover.from_descriptor(given.to_descriptor()) == given


def test_finds_a_port_by_name():
    assert handover().port(PortName("a", "eap0")) == PORT
