"""Notifications on values of slaves, which the station samples by their mailboxes.

Rule 1: notifications on one value share its sampling.  The value is read at the shortest cycle that
any of them requests; each takes what is due for it from such a reading, with the time of that
reading.
Rule 2: a slave gets one reading at a time, and readings of a slave and of the appliance have a rate
limit.  Beyond it the cycles of all values get longer; nothing is refused for its rate.
Rule 3: a refusal of the slave ends the notifications on the value.  A slave that does not answer
ends them after :data:`GIVE_UP_S`; until then no sample is sent, because an old value is no sample.
"""

from __future__ import annotations

import asyncio
import logging
from collections import Counter
from collections.abc import Awaitable, Callable, Iterator
from time import monotonic_ns, time_ns
from typing import TypeAlias

from msgspec.structs import replace

from eap.ads.device import FIRST_CHANGE_NS
from eap.ads.notifications import (
    MAX_WATCHED,
    AdsClient,
    Notice,
    NotificationTable,
    handle_numbers,
)
from eap.ads.request import AdsRefusedError, Read
from eap.ads.space import Source
from eap.codec.ads import AdsError, IndexGroup
from eap.codec.adsnotification import AddNotification, to_filetime
from eap.errors import EapError
from eap.gateway.error_table import ads_result
from eap.ids import Endpoint, NetId, ObjectId
from eap.services.ads.ads_service import first_handle
from eap.services.ads.master_ads import Send
from eap.services.limited_log import caused_by
from eap.services.tasks import TaskSet

SHORTEST_CYCLE_NS = 20_000_000
"""Cycle of a value for which a shorter one is requested; pyads requests 0.1 ms by default."""
SLAVE_READINGS = 50
"""Readings a second of one slave."""
ALL_READINGS = 400
"""Readings a second of all slaves of the appliance."""
SLAVE_VALUES = 64
"""Values of one slave that are sampled at a time."""
CLIENT_NOTIFICATIONS = 256
"""Notifications of one client on values of slaves."""
ALL_NOTIFICATIONS = 4096
"""Notifications on values of slaves of the appliance."""
GIVE_UP_S = 10.0
"""Time without an answer of the slave after which its notifications end."""
RETRY_NS = 1_000_000_000
"""Shortest cycle of a value while its slave does not answer: a time-out blocks the mailbox."""
_FOR_NOW = frozenset(
    (
        AdsError.BUSY,
        AdsError.NOT_READY,
        AdsError.STATE,
        AdsError.TIMEOUT,
        AdsError.HOST_UNREACHABLE,
    )
)
"""Errors that may pass without anybody's doing: a state change, a power cycle, a cut cable."""
_NS_PER_S = 1_000_000_000
_SUBINDEX = 0xFF

ReadValue: TypeAlias = Callable[[int, Read], Awaitable[bytes]]
"""Reads a value of the slave with a station address; raises AdsRefusedError or EapError."""

logger = logging.getLogger(__name__)


class Pace:
    """Times of events at a limited rate.

    Args:
        per_s: Events a second.
    """

    def __init__(self, per_s: int) -> None:
        self._gap_ns = _NS_PER_S // per_s
        self._next_ns = 0

    def reserve(self, now_ns: int) -> int:
        """Return the time of the next event, *now_ns* at the earliest."""
        at_ns = max(now_ns, self._next_ns)
        self._next_ns = at_ns + self._gap_ns
        return at_ns


class SamplingBudget:
    """Limits of all notifications on values of slaves, shared by the buses of an appliance.

    Attributes:
        pace: Times of readings.
    """

    def __init__(self) -> None:
        self.pace = Pace(ALL_READINGS)
        self._clients: Counter[AdsClient] = Counter()

    def take(self, client: AdsClient) -> None:
        """Count a notification of *client*; raise NO_MORE_HANDLES beyond a limit."""
        if self._clients[client] >= CLIENT_NOTIFICATIONS:
            why = f"{CLIENT_NOTIFICATIONS} notifications on values of slaves for this client"
            raise AdsRefusedError(AdsError.NO_MORE_HANDLES, why)
        if self._clients.total() >= ALL_NOTIFICATIONS:
            why = f"{ALL_NOTIFICATIONS} notifications on values of slaves"
            raise AdsRefusedError(AdsError.NO_MORE_HANDLES, why)
        self._clients[client] += 1

    def release(self, client: AdsClient, count: int = 1) -> None:
        """Uncount notifications that have ended."""
        self._clients[client] -= count
        if self._clients[client] <= 0:
            del self._clients[client]


