from __future__ import annotations

from eap.codec.pd import iter_pds
from eap.ids import NetId
from eap.pd.image import Image, Inputs
from eap.pd.poll import PollRequests
from eap.pd.publisher import ANSWERS_KEPT, PollResponder, Publisher
from eap.pd.report import station_status
from eap.pd.spec import (
    REQUESTER,
    OnChangeSpec,
    RxPdSpec,
    StationSpec,
    TriggerSpec,
    TxFrameSpec,
    TxPdSpec,
    Writer,
)
from tests.support.cyclic import PEER, Wire, image_of, received, station, written


class Sender:
    """A publisher with what it needs around it, stepped by hand."""

    def __init__(self, spec: StationSpec, image: Image | None = None) -> None:
        self.image: Image = image or image_of(spec)
        self.inputs = Inputs(self.image)
        self.wire = Wire()
        layout = self.image.layout
        frames = [
            (frame, slot, tuple(pd for pd in layout.tx if pd.frame == frame.name))
            for frame, slot in zip(spec.frames, layout.frames, strict=True)
        ]
        self.publisher = Publisher(self.image, self.inputs, NetId.parse(PEER), self.wire, frames)

    def put(self, **values: int) -> None:
        with self.image.writing(Writer.APPLICATION):
            for name, value in values.items():
                self.image.write(name.replace("_", "."), value)
        assert self.inputs.refresh()
        self.publisher.read_controls()

    def cycle(self, cycle: int) -> list[list[int]]:
        frames = self.publisher.frames_to_send(cycle, cycle * 1_000_000)
        self.publisher.sent(self.wire.send(frames, 0), cycle * 1_000_000)
        return [[pd.pd_id for pd, _ in iter_pds(bytes(frame.buffer))] for frame in frames]

    @property
    def frames(self) -> dict[str, dict]:
        return {row["name"]: row for row in station_status(self.image, 0)["frames"]}

    @property
    def tx(self) -> list[dict]:
        return station_status(self.image, 0)["pd"]["tx"]


def two_frames() -> Sender:
    return Sender(
        station(
            variables=written("x:UINT", "y:UINT"),
            frames=(
                TxFrameSpec(
                    "f",
                    "eap0",
                    "10.0.0.1",
                    (TxPdSpec("p", 1, ("x",)), TxPdSpec("q", 2, ("x", "y"))),
                ),
                TxFrameSpec(
                    "g",
                    "eap0",
                    "10.0.0.2",
                    (
                        TxPdSpec("r", 3, ("y",), trigger=TriggerSpec(cycle_us=2000)),
                        TxPdSpec("s", 4, ("x",), trigger=TriggerSpec(on_change=OnChangeSpec())),
                    ),
                ),
            ),
        )
    )


def test_all_frames_of_a_port_go_in_one_batch_with_the_counter_of_the_cycle():
    sender = two_frames()
    sender.put(x=0x1234, y=0x5678)
    assert sender.cycle(0x1_0002) == [[1, 2], [3, 4]]
    first, second = sender.wire.sent
    assert first[10:12] == second[10:12] == b"\x02\0"
    assert [bytes(data) for _, data in iter_pds(first)] == [b"\x34\x12", b"\x34\x12\x78\x56"]
    assert sender.cycle(0x1_0003) == [[1, 2]]
    assert sender.cycle(0x1_0004) == [[1, 2], [3]]


