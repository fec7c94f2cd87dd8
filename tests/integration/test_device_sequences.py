"""Any sequence of downloads, states, changes, refusals and restarts: all agree on what runs.

The engine is one that believes what it is told, refuses when the test says so, and dies in between;
dictionaries, state machine, store and start are the real ones.
"""

from __future__ import annotations

import asyncio
import shutil
import struct
import tempfile
from collections.abc import Awaitable, Callable
from contextlib import suppress
from typing import Any

import pytest
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, rule
from msgspec.structs import replace

from eap.device.eap_spec import read_back
from eap.errors import EngineGoneError, EngineRefusedError
from eap.ids import InterfaceUri, NetId
from eap.od.abort import SdoAbortError
from eap.od.profiles.eap1000 import FrameSub, Rx, Tx, Var
from eap.pd.device import DeviceState
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
from eap.runtime.store import adopt_plant_file, effective
from eap.services.device.station_device import StationDevice
from tests.support.examples import examples
from tests.support.stationengine import StationEngine, make_device

PORT = PortSpec(
    "eap0", PortKind.EAP, InterfaceUri.parse("udp://127.9.2.1"), NetId.parse("1.2.3.4.5.1")
)
PLANT_FILE = StationSpec(
    "left",
    NetId.parse("1.1.1.1.1.1"),
    10_000,
    (PORT,),
    variables=(
        VariableSpec("ticks", "UINT", Writer.ENGINE),
        VariableSpec("limit", "UINT", default=7),
        VariableSpec("level", "UDINT", Writer.ENGINE),
    ),
    sources=(CounterSource("ticks"),),
    frames=(
        TxFrameSpec(
            "out", "eap0", "127.9.2.2", (TxPdSpec("state", 7, ("ticks", "limit"), changeable=True),)
        ),
    ),
    subscriptions=(RxPdSpec("other", "eap0", 9, ("level",), "1.2.3.4.5.2"),),
)
OTHERS = (
    replace(PLANT_FILE, cycle_us=20_000),
    replace(PLANT_FILE, frames=()),
    replace(PLANT_FILE, subscriptions=(), variables=PLANT_FILE.variables[:2]),
    replace(PLANT_FILE, sources=(CounterSource("ticks", 2),)),
    replace(PLANT_FILE, ports=(replace(PORT, tcp=True),)),
    replace(PLANT_FILE, frames=(replace(PLANT_FILE.frames[0], pds=()),)),
)

WORD, LONG, OCTET = struct.Struct("<H"), struct.Struct("<I"), struct.Struct("<B")
DOWNLOADS = [
    (0x6000, Var.NAME, b"renamed"),
    (0x6001, Var.NAME, b"limit2"),
    (0x6001, Var.TYPE_NAME, b"UDINT"),
    (0x6002, Var.NAME, b"more"),
    (0x6002, 0, b"\0"),
    (0x7001, Var.NAME, b"level2"),
    (0x7001, Var.TYPE_NAME, b"REAL"),
    (0x1A00, 0, b"\0"),
    (0x1A00, 1, LONG.pack(0x6000_0110)),
    (0x1A00, 2, LONG.pack(0x6001_0110)),
    (0x1A00, 3, LONG.pack(0x6002_0110)),
    (0x1A00, 0, b"\1"),
    (0x1A00, 0, b"\2"),
    (0x1A00, 0, b"\3"),
    (0x1600, 0, b"\0"),
    (0x1600, 1, LONG.pack(0x7000_0120)),
    (0x1600, 0, b"\1"),
    (0x8000, FrameSub.DESTINATION_IP, b"\x7f\x09\x02\x09"),
    (0x8000, FrameSub.ENABLED, b"\0"),
    (0x8000, FrameSub.ENABLED, b"\1"),
    (0x8000, FrameSub.TXPD, WORD.pack(0)),
    (0x8000, FrameSub.TXPD, WORD.pack(0xD000)),
    (0x8000, FrameSub.TXPD + 1, WORD.pack(0xD001)),
    (0x8000, 0, OCTET.pack(FrameSub.TXPD)),
    (0xD000, Tx.PD_ID, WORD.pack(8)),
    (0xD000, Tx.PD_ID, WORD.pack(10)),
    (0xD000, Tx.CYCLE_TIME, LONG.pack(20_000)),
    (0xD000, Tx.CYCLE_TIME, LONG.pack(15_000)),
    (0xD000, Tx.CYCLE_TIME, LONG.pack(0)),
    (0xD000, Tx.PDO_INDEX, WORD.pack(0)),
    (0xD000, Tx.PDO_INDEX, WORD.pack(0x1A00)),
    (0xD001, Tx.PDO_INDEX, WORD.pack(0x1A00)),
    (0xD001, Tx.PD_ID, WORD.pack(10)),
    (0xD001, Tx.ENABLED, b"\1"),
    (0xD001, 0, b"\0"),
    (0xE000, Rx.PD_ID, WORD.pack(11)),
    (0xE000, Rx.PDO_INDEX, WORD.pack(0x1600)),
    (0xE000, 0, b"\0"),
    (0xE001, Rx.PD_ID, WORD.pack(12)),
    (0xF800, 8, LONG.pack(20_000)),
    (0xF810, 7, b"\1"),
    (0xF810, 7, b"\0"),
    (0xF200, 1, WORD.pack(2)),
    (0xF200, 1, WORD.pack(4)),
    (0xF200, 1, WORD.pack(8)),
    (0xF200, 1, WORD.pack(3)),
    (0x1000, 0, LONG.pack(1)),
    (0xD000, Tx.PD_ID, b"\1"),
]


