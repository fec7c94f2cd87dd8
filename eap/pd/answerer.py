"""All polled TxPDs of one EAP port: each request is answered to who sent it, in the same cycle."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from eap.ids import NetId
from eap.pd.gather import Gather
from eap.pd.image import Image
from eap.pd.inputs import Inputs
from eap.pd.layout import FRAME_CTRL, VAR_CTRL, FramePlace, TxPlace
from eap.pd.link import Channel, OutFrame
from eap.pd.outcome import enter_refused, enter_sent, enter_skipped, enter_suppressed
from eap.pd.poll import Requests
from eap.pd.publisher import FrameRow, read_control
from eap.pd.spec import TriggerSpec
from eap.pd.trigger import SUPPRESS_BIT, Trigger
from eap.pd.txframe import Selection, TxPd, build_frame
from eap.pd.words import REASON_INDEX, FrameWord, Reason

ANSWERS_KEPT = 64
"""Buffers of a frame for those who asked last; another requester costs building one."""
_POLL = REASON_INDEX[Reason.POLL]


class _AnswerFrame:
    """The polled PDs of one TxFrame, and a buffer for each requester."""

    def __init__(self, place: FramePlace, pds: tuple[TxPd, ...]) -> None:
        self.place = place
        self.pds = pds
        self.suppressed = False
        self._kept: dict[tuple[str, tuple[TxPd, ...]], Selection] = {}

    def select(
        self, sender: str, pds: tuple[TxPd, ...], publisher: NetId, channel: Channel
    ) -> Selection:
        """Return the buffer for *pds* to *sender*."""
        kept = self._kept
        selection = kept.get((sender, pds))
        if selection is None:
            if len(kept) >= ANSWERS_KEPT:
                del kept[next(iter(kept))]
            selection = Selection(build_frame(publisher, pds, channel, sender), pds)
            kept[sender, pds] = selection
        return selection


class Answerer:
    """Answers what one port is asked.

    All polled PDs of a TxFrame that one sender asked for go to it in one frame.

    Args:
        image: The station's process image.
        inputs: The variables as the cycle sees them.
        publisher: NetID of the port.
        channel: Where the answers go.
        frames: The TxFrames with their polled PDs.
        requests: Who asked.
    """

    def __init__(
        self,
        image: Image,
        inputs: Inputs,
        publisher: NetId,
        channel: Channel,
        frames: Iterable[FrameRow],
        requests: Requests,
    ) -> None:
        self._image = image
        self._inputs = inputs
        self._publisher = publisher
        self._channel = channel
        self._requests = requests
        self._frames = [
            _AnswerFrame(
                place,
                tuple(
                    TxPd(where, Trigger(TriggerSpec(), None), Gather(image, inputs, pd.variables))
                    for pd, where in zip(spec.pds, places, strict=True)
                ),
            )
            for spec, place, places in frames
        ]
        self._sending: list[tuple[_AnswerFrame, Selection]] = []
        self.read_controls()

    def read_controls(self) -> None:
        """Follow the control variables; called when the application has written."""
        for frame in self._frames:
            control = read_control(self._image, self._inputs, frame.place.name + FRAME_CTRL)
            frame.suppressed = bool(control & SUPPRESS_BIT)
            for pd in frame.pds:
                control = read_control(self._image, self._inputs, pd.place.name + VAR_CTRL)
                pd.trigger.suppressed = bool(control & SUPPRESS_BIT)

    def frames_to_send(self, cycle: int, now_ns: int) -> list[OutFrame]:
        """Return the answers to all that was asked, patched; :meth:`sent` must follow."""
        self._sending.clear()
        for sender, names in self._requests.take().items():
            for frame in self._frames:
                due = [pd for pd in frame.pds if pd.place.poll_request in names]
                chosen = tuple(p for p in due if not (frame.suppressed or p.trigger.suppressed))
                if len(chosen) < len(due):
                    self._skip(frame, [pd.place for pd in due if pd not in chosen], now_ns)
                if chosen:
                    selection = frame.select(sender, chosen, self._publisher, self._channel)
                    selection.patch(cycle)
                    self._sending.append((frame, selection))
        return [selection.out for _, selection in self._sending]

    def sent(self, failed: Sequence[OutFrame], now_ns: int) -> None:
        """Count what was sent since :meth:`frames_to_send`, all but *failed*."""
        words = self._image.words
        for frame, selection in self._sending:
            if failed and selection.out in failed:
                enter_refused(words, frame.place, selection.out, now_ns)
                enter_skipped(words, (pd.place for pd in selection.pds), now_ns)
                continue
            words[frame.place.words + FrameWord.SENT_AT_NS] = now_ns
            words[frame.place.words + FrameWord.PARTIAL] += 1
            for pd in selection.pds:
                enter_sent(words, pd.place, _POLL, now_ns)

    def _skip(self, frame: _AnswerFrame, pds: Iterable[TxPlace], now_ns: int) -> None:
        if frame.suppressed:
            enter_suppressed(self._image.words, frame.place, now_ns)
        enter_skipped(self._image.words, pds, now_ns)
