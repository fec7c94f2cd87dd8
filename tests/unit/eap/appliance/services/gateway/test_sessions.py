"""Sessions by whose they are; what they do is in test_slave_session and test_master_session."""

from __future__ import annotations

from eap.aoe.way import Way
from eap.appliance.services.gateway import sessions as module
from eap.appliance.services.gateway.sessions import SessionKey, Sessions
from eap.codec.mailbox import MailboxType

HERE, THERE = Way("udp:a", "1"), Way("udp:a", "2")


class Session:
    def __init__(self, *, is_running: bool = False) -> None:
        self.is_running = is_running
        self.is_closed = False

    def close(self) -> None:
        self.is_closed = True


def key(way: Way = HERE, address: int = 1001) -> SessionKey:
    return SessionKey(way, address, MailboxType.COE)


def test_a_client_keeps_its_session() -> None:
    sessions: Sessions[Session] = Sessions()
    first = sessions.take(key(), Session)
    assert sessions.take(key(), Session) is first
    assert sessions.take(key(THERE), Session) is not first
    sessions.close_of(HERE)
    assert first.is_closed
    assert sessions.take(key(), Session) is not first


def test_what_is_running_is_told() -> None:
    sessions: Sessions[Session] = Sessions()
    sessions.take(key(), Session)
    sessions.take(key(THERE), lambda: Session(is_running=True))
    assert list(sessions.running()) == [key(THERE)]


def test_the_oldest_goes_unless_it_is_running(monkeypatch) -> None:
    monkeypatch.setattr(module, "MAX_SESSIONS", 2)
    sessions: Sessions[Session] = Sessions()
    running = sessions.take(key(address=1), lambda: Session(is_running=True))
    idle = sessions.take(key(address=2), Session)
    last = sessions.take(key(address=3), Session)
    assert [each.is_closed for each in (running, idle, last)] == [False, True, False]
    sessions.close()
    assert running.is_closed
    assert last.is_closed
