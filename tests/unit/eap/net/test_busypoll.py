"""Event loop that polls before it sleeps: when, for how long, and functions of descriptors."""

from __future__ import annotations

import asyncio
import itertools
import os
import signal
import socket
import threading
from collections.abc import Iterator
from contextlib import ExitStack
from selectors import EVENT_READ, EpollSelector

import pytest

from eap.net.busypoll import (
    MAX_BACKOFF,
    MAX_FRUITLESS,
    MAX_ROUNDS,
    QUICK_NS,
    SPIN_LIMIT_NS,
    BusyPollLoop,
    BusyPollSelector,
    Event,
)

SOON_S = 0.0005


class Line:
    """A socket to which bytes come at given times; reading the clock takes a microsecond."""

    def __init__(self, *arrivals_ns: int) -> None:
        self.near, self.far = socket.socketpair()
        self.arrivals_ns = list(arrivals_ns)
        self.now_ns = 0
        self.looks = 0
        self.errors: list[Exception] = []
        self.selector = BusyPollSelector(self.errors.append, self.clock)
        self.selector.register(self.near, EVENT_READ, ("reader", None))

    def clock(self) -> int:
        self.looks += 1
        self.now_ns += 1000
        while self.arrivals_ns and self.arrivals_ns[0] <= self.now_ns:
            del self.arrivals_ns[0]
            self.far.send(b"x")
        return self.now_ns

    def wait(self) -> bool:
        """Return whether something came."""
        self.looks = 0
        found = self.selector.select(SOON_S)
        if found:
            self.near.recv(100)
        return bool(found)

    @property
    def has_polled(self) -> bool:
        return self.looks > 3

    def close(self) -> None:
        self.selector.close()
        self.near.close()
        self.far.close()


def take(sock: socket.socket) -> bytes:
    """Receive without waiting."""
    try:
        return sock.recv(1 << 16, socket.MSG_DONTWAIT)
    except BlockingIOError:
        return b""


@pytest.fixture
def line() -> Iterator[Line]:
    line = Line()
    yield line
    line.close()


def send_now(line: Line) -> None:
    line.far.send(b"x")


def test_selector_never_polls_after_rare_events(line, monkeypatch):
    def sleep(selector: EpollSelector, timeout: float | None) -> list[Event]:
        line.now_ns += QUICK_NS
        return found(selector, 0)

    found = EpollSelector.select
    monkeypatch.setattr(EpollSelector, "select", sleep)
    for _ in range(3):
        send_now(line)
        assert line.wait()
        assert not line.has_polled


