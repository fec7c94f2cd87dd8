"""Requests of services to an engine, which the test answers."""

from __future__ import annotations

import asyncio
import socket
from pathlib import Path

import msgspec
import pytest

from eap.errors import EngineGoneError, EngineRefusedError, EnvironmentalError
from eap.pd.device import DeviceState
from eap.pd.spec import StationSpec, record_from_lines
from eap.runtime.bus_errors import ErrorRecord
from eap.runtime.engine_messages import (
    Configure,
    EngineReply,
    EngineRequest,
    EngineStarted,
    SetState,
)
from eap.services.device.station_keeper import EngineClient
from eap.services.engine_link import EngineLink
from tests.unit.eap.conftest import left

pytestmark = pytest.mark.net


class Engine:
    """Answers each request with what *answer* makes of it, and notes it."""

    def __init__(self, answer):
        self.asked = []
        self.specs = []
        self.passed = []
        self._answer = answer
        self._sock, self.services = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._sock.setblocking(False)
        asyncio.get_running_loop().add_reader(self._sock, self._receive)

    def close(self):
        asyncio.get_running_loop().remove_reader(self._sock)
        self._sock.close()

    def _receive(self):
        request = msgspec.msgpack.decode(self._sock.recv(1 << 16), type=EngineRequest)
        self.asked.append(request)
        if isinstance(request, Configure):
            self.specs.append(record_from_lines(Path(request.path).read_bytes(), StationSpec))
        self._sock.send(msgspec.msgpack.encode(self._answer(request)))


def run(answer, ask, folder):
    """Return the engine after ``ask(client)``."""

    async def main():
        engine = Engine(answer)
        link = EngineLink(engine.services)
        try:
            await ask(EngineClient(link, folder, engine.passed.append))
        finally:
            link.close()
            engine.close()
        return engine

    return asyncio.run(main())


def done(request):
    return EngineReply(id=request.id)


def refused(request):
    return EngineReply(id=request.id, error=ErrorRecord("EngineRefusedError", "port eap0 is gone"))


def test_a_specification_crosses_as_a_file_that_is_gone_afterwards(tmp_path):
    engine = run(done, lambda client: client.configure("left", left()), tmp_path)
    assert engine.specs == engine.passed == [left()]
    assert engine.asked[0].station == "left"
    assert list(tmp_path.iterdir()) == []


def test_states_cross_as_numbers(tmp_path):
    engine = run(done, lambda client: client.set_state("left", DeviceState.SAFEOP), tmp_path)
    assert engine.asked == [SetState(id=engine.asked[0].id, station="left", state=4)]


@pytest.mark.parametrize(
    "ask",
    [
        lambda client: client.configure("left", left()),
        lambda client: client.set_state("left", DeviceState.OP),
    ],
)
def test_engine_client_raises_errors_of_the_engine(ask, tmp_path):
    with pytest.raises(EngineRefusedError, match=r"^port eap0 is gone$"):
        run(refused, ask, tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_engine_client_detects_a_restarted_engine(tmp_path):
    with pytest.raises(EngineGoneError, match="started again"):
        run(lambda _: EngineStarted(1), lambda client: client.configure("left", left()), tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_a_folder_that_cannot_be_written_is_named(tmp_path):
    with pytest.raises(EnvironmentalError, match=r"missing.*No such file"):
        run(done, lambda client: client.configure("left", left()), tmp_path / "missing")