class SampledValue:
    """One value of a slave, and all notifications on it.

    Readings have the fixed interval of the shortest cycle; a new notification on a slow value gets
    one of its own for its first sample.

    Args:
        place: Index group, offset, and the length of the first request.
        data: The first reading.
        handles: Handles of the slave's notifications.

    Attributes:
        place: As given.
        table: Its notifications.
        error: Of the last reading, None if it succeeded.
    """

    def __init__(self, place: Read, data: bytes, handles: Iterator[int], now_ns: int) -> None:
        self.place = place
        self.table = NotificationTable(handles=handles)
        self.error: AdsRefusedError | None = None
        self._data = data
        self._answered_ns = now_ns
        self._tick_ns = 0
        self._first_ns: int | None = None

    @property
    def next_ns(self) -> int:
        """Time of the next reading."""
        return self._tick_ns if self._first_ns is None else min(self._first_ns, self._tick_ns)

    @property
    def cycle_ns(self) -> int:
        """Interval of the readings."""
        cycle_ns = max(SHORTEST_CYCLE_NS, self.table.shortest_cycle_ns())
        return cycle_ns if self.error is None else max(cycle_ns, RETRY_NS)

    def add(self, client: AdsClient, request: AddNotification, now_ns: int) -> int:
        """Return the handle of a new notification; raise AdsRefusedError."""
        source = self._source(request.length)
        try:
            source()
        except AdsRefusedError as exc:
            why = exc.why or f"the value has {len(self._data)} bytes, not {request.length}"
            raise AdsRefusedError(exc.result, why) from None
        before_ns = self.cycle_ns if len(self.table) else 0
        first_ns = now_ns + FIRST_CHANGE_NS
        # The table of one value has nothing to collect in a packet, so no sample waits.
        handle = self.table.add(client, replace(request, max_delay=0), source, first_ns)
        if not before_ns or self.cycle_ns < before_ns:
            self._tick_ns = first_ns + 1
        elif before_ns > FIRST_CHANGE_NS:
            self._first_ns = first_ns + 1
        return handle

    def take(self, data: bytes, now_ns: int) -> None:
        """Note a reading."""
        self._data, self._answered_ns, self.error = data, now_ns, None

    def fail(self, error: AdsRefusedError, now_ns: int) -> None:
        """Note a reading that failed; one that may pass is NOT_READY for some time."""
        result = error.result
        if result in _FOR_NOW:
            has_time = now_ns - self._answered_ns < GIVE_UP_S * _NS_PER_S
            result = AdsError.NOT_READY if has_time else AdsError.TIMEOUT
        self.error = AdsRefusedError(result, error.why)

    def sample(self, now_ns: int, time: int) -> list[Notice]:
        """Return what the clients get of the last reading, and plan the next one.

        Args:
            now_ns: The time on the monotonic clock.
            time: The same moment as a FILETIME.
        """
        # Each notification takes the reading that is nearest to its own time, early or late.
        notices = self.table.handle_cycle(now_ns + self.cycle_ns // 2, time)
        if self._first_ns is not None and self._first_ns <= now_ns:
            self._first_ns = None
        if self._tick_ns <= now_ns:
            # The mean interval is the requested one, but what was missed is not repeated.
            self._tick_ns = max(self._tick_ns + self.cycle_ns, now_ns)
        return notices

    def _source(self, length: int) -> Source:
        def read() -> bytes:
            if self.error is not None:
                raise self.error
            if len(self._data) != length:
                raise AdsRefusedError(AdsError.SIZE)
            return self._data

        return read


class _SlaveSampler:
    """The sampled values of one slave.

    Args:
        station: Of the slave.
        net_id: Of the bus port, source of the notifications.
        read: Reads a value.
        send: Sends a packet to a client.
        budget: Shared with other slaves.
        name_of: Returns the name of a slave, for the log.
    """

    def __init__(
        self,
        station: int,
        net_id: NetId,
        read: ReadValue,
        send: Send,
        budget: SamplingBudget,
        name_of: Callable[[int], str],
    ) -> None:
        self.by_handle: dict[int, tuple[SampledValue, AdsClient]] = {}
        self._station = station
        self._net_id = net_id
        self._read = read
        self._send = send
        self._budget = budget
        self._name_of = name_of
        self._values: dict[tuple[int, int], SampledValue] = {}
        self._pace = Pace(SLAVE_READINGS)
        self._wake = asyncio.Event()
        self._task: asyncio.Task[None] | None = None
        self._tasks = TaskSet(f"notifications of slave {station} at {net_id}")
        self._handles = (
            handle for handle in handle_numbers(first_handle()) if handle not in self.by_handle
        )

    async def add(self, client: AdsClient, request: AddNotification) -> Callable[[], int]:
        """Read the value of a request, and return the function that adds its notification.

        Raises:
            AdsRefusedError: it cannot be watched.
            EapError: it cannot be read.
        """
        if not 0 < request.length <= MAX_WATCHED:
            raise AdsRefusedError(AdsError.WATCH_SIZE)
        key = request.group, request.offset
        value = self._values.get(key)
        if value is None or value.error is not None:
            place = Read(request.group, request.offset, request.length)
            data = await self._read(self._station, place)
            # Another request for the same value may have been faster.
            value = self._values.get(key)
            if value is None:
                value = SampledValue(place, data, self._handles, monotonic_ns())
            else:
                value.take(data, monotonic_ns())
        found = value
        return lambda: self._add(client, request, self._values.get(key, found))

    def _add(self, client: AdsClient, request: AddNotification, value: SampledValue) -> int:
        key = request.group, request.offset
        if key not in self._values and len(self._values) >= SLAVE_VALUES:
            why = f"{SLAVE_VALUES} values of slave {self._station} are sampled already"
            raise AdsRefusedError(AdsError.NO_MORE_HANDLES, why)
        self._budget.take(client)
        try:
            handle = value.add(client, request, monotonic_ns())
        except AdsRefusedError:
            self._budget.release(client)
            raise
        self._values[key] = value
        self.by_handle[handle] = value, client
        self._wake.set()
        if self._task is None or self._task.done():
            self._task = self._tasks.start(self._sample())
        return handle

    def delete(self, client: AdsClient, handle: int) -> None:
        """End a notification; raise AdsRefusedError if it is none of *client*'s."""
        value, _ = self.by_handle.get(handle, (None, None))
        if value is None:
            raise AdsRefusedError(AdsError.NOTIFICATION_HANDLE)
        value.table.delete(client, handle)
        self._drop_ended()

    def forget(self, endpoint: Endpoint) -> None:
        """End the notifications of a closed connection."""
        for value in self._values.values():
            value.table.forget(endpoint)
        self._drop_ended()

    async def close(self) -> None:
        """End all notifications."""
        for _, client in self.by_handle.values():
            self._budget.release(client)
        self.by_handle.clear()
        await self._tasks.close()

    def _drop_ended(self) -> None:
        """Release notifications that their tables no longer have, and values without any."""
        for handle, (value, client) in list(self.by_handle.items()):
            if handle not in value.table:
                del self.by_handle[handle]
                self._budget.release(client)
        for key in [key for key, value in self._values.items() if not len(value.table)]:
            del self._values[key]
        self._wake.set()

    async def _sample(self) -> None:
        """Read the values when they are due, as long as there are notifications."""
        while self._values:
            value = min(self._values.values(), key=lambda each: each.next_ns)
            self._wake.clear()
            if (wait_ns := value.next_ns - monotonic_ns()) > 0:
                try:
                    # asyncio.wait_for of Python 3.11 may forget a cancellation.
                    async with asyncio.timeout(wait_ns / _NS_PER_S):
                        await self._wake.wait()
                except TimeoutError:
                    pass
                else:
                    continue  # another value may be due earlier now, or this one be gone
            now_ns = monotonic_ns()
            at_ns = max(self._pace.reserve(now_ns), self._budget.pace.reserve(now_ns))
            if at_ns > now_ns:
                await asyncio.sleep((at_ns - now_ns) / _NS_PER_S)
            await self._sample_one(value)

    async def _sample_one(self, value: SampledValue) -> None:
        was_failing = value.error is not None
        try:
            data = await self._read(self._station, value.place)
        except AdsRefusedError as exc:
            now_ns = monotonic_ns()
            value.fail(exc, now_ns)
        except EapError as exc:
            now_ns = monotonic_ns()
            value.fail(AdsRefusedError(ads_result(exc), str(exc)), now_ns)
        else:
            now_ns = monotonic_ns()
            value.take(data, now_ns)
        before = len(value.table)
        for notice in value.sample(now_ns, to_filetime(time_ns())):
            self._send(notice.client.endpoint, notice.encode(self._net_id, self._station))
        self._log(value, before - len(value.table), was_failing=was_failing)
        if len(value.table) != before:
            self._drop_ended()

    def _log(self, value: SampledValue, ended: int, *, was_failing: bool) -> None:
        error = value.error
        if error is None or (was_failing and not ended):
            return
        ends = f"{ended} notification{'s' if ended > 1 else ''} ended"
        what = ends if ended else "notifications without samples"
        name, text = self._name_of(self._station), error.why or AdsError.words_of(error.result)
        logger.warning(
            "%s: %s of %s: %s", name, what, _place_text(value.place), text,
            extra=caused_by((name, bool(ended), text), name),
        )  # fmt: skip


def _place_text(place: Read) -> str:
    if place.group == IndexGroup.SDO:
        return f"object {ObjectId(place.offset >> 16, place.offset & _SUBINDEX)}"
    return f"group 0x{place.group:X}, offset 0x{place.offset:08X}"


class SlaveNotifications:
    """Notifications on values of the slaves of one bus.

    Args:
        net_id: Of the bus port.
        read: Reads a value of a slave.
        send: Sends a packet to a client.
        budget: Of the appliance.
        name_of: Returns the name of a slave, for the log.
    """

    def __init__(
        self,
        net_id: NetId,
        read: ReadValue,
        send: Send,
        budget: SamplingBudget,
        name_of: Callable[[int], str],
    ) -> None:
        self._net_id = net_id
        self._read = read
        self._send = send
        self._budget = budget
        self._name_of = name_of
        self._samplers: dict[int, _SlaveSampler] = {}
        self._adding: Counter[Endpoint] = Counter()
        self._gone: set[Endpoint] = set()

    async def add(self, station: int, client: AdsClient, request: AddNotification) -> int:
        """Return the handle of a new notification.

        Raises:
            AdsRefusedError: it cannot be watched.
            EapError: it cannot be read.
        """
        sampler = self._samplers.get(station)
        if sampler is None:
            sampler = self._samplers[station] = _SlaveSampler(
                station, self._net_id, self._read, self._send, self._budget, self._name_of
            )
        endpoint = client.endpoint
        self._adding[endpoint] += 1
        try:
            add = await sampler.add(client, request)
            # A client that left during the reading would keep its notification for ever.
            if endpoint in self._gone:
                raise AdsRefusedError(AdsError.CLIENT_UNKNOWN, "the client has disconnected")
            return add()
        finally:
            self._adding[endpoint] -= 1
            if not self._adding[endpoint]:
                del self._adding[endpoint]
                self._gone.discard(endpoint)

    def delete(self, station: int, client: AdsClient, handle: int) -> None:
        """End a notification; raise AdsRefusedError if it is none of *client*'s."""
        sampler = self._samplers.get(station)
        if sampler is None:
            raise AdsRefusedError(AdsError.NOTIFICATION_HANDLE)
        sampler.delete(client, handle)

    async def close(self) -> None:
        """End all notifications."""
        for sampler in self._samplers.values():
            await sampler.close()

    def client_gone(self, endpoint: Endpoint) -> None:
        """End the notifications of a connection that is closed."""
        if self._adding[endpoint]:
            self._gone.add(endpoint)
        for sampler in self._samplers.values():
            sampler.forget(endpoint)
