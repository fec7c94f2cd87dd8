"""Live view of a plant that runs: status, values and events while its processes are killed."""

from __future__ import annotations

import asyncio
import os
import signal
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator
from contextlib import aclosing

import pytest

from eap.control.protocol import READ, WRITE, ValuesEvent
from eap.errors import ControlError
from eap.live.client import LiveClient
from eap.live.findings import Severity
from eap.live.rows import station_rows
from eap.live.transport import ValuesSubscription
from eap.live.view import LiveReport, LiveView
from tests.support.appliance import Appliance, Plants, plants

pytestmark = pytest.mark.net

PLANT = """\
plant: live
defaults: {cycle_us: 10000}
stations:
  - name: one
    net_id: 127.9.42.1.1.1
    ports:
      - {name: eap0, kind: eap, interface: "udp://127.9.42.1", net_id: 127.9.42.1.2.1}
    variables:
      ticks: UDINT
      setpoint: {type: UINT, unit: degC, default: 5}
    sources: {ticks: {kind: counter}}
    frames: [{name: out, port: eap0, to: two/eap0}]
    publish: [{name: state, frame: out, id: 1, variables: [ticks, setpoint]}]
  - name: two
    net_id: 127.9.42.2.1.1
    ports:
      - {name: eap0, kind: eap, interface: "udp://127.9.42.2", net_id: 127.9.42.2.2.1}
    subscribe: [{name: from-one, port: eap0, from: one/state, timeout_ms: 200}]
"""


@pytest.fixture(scope="module")
def folder() -> Iterator[Plants]:
    with plants() as found:
        yield found


@pytest.fixture(scope="module")
def running(folder: Plants) -> Appliance:
    return folder.run(folder.write(PLANT))


@pytest.fixture
def plant(running: Appliance, monkeypatch: pytest.MonkeyPatch) -> Appliance:
    monkeypatch.setenv("EAP_RUNTIME_DIR", str(running.runtime))
    return running


def play(script: Callable[[LiveView], Awaitable[None]]) -> None:
    async def run() -> None:
        async with asyncio.timeout(60), LiveView() as view:
            await script(view)

    asyncio.run(run())


async def reports(view: LiveView, until: Callable[[LiveReport], object]) -> list[LiveReport]:
    """Return reports until the first that fits."""
    found = []
    while True:
        found.append(await view.take())
        if until(found[-1]):
            return found
        await asyncio.sleep(0.05)


def texts(found: list[LiveReport]) -> list[str]:
    return [event.text for report in found for event in report.events]


def is_well(report: LiveReport) -> bool:
    return all(each.severity is not Severity.ERROR for each in report.status.findings)


def test_view_shows_stations_with_rates(plant: Appliance) -> None:
    async def script(view: LiveView) -> None:
        (*_, first) = await reports(view, lambda report: report.status.stations)

        def rates(report: LiveReport) -> list[float | None]:
            rows = station_rows(report.status, first.status)
            return [rows[0].tx_per_s, rows[1].rx_per_s]

        last = (await reports(view, lambda report: all(rates(report))))[-1]
        assert rates(last) == pytest.approx([100, 100], abs=40)
        assert [row.state for row in station_rows(last.status)] == ["OP", "OP"]
        assert last.unreachable == {}

    play(script)


def test_client_calls_methods_of_the_control_protocol(plant: Appliance) -> None:
    async def script(view: LiveView) -> None:
        await reports(view, lambda report: report.status.stations)
        client = view.client_of("live", "one")
        await client.call(WRITE, station="one", values={"setpoint": 7})
        assert (await client.call(READ, station="one", names=["setpoint"])).values == {
            "setpoint": 7
        }
        with pytest.raises(ControlError, match="did you mean one"):
            await client.call(READ, station="on")
        with pytest.raises(ControlError, match="station three of plant live does not run"):
            view.client_of("live", "three")

    play(script)


def test_client_watches_values_over_a_restart_of_services(plant: Appliance) -> None:
    async def values(client: LiveClient) -> AsyncIterator[ValuesEvent]:
        wanted = ValuesSubscription(station="one", names=("ticks", "setpoint"), period_ms=20)
        async with aclosing(client.watch(wanted)) as events:
            async for event in events:
                if isinstance(event, ValuesEvent):
                    yield event

    async def script(view: LiveView) -> None:
        await reports(view, lambda report: report.status.stations)
        stream = values(view.client_of("live", "one"))
        async with aclosing(stream):  # type: ignore[type-var]
            first = await anext(stream)
            second = await anext(stream)
            assert second.values["ticks"] > first.values["ticks"]
            os.kill(plant.pid("services"), signal.SIGKILL)
            after = await anext(stream)
            while after.cycle < second.cycle + 100:
                after = await anext(stream)
            assert set(after.values) == {"ticks", "setpoint"}

    play(script)


def test_slow_consumer_gets_one_event_with_the_latest_values(plant: Appliance) -> None:
    async def script(view: LiveView) -> None:
        await reports(view, lambda report: report.status.stations)
        client = view.client_of("live", "one")
        changes = ValuesSubscription(
            station="one", names=("ticks",), period_ms=10, only_changes=True
        )
        async with aclosing(client.watch(changes)) as events:
            first = await anext(events)
            await asyncio.sleep(0.5)  # the consumer does something else
            second, third = await anext(events), await anext(events)
            assert isinstance(first, ValuesEvent)
            assert isinstance(second, ValuesEvent)
            assert isinstance(third, ValuesEvent)
            assert second.values["ticks"] > first.values["ticks"] + 20
            assert third.cycle > second.cycle

    play(script)


@pytest.mark.parametrize("process", ["engine", "services"])
def test_killed_process_is_an_event_in_words(plant: Appliance, process: str) -> None:
    async def script(view: LiveView) -> None:
        await reports(view, lambda report: report.status.stations)
        os.kill(plant.pid(process), signal.SIGKILL)
        found = await reports(
            view, lambda report: any("was restarted" in each.text for each in report.events)
        )
        assert any(
            each.startswith(f"live {process}: ended and was restarted") for each in texts(found)
        )
        await reports(view, lambda report: not report.unreachable and is_well(report))

    play(script)


def test_appliance_that_ends_is_waited_for(folder: Plants, monkeypatch: pytest.MonkeyPatch) -> None:
    path = folder.write(
        PLANT.replace("127.9.42", "127.9.43").replace("live", "short"), "short.yaml"
    )
    appliance = folder.run(path)
    monkeypatch.setenv("EAP_RUNTIME_DIR", str(appliance.runtime))

    async def script(view: LiveView) -> None:
        assert (await view.take()).unreachable == {}
        appliance.process.kill()
        appliance.process.wait()
        gone = await reports(view, lambda report: report.unreachable)
        assert "short: has ended: waiting for it to run again" in texts(gone)
        with folder.start(path, runtime=appliance.runtime) as again:
            await asyncio.to_thread(again.wait_ready)
            back = await reports(view, lambda report: not report.unreachable)
            assert any(each.startswith("short: answers again after") for each in texts(back))
            again.stop()

    play(script)