def test_publisher_counts_each_pd_by_reason():
    sender = two_frames()
    for cycle in range(1, 7):
        sender.put(x=cycle // 3)
        sender.cycle(cycle)
    rows = {row["name"]: (row["sent"], row["reason"], row["last_reason"]) for row in sender.tx}
    assert rows == {
        "p": (6, {"cycle": 6}, "cycle"),
        "q": (6, {"cycle": 6}, "cycle"),
        "r": (3, {"cycle": 3}, "cycle"),
        "s": (3, {"change": 3}, "change"),
    }
    assert all(row["skipped"] == 0 and row["frame_state"] == 0 for row in sender.tx)


def test_a_pd_that_was_never_sent_has_no_reason():
    assert two_frames().tx[0]["last_reason"] is None


def test_a_suppressed_pd_leaves_the_others_and_comes_back():
    sender = two_frames()
    assert sender.cycle(1)[0] == [1, 2]
    sender.put(p_VarCtrl=1)
    assert sender.cycle(2)[0] == [2]
    sender.put(p_VarCtrl=0)
    assert sender.cycle(3)[0] == [1, 2]
    p, q, *_ = sender.tx
    assert (p["sent"], p["skipped"], q["sent"], q["skipped"]) == (2, 1, 3, 0)
    assert p["reason"] == {"cycle": 2}


def test_suppressed_frame_has_not_sent_state_until_sent_again():
    sender = two_frames()
    sender.put(f_FrameCtrl=1)
    assert sender.cycle(1) == [[4]]
    assert [row["frame_state"] for row in sender.tx] == [1, 1, 0, 0]
    assert [row["skipped"] for row in sender.tx] == [1, 1, 0, 0]
    sender.put(f_FrameCtrl=0)
    sender.cycle(3)
    assert sender.tx[0]["frame_state"] == 0


def test_a_refused_frame_is_skipped_and_the_others_are_not():
    sender = two_frames()
    frames = sender.publisher.frames_to_send(2, 0)
    sender.publisher.sent(frames[:1], 0)
    rows = {row["name"]: (row["sent"], row["skipped"], row["frame_state"]) for row in sender.tx}
    assert rows == {"p": (0, 1, 1), "q": (0, 1, 1), "r": (1, 0, 0), "s": (1, 0, 0)}


THERE = "5.23.91.25.1.1"
THEIR_MAC = "02:00:00:00:00:02"


def by_net_id(*, mac: str = "") -> StationSpec:
    """A frame of one cyclic PD and one that the application sends, and a frame to everybody."""
    return station(
        variables=written("x:UINT"),
        frames=(
            TxFrameSpec(
                "f",
                "eap0",
                THERE,
                (
                    TxPdSpec("p", 1, ("x",)),
                    TxPdSpec("e", 2, ("x",), trigger=TriggerSpec(event=True)),
                ),
                mac=mac,
            ),
            TxFrameSpec("g", "eap0", "01:01:05:04:00:00", (TxPdSpec("q", 3, ("x",)),)),
        ),
    )


def test_frame_to_a_net_id_waits_for_its_address_and_the_others_do_not():
    sender = Sender(by_net_id())
    sender.put(e_VarCtrl=2)
    for cycle in (1, 2, 3):
        assert sender.cycle(cycle) == [[3]]
    waiting = sender.frames["f"]
    assert (waiting["address"], waiting["sent"], waiting["skipped"]) == (None, 0, 3)
    assert waiting["frame_state"] == 1
    assert sender.frames["g"]["sent"] == 3

    sender.publisher.learn(NetId.parse(THERE), THEIR_MAC)
    assert sorted(sender.cycle(4)) == [[1, 2], [3]]  # the event has waited, too
    assert sender.frames["f"]["address"] == THEIR_MAC
    assert sender.frames["f"]["frame_state"] == 0


def test_address_behind_a_net_id_may_change():
    sender = Sender(by_net_id())
    for mac in (THEIR_MAC, THEIR_MAC, "02:00:00:00:00:03"):
        sender.publisher.learn(NetId.parse(THERE), mac)
        frames = sender.publisher.frames_to_send(1, 0)
        sender.publisher.sent((), 0)
        assert {frame.destination for frame in frames} == {mac, "01:01:05:04:00:00"}


def test_restarted_engine_goes_on_with_the_address_that_was_learned():
    before = Sender(by_net_id())
    before.publisher.learn(NetId.parse(THERE), THEIR_MAC)
    after = Sender(by_net_id(), before.image)
    assert sorted(after.cycle(1)) == [[1], [3]]


def test_publisher_uses_configured_mac_without_learning():
    sender = Sender(by_net_id(mac=THEIR_MAC))
    assert sender.publisher.wanted == {}
    assert sender.frames["f"]["address"] == THEIR_MAC
    assert sender.frames["f"]["destination"] == THERE
    assert [3] in sender.cycle(1)


MS = 1_000_000


class Labelled(Wire):
    """A wire on which each frame begins with its destination."""

    def link_header(self, destination: str) -> bytes:
        return f"{destination}>".encode()


class Server:
    """Two frames of answers: p and q to the request r, and s to the request t."""

    def __init__(self) -> None:
        self.spec = station(
            variables=(*written("x:UINT", "y:BOOL"), *received("r.a:UINT", "t.a:UINT")),
            subscriptions=(
                RxPdSpec("r", "eap0", 1, ("r.a",)),
                RxPdSpec("t", "eap0", 2, ("t.a",)),
            ),
            frames=(
                TxFrameSpec(
                    "f",
                    "eap0",
                    REQUESTER,
                    (
                        TxPdSpec("p", 11, ("x",), poll_request="r"),
                        TxPdSpec("q", 12, ("y",), poll_request="r"),
                    ),
                ),
                TxFrameSpec(
                    "g",
                    "eap0",
                    REQUESTER,
                    (TxPdSpec("s", 13, ("x", "y"), version=9, poll_request="t"),),
                ),
            ),
        )
        self.image = image_of(self.spec)
        self.inputs = Inputs(self.image)
        self.wire = Labelled()
        self.requests = PollRequests(["r", "t"])
        layout = self.image.layout
        self.answerer = PollResponder(
            self.image,
            self.inputs,
            NetId.parse(PEER),
            self.wire,
            [
                (frame, slot, tuple(pd for pd in layout.tx if pd.frame == frame.name))
                for frame, slot in zip(self.spec.frames, layout.frames, strict=True)
            ],
            self.requests,
        )

    def put(self, **values: int) -> None:
        with self.image.writing(Writer.APPLICATION):
            for name, value in values.items():
                self.image.write(name.replace("_", "."), value)
        assert self.inputs.refresh()
        self.answerer.read_controls()

    def cycle(self, cycle: int) -> list[tuple[str, list[int]]]:
        """Run a cycle; return destination and PD ids of what it sent."""
        before = len(self.wire.sent)
        frames = self.answerer.frames_to_send(cycle, cycle * MS)
        self.answerer.sent(self.wire.send(frames, cycle * MS) if frames else (), cycle * MS)
        found = []
        for octets in self.wire.sent[before:]:
            to, _, frame = octets.partition(b">")
            found.append((to.decode(), [header.pd_id for header, _ in iter_pds(frame)]))
        return found

    def row(self, name: str) -> dict:
        return next(r for r in station_status(self.image, 0)["pd"]["tx"] if r["name"] == name)


def test_poll_responder_sends_nothing_without_request():
    assert Server().cycle(1) == []


def test_poll_responder_sends_all_answers_in_one_frame_once():
    server = Server()
    server.put(x=0x1234, y=1)
    server.requests.add("left", ["r"])
    assert server.cycle(0x1_0005) == [("left", [11, 12])]
    frame = server.wire.sent[0].partition(b">")[2]
    assert frame[10:12] == b"\x05\0"  # the server's own cycle
    assert [bytes(data) for _, data in iter_pds(frame)] == [b"\x34\x12", b"\x01"]
    assert server.cycle(6) == []
    row = server.row("p")
    assert (row["sent"], row["reason"], row["last_reason"]) == (1, {"poll": 1}, "poll")
    assert server.row("s")["sent"] == 0


def test_poll_responder_answers_each_requester_its_request():
    server = Server()
    server.requests.add("left", ["r", "t"])
    server.requests.add("right", ["t"])
    assert server.cycle(1) == [("left", [11, 12]), ("left", [13]), ("right", [13])]
    assert [header.version for header, _ in iter_pds(server.wire.sent[2].partition(b">")[2])] == [9]
    assert (server.row("p")["sent"], server.row("s")["sent"]) == (1, 2)


def test_values_are_those_of_the_cycle_that_answers():
    server = Server()
    for cycle, value in ((1, 7), (2, 8)):
        server.put(x=value)
        server.requests.add("left", ["t"])
        server.cycle(cycle)
    assert [octets[-3:-1] for octets in server.wire.sent] == [b"\x07\0", b"\x08\0"]


def test_poll_responder_skips_suppressed_pd_and_clears_request():
    server = Server()
    server.put(p_VarCtrl=1, g_FrameCtrl=1)
    server.requests.add("left", ["r", "t"])
    assert server.cycle(1) == [("left", [12])]
    states = {n: (server.row(n)["skipped"], server.row(n)["var_state"]) for n in ("p", "q", "s")}
    assert states == {"p": (1, 1), "q": (0, 0), "s": (1, 1)}
    assert (server.row("p")["frame_state"], server.row("s")["frame_state"]) == (0, 1)
    server.put(p_VarCtrl=0, g_FrameCtrl=0)
    assert server.cycle(2) == []
    server.requests.add("left", ["r", "t"])
    assert server.cycle(3) == [("left", [11, 12]), ("left", [13])]
    assert [server.row(n)["var_state"] for n in ("p", "q", "s")] == [0, 0, 0]
    assert server.row("s")["frame_state"] == 0


def test_poll_responder_counts_unsent_frames_as_skipped():
    server = Server()
    server.wire.refuse = True
    server.requests.add("left", ["r"])
    assert server.cycle(1) == []
    row = server.row("q")
    assert (row["sent"], row["skipped"], row["var_state"], row["frame_state"]) == (0, 1, 1, 1)
    server.wire.refuse = False
    assert server.cycle(2) == []
    server.requests.add("left", ["r"])
    assert server.cycle(3) == [("left", [11, 12])]
    assert (server.row("q")["var_state"], server.row("q")["frame_state"]) == (0, 0)


def test_poll_responder_drops_buffers_of_oldest_requesters():
    server = Server()
    for number in range(3 * ANSWERS_KEPT):
        server.requests.add(f"station {number}", ["t"])
        assert server.cycle(number) == [(f"station {number}", [13])]
    kept = server.answerer._frames[1]._kept
    assert len(kept) == ANSWERS_KEPT
    server.requests.add("station 0", ["t"])
    assert server.cycle(999) == [("station 0", [13])]
