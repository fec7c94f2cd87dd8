from __future__ import annotations

from eap.codec.pd import iter_pds
from eap.ids import NetId
from eap.pd.image import Inputs
from eap.pd.poll import Requests
from eap.pd.publisher import ANSWERS_KEPT, Answerer
from eap.pd.report import station_status
from eap.pd.spec import REQUESTER, RxPdSpec, TxFrameSpec, TxPdSpec, Writer
from tests.support.cyclic import PEER, Wire, image_of, received, station, written

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
        self.requests = Requests(["r", "t"])
        layout = self.image.layout
        self.answerer = Answerer(
            self.image,
            self.inputs,
            NetId.parse(PEER),
            self.wire,
            [
                (frame, place, tuple(pd for pd in layout.tx if pd.frame == frame.name))
                for frame, place in zip(self.spec.frames, layout.frames, strict=True)
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


def test_nothing_is_sent_unasked():
    assert Server().cycle(1) == []


def test_who_asks_gets_all_that_answers_in_one_frame_once():
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


def test_each_requester_is_answered_what_it_asked_for():
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


def test_what_is_suppressed_is_skipped_and_the_request_used_up():
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


def test_what_the_network_refuses_is_skipped():
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


def test_buffers_of_those_who_asked_long_ago_are_given_up():
    server = Server()
    for number in range(3 * ANSWERS_KEPT):
        server.requests.add(f"station {number}", ["t"])
        assert server.cycle(number) == [(f"station {number}", [13])]
    kept = server.answerer._frames[1]._kept
    assert len(kept) == ANSWERS_KEPT
    server.requests.add("station 0", ["t"])
    assert server.cycle(999) == [("station 0", [13])]