class Sequences(RuleBasedStateMachine):
    """One station, from its plant file on."""

    def __init__(self) -> None:
        super().__init__()
        self.folder = tempfile.mkdtemp(prefix="eap-")
        self.patch = pytest.MonkeyPatch()
        self.patch.setenv("EAP_STATE_DIR", self.folder)
        self.loop = asyncio.new_event_loop()
        self.device: StationDevice | None = None

    def teardown(self) -> None:
        self.loop.run_until_complete(self.loop.shutdown_default_executor())
        self.loop.close()
        self.patch.undo()
        shutil.rmtree(self.folder)

    @initialize()
    def start(self) -> None:
        adopt_plant_file("demo", (PLANT_FILE,))
        ((spec, state),) = effective("demo", (PLANT_FILE,))
        self.engine = StationEngine(spec, state)
        self.start_services()

    def start_services(self) -> None:
        ((spec, state),) = effective("demo", (PLANT_FILE,))
        self.device, _ = make_device(spec, state, engine=self.engine)

    def run(self, job: Callable[[], Awaitable[Any]]) -> Any:
        """Do *job*; an engine that has died meanwhile is started again, and told."""
        try:
            return self.loop.run_until_complete(job())
        finally:
            self.engine.failure = None
            if self.engine.gone:
                ((self.engine.spec, self.engine.state),) = effective("demo", (PLANT_FILE,))
                self.loop.run_until_complete(self.device.resend())

    @rule(
        what=st.sampled_from(DOWNLOADS),
        trouble=st.sampled_from([None, None, None, EngineRefusedError, EngineGoneError]),
    )
    def download(self, what: tuple[int, int, bytes], trouble: Any) -> None:
        self.arrange(trouble)
        with suppress(SdoAbortError):
            self.run(lambda: self.device.download("eap0", *what))

    @rule(
        wanted=st.sampled_from([2, 4, 8, 8, 1]),
        trouble=st.sampled_from([None, None, None, EngineRefusedError, EngineGoneError]),
    )
    def request(self, wanted: int, trouble: Any) -> None:
        self.arrange(trouble)
        result = self.run(lambda: self.device.request_state(wanted))
        assert (result.fault is None) == (result.state == wanted)

    @rule(
        spec=st.sampled_from((PLANT_FILE, *OTHERS)),
        trouble=st.sampled_from([None, None, None, EngineRefusedError, EngineGoneError]),
    )
    def apply(self, spec: StationSpec, trouble: Any) -> None:
        self.arrange(trouble)
        before = self.device.spec
        plan, fault = self.run(lambda: self.device.apply(spec))
        is_done = not plan.refused and fault is None
        assert self.device.spec == (spec if is_done else before)

    @rule()
    def roll_back(self) -> None:
        self.arrange(None)
        self.run(self.device.roll_back)

    @rule()
    def restart_services(self) -> None:
        self.start_services()

    @rule()
    def restart_appliance(self) -> None:
        self.start()

    def arrange(self, trouble: Any) -> None:
        """Let the engine fail at its next chance."""
        self.engine.failure = trouble and trouble("as the test wants it")
        self.engine.gone = False

    @invariant()
    def all_agree(self) -> None:
        if self.device is None:
            return
        state = self.device.status.state
        assert self.engine.spec == self.device.spec
        assert self.engine.state is state
        assert effective("demo", (PLANT_FILE,)) == ((self.device.spec, state),)
        if state is not DeviceState.PREOP:
            assert read_back(self.device.spec, self.device.dictionaries) == self.device.spec


TestSequences = Sequences.TestCase
TestSequences.settings = examples(60, stateful_step_count=25)
