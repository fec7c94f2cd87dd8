"""Notifications in any order of all that can happen."""

from __future__ import annotations

import pytest
from hypothesis import strategies as st
from hypothesis.stateful import Bundle, RuleBasedStateMachine, consumes, invariant, rule

from eap.ads.notifications import AdsClient, NotificationTable
from eap.ads.request import AdsRefusedError
from eap.codec.ads import AdsError
from eap.codec.adsnotification import (
    AddNotification,
    decode_notification,
)
from tests.support.examples import examples
from tests.unit.eap.ads.test_notifications import (
    CHANGE,
    CYCLE,
    ME,
    MS,
    OTHER,
    YOU,
    Value,
    asked,
)

CLIENTS = st.sampled_from([ME, YOU, OTHER])


class Watched(RuleBasedStateMachine):
    """Any order of adding, deleting, leaving, changing, failing and cycles.

    Each client sees, for each handle of its own, exactly what a plain model says, in order of
    time, and no sample later than its delay and one cycle.
    """

    handles = Bundle("handles")

    def __init__(self) -> None:
        super().__init__()
        self.table = NotificationTable()
        self.now = 0
        self.alive: dict[int, tuple[AdsClient, Value, AddNotification]] = {}
        self.last: dict[int, bytes] = {}
        self.unsent: dict[int, list[tuple[int, bytes]]] = {}

    @rule(
        target=handles,
        client=CLIENTS,
        mode=st.sampled_from([CYCLE, CHANGE]),
        cycle_ms=st.sampled_from([0, 1, 7, 30]),
        delay_ms=st.sampled_from([0, 5, 40]),
    )
    def add(self, client, mode, cycle_ms, delay_ms):
        request = asked(mode, cycle_ms=cycle_ms, delay_ms=delay_ms)
        value = Value(b"x")
        handle = self.table.add(client, request, value, self.now)
        assert handle not in self.alive
        self.alive[handle] = client, value, request
        self.unsent[handle] = []
        return handle

    @rule(handle=consumes(handles))
    def delete(self, handle):
        if handle in self.alive:
            client = self.alive.pop(handle)[0]
            self.table.delete(client, handle)
        else:
            with pytest.raises(AdsRefusedError):
                self.table.delete(ME, handle)

    @rule(endpoint=st.sampled_from([ME.endpoint, YOU.endpoint]))
    def leave(self, endpoint):
        self.table.forget(endpoint)
        for handle in [h for h, (owner, *_) in self.alive.items() if owner.endpoint == endpoint]:
            del self.alive[handle]

    @rule(handle=handles, octets=st.sampled_from([b"x", b"y", b"z", None]))
    def change(self, handle, octets):
        if handle in self.alive:
            self.alive[handle][1].octets = octets

    @rule(handle=handles)
    def fail(self, handle):
        if handle in self.alive:
            self.alive[handle][1].octets = None
            self.alive[handle][1].refusal = AdsError.NOT_FOUND

    @rule(ms=st.integers(1, 50))
    def end_cycle(self, ms):
        self.now += ms * MS
        before = {handle: value.reads for handle, (_, value, _) in self.alive.items()}
        notices = self.table.handle_cycle(self.now, self.now)
        ended = set()
        for handle, (_, value, request) in self.alive.items():
            if value.reads == before[handle]:
                assert request.cycle, "a cycle of 0 is every cycle"
            elif value.octets is None:
                ended |= {handle} if value.refusal is AdsError.NOT_FOUND else set()
            elif request.mode == CYCLE or self.last.get(handle) != value.octets:
                self.last[handle] = value.octets
                self.unsent[handle].append((self.now, value.octets))
        self._compare(notices, ended)

    def _compare(self, notices, ended):
        for client, data in notices:
            for time, samples in decode_notification(data):
                for handle, octets in samples:
                    if handle not in self.alive:
                        continue  # taken before it was deleted
                    assert self.alive[handle][0] == client
                    if octets:
                        assert self.unsent[handle].pop(0) == (time, octets)
                    else:
                        assert handle in ended
                        assert not self.unsent[handle]
                        ended.discard(handle)
                        del self.alive[handle]
        assert not ended
        for handle, (_, _, request) in self.alive.items():
            for time, _ in self.unsent[handle]:
                assert self.now < time + request.max_delay * 100

    @invariant()
    def counts(self):
        stats = self.table.stats()
        assert stats.notifications == len(self.alive)
        assert set(self.table._clients) == {client for client, *_ in self.alive.values()}


TestWatched = Watched.TestCase

TestWatched.settings = examples(60, stateful_step_count=40)
