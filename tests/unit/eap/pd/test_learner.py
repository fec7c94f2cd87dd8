from __future__ import annotations

from eap.ids import NetId
from eap.pd.address import LOOK_NS, NetIdLearner
from tests.support.cyclic import OWN, PEER, From, octets

THEIR_MAC = "02:00:00:00:00:02"
OTHER_MAC = "02:00:00:00:00:03"
FRAME = octets([(1, b"\1\2")])


class Port:
    """A learner, what it learned and what it handed over."""

    def __init__(self, *sought: str) -> None:
        self.learned: list[tuple[str, str]] = []
        self.taken: list[bytes] = []
        self.learner = NetIdLearner(lambda data, size, *_: self.taken.append(bytes(data[:size])))
        self.learner.sought = {NetId.parse(text) for text in sought}
        self.learner.learn = lambda net_id, mac: self.learned.append((str(NetId(net_id)), mac))

    def give(self, frame: bytes, sender: str, at_ns: int = 0) -> None:
        view = memoryview(frame + bytes(40))
        self.learner.take(view, len(frame), at_ns, From(sender))


def test_sender_of_a_sought_net_id_is_learned_and_the_frame_handed_over():
    port = Port(PEER)
    port.give(FRAME, THEIR_MAC)
    assert port.learned == [(PEER, THEIR_MAC)]
    assert port.taken == [FRAME]


def test_others_teach_nothing():
    port = Port(OWN)
    port.give(FRAME, THEIR_MAC)
    nobody = Port()
    nobody.give(FRAME, THEIR_MAC)
    assert port.learned == nobody.learned == []
    assert port.taken == nobody.taken == [FRAME]


def test_only_process_data_has_a_publisher():
    port = Port(PEER)
    mailbox = FRAME[:1] + bytes([FRAME[1] & 0x0F | 0x50]) + FRAME[2:]
    for frame in (mailbox, FRAME[:7], FRAME[:1], b""):
        port.give(frame, THEIR_MAC)
    assert port.learned == []
    assert len(port.taken) == 4


def test_frame_without_a_sender_teaches_nothing():
    port = Port(PEER)
    port.give(FRAME, "")
    assert port.learned == []


def test_address_is_looked_at_now_and_then():
    port = Port(PEER)
    for at_ns, mac in ((0, THEIR_MAC), (1, OTHER_MAC), (LOOK_NS, OTHER_MAC), (5, THEIR_MAC)):
        port.give(FRAME, mac, at_ns)
    # The last one came before the one that was looked at: the clock was set.
    assert [mac for _, mac in port.learned] == [THEIR_MAC, OTHER_MAC, THEIR_MAC]


def test_nothing_is_wanted_before_somebody_says_so():
    taken: list[int] = []
    learner = NetIdLearner(lambda _data, size, *_: taken.append(size))
    learner.take(memoryview(FRAME), len(FRAME), 0, From(THEIR_MAC))
    learner.learn(bytes(6), THEIR_MAC)
    assert taken == [len(FRAME)]
