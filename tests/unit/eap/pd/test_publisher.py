from __future__ import annotations

from eap.codec.pd import iter_pds
from eap.ids import NetId
from eap.pd.image import Image, Inputs
from eap.pd.publisher import Publisher
from eap.pd.report import station_status
from eap.pd.spec import OnChangeSpec, StationSpec, TriggerSpec, TxFrameSpec, TxPdSpec, Writer
from tests.support.cyclic import PEER, Wire, image_of, station, written


class Sender:
    """A publisher with what it needs around it, stepped by hand."""

    def __init__(self, spec: StationSpec, image: Image | None = None) -> None:
        self.image: Image = image or image_of(spec)
        self.inputs = Inputs(self.image)
        self.wire = Wire()
        layout = self.image.layout
        frames = [
            (frame, place, tuple(pd for pd in layout.tx if pd.frame == frame.name))
            for frame, place in zip(spec.frames, layout.frames, strict=True)
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


def test_every_pd_says_how_often_it_was_sent_and_why():
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


def test_a_suppressed_frame_says_so_in_its_state_until_it_is_sent_again():
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


def test_configured_mac_is_used_and_nothing_is_learned():
    sender = Sender(by_net_id(mac=THEIR_MAC))
    assert sender.publisher.sought == {}
    assert sender.frames["f"]["address"] == THEIR_MAC
    assert sender.frames["f"]["destination"] == THERE
    assert [3] in sender.cycle(1)
