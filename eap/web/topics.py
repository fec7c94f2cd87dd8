"""Messages of the WebSocket, made once for all clients that want the same.

A topic is a page, a set of variables, the plant's overview or its events.  Each message has all
that is present in its part of a topic, so a client may miss any number of messages: of each part,
only the latest waits for it.
"""

from __future__ import annotations

import asyncio
import math
from array import array
from collections.abc import Iterable
from time import monotonic, time
from typing import Any, NamedTuple

import msgspec

from eap.config.web import names_in, trend_windows
from eap.config.web_sections import (
    PicturePanel,
    SetPanel,
    StatesPanel,
    TablePanel,
    TrendPanel,
    ValuePanel,
    WebPage,
)
from eap.suggest import suggest
from eap.web.feed import FAST_MS, SLOW_MS, PlantFeed

MAX_TOPICS = 8
"""Of a client."""
MAX_TOPIC = 400
"""Characters of a topic."""
_MAX_FAST_NAMES = 400
"""Of a set of variables with more of them all are sent once a second."""
_MAX_DISTINCT = 256
"""Topics of all clients."""
PLANT, EVENTS = "plant", "events"
_PAGE, _VALUES = "page:", "values:"


class TopicPart(NamedTuple):
    """Part of a topic whose messages replace each other."""

    topic: str
    period_ms: int


class PendingMessages:
    """Messages to one client that were not sent yet: the latest of each part."""

    def __init__(self) -> None:
        self._messages: dict[TopicPart, bytes] = {}
        self._has_some = asyncio.Event()

    def put(self, part: TopicPart, message: bytes) -> None:
        """Replace the message of *part*."""
        self._messages[part] = message
        self._has_some.set()

    async def take(self) -> list[bytes]:
        """Wait for messages and return them."""
        await self._has_some.wait()
        self._has_some.clear()
        messages, self._messages = self._messages, {}
        return list(messages.values())


class _Topic:
    """A topic that some client wants."""

    def __init__(self, name: str, fast: tuple[str, ...], slow: tuple[str, ...]) -> None:
        self.name = name
        self.patterns = {FAST_MS: fast, SLOW_MS: slow}
        self.names: dict[int, list[str]] = {FAST_MS: [], SLOW_MS: []}
        self.clients: set[PendingMessages] = set()
        self.latest: dict[TopicPart, bytes] = {}

    def resolve(self, feed: PlantFeed) -> None:
        fast = feed.resolve(self.patterns[FAST_MS])
        slow = [name for name in feed.resolve(self.patterns[SLOW_MS]) if name not in set(fast)]
        if len(fast) > _MAX_FAST_NAMES:
            fast, slow = [], fast + slow
        self.names = {FAST_MS: fast, SLOW_MS: slow}


class TopicError(ValueError):
    """A client asked for a topic that there is not."""


