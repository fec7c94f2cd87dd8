"""Two small stations, and what the processes make of them."""

from __future__ import annotations

import pytest

from eap.ids import InterfaceUri, NetId
from eap.net.image_file import StationImage, create_image
from eap.pd.layout import plan_layout
from eap.pd.spec import (
    CounterSource,
    PortKind,
    PortSpec,
    RxPdSpec,
    StationSpec,
    TxFrameSpec,
    TxPdSpec,
    VariableSpec,
    Writer,
)


def eap_port(number: int, interface: str = "", **more) -> PortSpec:
    interface = interface or f"udp://127.9.2.{number}"
    return PortSpec(
        "eap0",
        PortKind.EAP,
        InterfaceUri.parse(interface),
        NetId.parse(f"1.2.3.4.5.{number}"),
        **more,
    )


def left(port: PortSpec | None = None, destination: str = "127.9.2.2") -> StationSpec:
    pd = TxPdSpec("state", 7, ("ticks", "running", "setpoint", "name"))
    return StationSpec(
        "left",
        NetId.parse("1.1.1.1.1.1"),
        10_000,
        (port or eap_port(1),),
        variables=(
            VariableSpec("ticks", "UINT", Writer.ENGINE),
            VariableSpec("running", "BOOL"),
            VariableSpec("setpoint", "REAL[2]", unit="bar", comment="pressure"),
            VariableSpec("name", "STRING(8)", default="abc"),
            VariableSpec("load", "USINT", Writer.SERVICES),
        ),
        sources=(CounterSource("ticks"),),
        frames=(TxFrameSpec("out", "eap0", destination, (pd,)),),
    )


def right(port: PortSpec | None = None) -> StationSpec:
    names = ("ticks", "running", "setpoint", "name")
    types = ("UINT", "BOOL", "REAL[2]", "STRING(8)")
    return StationSpec(
        "right",
        NetId.parse("1.1.1.1.1.2"),
        10_000,
        (port or eap_port(2),),
        variables=tuple(
            VariableSpec(name, kind, Writer.ENGINE) for name, kind in zip(names, types, strict=True)
        ),
        subscriptions=(RxPdSpec("left-state", "eap0", 7, names, "1.2.3.4.5.1", step=1),),
    )


@pytest.fixture
def stations() -> tuple[StationSpec, StationSpec]:
    return left(), right()


@pytest.fixture
def files(tmp_path, stations):
    """The process images of both stations, by name."""
    opened = {s.name: create_image(tmp_path / f"{s.name}.image", plan_layout(s)) for s in stations}
    yield opened
    for file in opened.values():
        file.close()


@pytest.fixture
def images(files):
    """The same images, as services keeps them."""
    opened = {name: StationImage(file.path) for name, file in files.items()}
    yield opened
    for image in opened.values():
        image.close()