def test_selector_polls_after_a_quick_event(line):
    send_now(line)
    assert line.wait()
    assert not line.has_polled
    line.arrivals_ns = [line.now_ns + SPIN_LIMIT_NS // 2]
    assert line.wait()
    assert line.has_polled


def test_selector_polls_no_longer_than_its_limit(line):
    send_now(line)
    line.wait()
    begin_ns = line.now_ns
    assert not line.wait()
    assert SPIN_LIMIT_NS <= line.now_ns - begin_ns < SPIN_LIMIT_NS + 5000


def test_selector_polls_no_longer_than_the_timeout(line):
    send_now(line)
    line.wait()
    line.looks = 0
    line.selector.select(0.000_01)
    assert 2 < line.looks < 20


def test_selector_with_timeout_zero_does_not_poll(line):
    send_now(line)
    line.wait()
    line.looks = 0
    assert line.selector.select(0) == []
    assert line.looks == 0


def test_selector_backs_off_after_fruitless_polls(line, monkeypatch):
    monkeypatch.setattr(EpollSelector, "select", lambda self, timeout: [])
    polled = []
    for _ in range(4 * MAX_BACKOFF):
        line.selector._is_quick = True
        line.wait()
        polled.append(line.has_polled)
    fruitless = [number for number, was in enumerate(polled) if was]
    rests = [after - before - 1 for before, after in itertools.pairwise(fruitless)]
    assert rests[:4] == [1, 2, 4, 8]
    assert max(rests) == MAX_BACKOFF


def test_selector_resets_its_backoff_after_a_fruitful_poll(line):
    line.selector._backoff = MAX_BACKOFF
    line.selector._is_quick = True
    line.arrivals_ns = [line.now_ns + SPIN_LIMIT_NS // 2]
    assert line.wait()
    assert line.selector._backoff == 1
    polled = []
    for _ in range(MAX_FRUITLESS + 1):
        line.selector._is_quick = False
        line.wait()
        polled.append(line.has_polled)
    assert polled == [True] * MAX_FRUITLESS + [False], "a quick sender may have been interrupted"


def test_selector_handles_descriptors_with_functions_inside(line):
    calls = []

    def handle() -> None:
        calls.extend(take(line.near))

    line.selector.modify(line.near, EVENT_READ, handle)
    send_now(line)
    assert line.selector.select(1) == []
    assert bytes(calls) == b"x"
    with_other, other = socket.socketpair()
    with with_other, other:
        line.selector.register(with_other, EVENT_READ, ("reader", None))
        send_now(line)
        other.send(b"y")
        assert [key.fileobj for key, _ in line.selector.select(1)] == [with_other]
        assert bytes(calls) == b"xx"


def test_selector_goes_on_polling_after_events_that_functions_handled(line):
    line.selector.modify(line.near, EVENT_READ, lambda: take(line.near))
    send_now(line)
    half_ns = SPIN_LIMIT_NS // 2
    line.arrivals_ns = [half_ns, 2 * half_ns, 3 * half_ns]
    assert line.selector.select(1) == []
    assert not line.arrivals_ns, "in one call"
    assert line.now_ns > 3 * half_ns + SPIN_LIMIT_NS


def test_selector_returns_when_a_function_gave_the_loop_work(line):
    def handle() -> None:
        take(line.near)
        line.selector.has_work = True

    line.selector.modify(line.near, EVENT_READ, handle)
    send_now(line)
    line.arrivals_ns = [SPIN_LIMIT_NS // 2]
    assert line.selector.select(1) == []
    assert line.arrivals_ns


def test_selector_returns_at_its_timeout_however_much_comes(line):
    line.selector.modify(line.near, EVENT_READ, lambda: take(line.near))
    send_now(line)
    line.arrivals_ns = list(range(0, 1_000_000, 5000))
    line.selector.select(0.0001)
    assert line.now_ns < 110_000


def test_selector_limits_the_events_without_the_loop(line):
    line.selector.modify(line.near, EVENT_READ, lambda: take(line.near))
    send_now(line)
    line.arrivals_ns = list(range(0, 1_000_000_000, 1000))
    left = len(line.arrivals_ns)
    line.selector.select(1)
    assert left - len(line.arrivals_ns) < 3 * MAX_ROUNDS**2


def test_selector_polls_the_latest_function_itself(line, monkeypatch):
    """It is called again without a look at the others, until it has nothing to do."""
    looked = []
    found = EpollSelector.select

    def look(selector: EpollSelector, timeout: float | None) -> list[Event]:
        looked.append(timeout)
        return found(selector, timeout)

    line.selector.modify(line.near, EVENT_READ, lambda: take(line.near))
    send_now(line)
    line.arrivals_ns = [line.now_ns + 10_000 + 1000 * number for number in range(5)]
    monkeypatch.setattr(EpollSelector, "select", look)
    line.selector.select(0.001)
    assert not line.arrivals_ns
    assert len(looked) < (line.now_ns - 5000) // 1000, "not for each of the arrivals"


def test_selector_calls_the_latest_function_so_many_times_only(line, monkeypatch):
    calls = []
    line.selector.modify(line.near, EVENT_READ, lambda: calls.append(1) or True)
    other, far = socket.socketpair()
    with other, far:
        line.selector.register(other, EVENT_READ, ("reader", None))
        send_now(line)
        monkeypatch.setattr(line.selector, "_is_quick", True)
        line.selector._latest = line.selector.get_key(line.near).data
        far.send(b"x")
        (event,) = line.selector.select(10)
    assert event[0].fileobj is other
    assert len(calls) <= MAX_ROUNDS + 1


def test_selector_returns_when_the_latest_function_gave_the_loop_work(line):
    def handle() -> bytes:
        line.selector.has_work = line.arrivals_ns == []
        return take(line.near)

    line.selector.modify(line.near, EVENT_READ, handle)
    line.selector._latest = handle
    line.selector._is_quick = True
    line.arrivals_ns = [3000]
    assert line.selector.select(100) == []
    assert line.now_ns < SPIN_LIMIT_NS


def test_selector_does_not_call_a_function_that_is_not_watched_any_more(line):
    calls = []

    def handle() -> bytes:
        calls.append(1)
        line.selector.unwatch(line.near.fileno())
        return take(line.near)

    line.selector.modify(line.near, EVENT_READ, handle)
    send_now(line)
    line.selector.select(0.001)
    line.selector._is_quick = True
    line.selector.select(0.001)
    assert calls == [1]


def test_selector_reports_the_error_of_a_function_and_goes_on(line):
    def fail() -> None:
        if take(line.near):
            raise ValueError("broken")

    line.selector.modify(line.near, EVENT_READ, fail)
    send_now(line)
    assert line.selector.select(1) == []
    assert [str(each) for each in line.errors] == ["broken"]


@pytest.mark.parametrize("how", ["watch", "add_reader"])
def test_loop_leaves_out_events_of_descriptors_that_another_event_replaced(how):
    """Two sockets are ready; the first to be handled replaces both by others."""

    async def serve() -> None:
        loop = asyncio.get_running_loop()
        assert isinstance(loop, BusyPollLoop)
        done = loop.create_future()
        add, remove = (
            (loop.watch, loop.unwatch) if how == "watch" else (loop.add_reader, loop.remove_reader)
        )
        calls = []

        def replace_both() -> None:
            calls.append("first")
            for near in nears:
                remove(near.fileno())
                near.detach()
            for fd, (other, far) in zip(fds, others, strict=True):
                os.dup2(other.fileno(), fd)
                add(fd, lambda: done.done() or done.set_result("the new one"))
                far.send(b"x")

        for near, far in zip(nears, fars, strict=True):
            add(near.fileno(), replace_both)
            far.send(b"x")
        assert await done == "the new one"
        assert calls == ["first"]
        for fd in fds:
            remove(fd)

    with ExitStack() as stack:
        pairs = [socket.socketpair() for _ in range(4)]
        for near, far in pairs:
            stack.callback(near.close)
            stack.callback(far.close)
        nears, fars = zip(*pairs[:2], strict=True)
        others = pairs[2:]
        fds = [near.fileno() for near in nears]
        for fd in fds:
            stack.callback(os.close, fd)
        with asyncio.Runner(loop_factory=BusyPollLoop) as runner:
            runner.run(serve())


def test_loop_calls_readers_and_writers_of_asyncio():
    async def serve() -> None:
        async def echo(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
            while octets := await reader.read(1 << 16):
                writer.write(octets)
                await writer.drain()
            writer.close()

        server = await asyncio.start_server(echo, "127.0.0.1", 0)
        reader, writer = await asyncio.open_connection(*server.sockets[0].getsockname())
        content = os.urandom(5_000_000)  # more than the socket buffers
        send = asyncio.create_task(_send(writer, content))
        assert await reader.readexactly(len(content)) == content
        await send
        writer.close()
        await writer.wait_closed()
        server.close()
        await server.wait_closed()

    with asyncio.Runner(loop_factory=BusyPollLoop) as runner:
        runner.run(serve())


async def _send(writer: asyncio.StreamWriter, content: bytes) -> None:
    writer.write(content)
    await writer.drain()


def test_loop_reports_the_error_of_a_reader():
    async def serve() -> str:
        loop = asyncio.get_running_loop()
        found = loop.create_future()
        loop.set_exception_handler(
            lambda _, context: found.done() or found.set_result(str(context["exception"]))
        )

        def fail() -> None:
            near.recv(1)
            raise ValueError("broken")

        loop.add_reader(near.fileno(), fail)
        far.send(b"a")
        return await found

    near, far = socket.socketpair()
    with near, far, asyncio.Runner(loop_factory=BusyPollLoop) as runner:
        assert runner.run(serve()) == "broken"


def test_loop_calls_a_watcher_until_it_is_removed():
    async def serve() -> None:
        loop = asyncio.get_running_loop()
        assert isinstance(loop, BusyPollLoop)
        received: asyncio.Queue[bytes] = asyncio.Queue()

        def handle() -> None:
            if octets := take(near):
                received.put_nowait(octets)

        loop.watch(near.fileno(), handle)
        for octet in (b"a", b"b"):
            far.send(octet)
            assert await received.get() == octet
        loop.unwatch(near.fileno())
        loop.unwatch(near.fileno())
        far.send(b"c")
        await asyncio.sleep(0.001)
        assert received.empty()

    near, far = socket.socketpair()
    with near, far, asyncio.Runner(loop_factory=BusyPollLoop) as runner:
        runner.run(serve())


def test_loop_hands_the_error_of_a_watcher_to_its_exception_handler():
    async def serve() -> None:
        loop = asyncio.get_running_loop()
        assert isinstance(loop, BusyPollLoop)
        found: asyncio.Queue[dict[str, object]] = asyncio.Queue()
        loop.set_exception_handler(lambda _, context: found.put_nowait(context))

        def fail() -> None:
            if take(near):
                raise ValueError("broken")

        loop.watch(near.fileno(), fail)
        far.send(b"a")
        context = await found.get()
        assert str(context["exception"]) == "broken"

    near, far = socket.socketpair()
    with near, far, asyncio.Runner(loop_factory=BusyPollLoop) as runner:
        runner.run(serve())


def test_loop_runs_what_a_watcher_scheduled_at_once():
    async def serve() -> None:
        loop = asyncio.get_running_loop()
        assert isinstance(loop, BusyPollLoop)
        done = loop.create_future()
        later = loop.create_future()

        def begin() -> None:
            if not take(near):
                return
            loop.call_soon(done.set_result, None)
            loop.call_later(0.001, later.set_result, None)

        loop.watch(near.fileno(), begin)
        far.send(b"a")
        async with asyncio.timeout(20):
            await asyncio.gather(done, later)

    near, far = socket.socketpair()
    with near, far, asyncio.Runner(loop_factory=BusyPollLoop) as runner:
        runner.run(serve())


@pytest.mark.parametrize("schedule", ["call_soon", "call_later"])
def test_loop_notes_what_is_scheduled(schedule):
    loop = BusyPollLoop()
    assert not loop._polling.has_work
    getattr(loop, schedule)(*(() if schedule == "call_soon" else (1,)), int)
    assert loop._polling.has_work
    loop.close()


def test_loop_that_is_closed_has_no_watchers():
    loop = BusyPollLoop()
    loop.close()
    loop.unwatch(0)


def test_loop_runs_at_once_what_another_thread_asks_for():
    loop = BusyPollLoop()
    thread = threading.Thread(target=loop.run_forever)
    thread.start()
    try:
        for _ in range(3):
            asked = asyncio.run_coroutine_threadsafe(asyncio.sleep(0, "done"), loop)
            assert asked.result(timeout=20) == "done"
    finally:
        loop.call_soon_threadsafe(loop.stop)
        thread.join(20)
    assert not thread.is_alive()
    loop.close()


def test_loop_handles_signals_while_nothing_else_happens():
    loop = BusyPollLoop()
    noted = []

    def note() -> None:
        noted.append(signal.SIGUSR2)
        loop.stop()

    loop.add_signal_handler(signal.SIGUSR2, note)
    # The signal comes while the loop sleeps; the alarm would end a loop that misses it.
    before = signal.signal(signal.SIGALRM, lambda *_: pytest.fail("the signal was missed"))
    signal.alarm(20)
    sender = threading.Timer(0.05, os.kill, (os.getpid(), signal.SIGUSR2))
    sender.start()
    try:
        loop.run_forever()
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)
        sender.join()
        loop.close()
    assert noted == [signal.SIGUSR2]