class PageTopics:
    """Topics of all clients, and the histories of trends.

    Args:
        feed: The plant.
    """

    def __init__(self, feed: PlantFeed) -> None:
        self._feed = feed
        self._pages: dict[str, WebPage] = {}
        self._topics: dict[str, _Topic] = {}
        self._windows: dict[str, int] = {}
        self.histories: dict[str, VariableHistory] = {}
        self._version = -1
        self._tick = 0

    def set_pages(self, pages: Iterable[WebPage]) -> None:
        """Serve these pages; those before are forgotten."""
        pages = tuple(pages)
        self._pages = {page.name: page for page in pages}
        self._windows = trend_windows(pages)
        for name, topic in self._topics.items():
            if name.startswith(_PAGE) and (page := self._pages.get(name.removeprefix(_PAGE))):
                fast, slow = patterns_of(page)
                topic.patterns = {FAST_MS: fast, SLOW_MS: slow}
        self._version = -1

    def replace(self, client: PendingMessages, wanted: Iterable[str]) -> dict[str, str]:
        """Have a client get the *wanted* topics and no others; return reasons of unknown ones."""
        errors: dict[str, str] = {}
        found: dict[str, _Topic] = {}
        for name in dict.fromkeys(wanted):
            if len(found) == MAX_TOPICS:
                errors[name[:MAX_TOPIC]] = f"a connection has {MAX_TOPICS} topics at most"
                continue
            try:
                found[name] = self._topics.get(name) or self._open(name)
            except TopicError as exc:
                errors[name[:MAX_TOPIC]] = str(exc)
        for name, topic in list(self._topics.items()):
            if client in topic.clients and name not in found:
                topic.clients.discard(client)
        for name, topic in found.items():
            self._topics[name] = topic
            topic.clients.add(client)
        self._drop_unwanted()
        self._version = -1
        self._refresh()
        for topic in found.values():
            for part in self._parts(topic):
                # A new client does not wait for the next round to see something.
                client.put(part, topic.latest.get(part) or self._encode(topic, part))
        return errors

    def leave(self, client: PendingMessages) -> None:
        """Forget a client."""
        for topic in self._topics.values():
            topic.clients.discard(client)
        self._drop_unwanted()
        self._version = -1

    async def run(self) -> None:
        """Send values until cancelled."""
        clock = asyncio.get_running_loop().time
        due_s = clock()
        while True:
            self._refresh()
            self._record()
            periods = [FAST_MS] if self._tick % (SLOW_MS // FAST_MS) else [FAST_MS, SLOW_MS]
            self._tick += 1
            for topic in list(self._topics.values()):
                if topic.name in {PLANT, EVENTS}:
                    continue
                for period_ms in periods:
                    if topic.names[period_ms]:
                        self._send(topic, TopicPart(topic.name, period_ms))
            # After a delay the next round is due at once; those that were missed are not made up.
            due_s = max(due_s + FAST_MS / 1000, clock())
            await asyncio.sleep(due_s - clock())

    def status_changed(self) -> None:
        """Send overview and events after a status report."""
        if (topic := self._topics.get(PLANT)) is not None:
            self._send(topic, TopicPart(PLANT, SLOW_MS))
        if self._feed.report is not None and self._feed.report.events:
            self.send_events()

    def send_events(self) -> None:
        """Send the events after there are new ones."""
        if (topic := self._topics.get(EVENTS)) is not None:
            self._send(topic, TopicPart(EVENTS, SLOW_MS))

    def _send(self, topic: _Topic, part: TopicPart) -> None:
        # Encoded once: the cost of a page does not grow with the browsers that show it.
        message = topic.latest[part] = self._encode(topic, part)
        for client in topic.clients:
            client.put(part, message)

    def _encode(self, topic: _Topic, part: TopicPart) -> bytes:
        head: dict[str, Any] = {"topic": topic.name, "time": round(time(), 3)}
        if topic.name == PLANT:
            return msgspec.json.encode({"type": "plant", **head, **self._feed.overview()})
        if topic.name == EVENTS:
            return msgspec.json.encode({"type": "events", **head, "events": self._feed.events()})
        now_s, shown = monotonic(), self._feed.shown
        values = {name: shown(name, now_s) for name in topic.names[part.period_ms]}
        return msgspec.json.encode({"type": "values", **head, "values": values})

    def _parts(self, topic: _Topic) -> list[TopicPart]:
        if topic.name in {PLANT, EVENTS}:
            return [TopicPart(topic.name, SLOW_MS)]
        return [TopicPart(topic.name, period) for period, names in topic.names.items() if names]

    def _open(self, name: str) -> _Topic:
        if len(name) > MAX_TOPIC:
            raise TopicError(f"a topic has {MAX_TOPIC} characters at most")
        # Each topic is encoded in every period, however few clients want it.
        if len(self._topics) >= _MAX_DISTINCT:
            raise TopicError(f"all clients together have {_MAX_DISTINCT} topics at most")
        if name in {PLANT, EVENTS}:
            return _Topic(name, (), ())
        if name.startswith(_PAGE):
            page = self._pages.get(name.removeprefix(_PAGE))
            if page is None:
                wanted = name.removeprefix(_PAGE)
                raise TopicError(f"unknown page {wanted!r}{suggest(wanted, self._pages)}")
            return _Topic(name, *patterns_of(page))
        if name.startswith(_VALUES):
            patterns = tuple(filter(None, name.removeprefix(_VALUES).split(",")))
            if not all("/" in pattern for pattern in patterns):
                raise TopicError(f"{name!r}: expected values:STATION/VARIABLE, with * for any text")
            return _Topic(name, patterns, ())
        raise TopicError(f"unknown topic {name!r}: expected plant, events, page:… or values:…")

    def _drop_unwanted(self) -> None:
        self._topics = {name: topic for name, topic in self._topics.items() if topic.clients}

    def _refresh(self) -> None:
        """Look the names of all topics up again after a change."""
        if self._version == self._feed.directory_version:
            return
        self._version = self._feed.directory_version
        for topic in self._topics.values():
            topic.resolve(self._feed)
            topic.latest = {}
        windows: dict[str, int] = {}
        for pattern, window_s in self._windows.items():
            for name in self._feed.resolve([pattern]):
                windows[name] = max(windows.get(name, 0), window_s)
        # A trend keeps its past while pages and stations change, unless its window does.
        self.histories = {
            name: kept
            if (kept := self.histories.get(name)) is not None and kept.window_s == window_s
            else VariableHistory(window_s)
            for name, window_s in windows.items()
        }
        topics = self._topics.values()
        fast = {name for topic in topics for name in topic.names[FAST_MS]}
        slow = {name for topic in topics for name in topic.names[SLOW_MS]}
        self._feed.want(fast | set(self.histories), slow)

    def _record(self) -> None:
        now_s, wall_s = monotonic(), time()
        for name, history in self.histories.items():
            shown = self._feed.shown(name, now_s)
            # A line through stale values would look like measured ones.
            history.add(wall_s, None if shown.is_stale else shown.value)


def patterns_of(page: WebPage) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return the names and patterns of a page: those for each change, and those of tables."""
    fast: dict[str, None] = {}
    slow: dict[str, None] = {}
    for panel in page.panels:
        match panel:
            case ValuePanel() | TrendPanel() | StatesPanel():
                fast |= dict.fromkeys(names_in(panel.of))
            case SetPanel():
                fast[panel.of] = None
            case PicturePanel():
                fast |= dict.fromkeys(bound.of for bound in panel.bind.values())
            case TablePanel():
                slow |= dict.fromkeys(names_in(panel.of))
    return tuple(fast), tuple(slow)


MAX_POINTS = 1200
"""Pairs of points that are kept of a variable: its least and its largest value of each interval."""
_MIN_INTERVAL_S = 0.1


class VariableHistory:
    """Values of one variable over the last *window_s* seconds.

    Of each interval the least and the largest value are kept, so that a peak of one sample is in a
    trend of a day, too.  A time without a value is a gap.
    """

    def __init__(self, window_s: float) -> None:
        self.window_s = window_s
        self._interval_s = max(window_s / MAX_POINTS, _MIN_INTERVAL_S)
        self._times = array("d")
        self._values = array("d")
        self._began_s = -math.inf
        self._low = self._high = (0.0, math.nan)

    def add(self, time_s: float, value: Any) -> None:
        """Add a value of *time_s*, a gap if it is no number."""
        number = float(value) if isinstance(value, int | float) else math.nan
        if time_s - self._began_s >= self._interval_s or time_s < self._began_s:
            self._close()
            self._began_s = time_s
            self._low = self._high = (time_s, number)
        elif math.isnan(self._low[1]) or number < self._low[1]:
            self._low = (time_s, number)
        if math.isnan(self._high[1]) or number > self._high[1]:
            self._high = (time_s, number)

    def points(self, since_s: float = -math.inf) -> tuple[list[float], list[float | None]]:
        """Return times (Unix) and values since *since_s*; a gap is None."""
        times, values = list(self._times), list(self._values)
        for time_s, value in self._pending():
            times.append(time_s)
            values.append(value)
        newest_s = times[-1] if times else 0.0
        first_s = max(since_s, newest_s - self.window_s)
        start = next((n for n, each in enumerate(times) if each >= first_s), len(times))
        shown = [None if math.isnan(value) else value for value in values[start:]]
        return [round(each, 3) for each in times[start:]], shown

    def _pending(self) -> list[tuple[float, float]]:
        if self._began_s == -math.inf:
            return []
        return sorted({self._low, self._high}) if self._low != self._high else [self._low]

    def _close(self) -> None:
        for time_s, value in self._pending():
            self._times.append(time_s)
            self._values.append(value)
        if len(self._times) > 2 * MAX_POINTS + 200:
            # In pieces: each removal moves the rest.
            del self._times[: -2 * MAX_POINTS], self._values[: -2 * MAX_POINTS]
