"""All polled TxPDs of one EAP port: each request is answered to who sent it, in the same cycle."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from eap.ids import NetId
from eap.pd.gather import Gather
from eap.pd.image import Image
from eap.pd.inputs import Inputs
from eap.pd.layout import FRAME_CTRL, VAR_CTRL, FramePlace
from eap.pd.link import Channel, OutFrame
from eap.pd.poll import Requests
from eap.pd.publisher import NOT_SENT, FrameRow, read_control, refused_state
from eap.pd.spec import TriggerSpec
from eap.pd.trigger import SUPPRESS_BIT, Trigger
from eap.pd.txframe import Selection, TxPd, build_frame
from eap.pd.words import REASON_INDEX, FrameWord, Reason, TxWord

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
        del now_ns
        self._sending.clear()
        for sender, names in self._requests.take().items():
            for frame in self._frames:
                due = [pd for pd in frame.pds if pd.place.poll_request in names]
                chosen = tuple(p for p in due if not (frame.suppressed or p.trigger.suppressed))
                if len(chosen) < len(due):
                    self._skip(frame, [pd for pd in due if pd not in chosen])
                if chosen:
                    selection = frame.select(sender, chosen, self._publisher, self._channel)
                    selection.patch(cycle)
                    self._sending.append((frame, selection))
        return [selection.out for _, selection in self._sending]

    def sent(self, failed: Sequence[OutFrame], now_ns: int) -> None:
        """Count what was sent since :meth:`frames_to_send`, all but *failed*."""
        words = self._image.words
        for frame, selection in self._sending:
            first = frame.place.words
            if failed and selection.out in failed:
                words[first + FrameWord.STATE] = refused_state(selection.out)
                words[first + FrameWord.SKIPPED] += 1
                self._enter_unsent(selection.pds)
                continue
            words[first + FrameWord.STATE] = 0
            words[first + FrameWord.SENT_AT_NS] = now_ns
            words[first + FrameWord.PARTIAL] += 1
            for pd in selection.pds:
                first = pd.place.words
                words[first + TxWord.REASON + _POLL] += 1
                words[first + TxWord.LAST_REASON] = _POLL
                words[first + TxWord.SENT_AT_NS] = now_ns
                words[first + TxWord.STATE] = 0

    def _skip(self, frame: _AnswerFrame, pds: Iterable[TxPd]) -> None:
        words = self._image.words
        if frame.suppressed:
            words[frame.place.words + FrameWord.STATE] = NOT_SENT
            words[frame.place.words + FrameWord.SKIPPED] += 1
        self._enter_unsent(pds)

    def _enter_unsent(self, pds: Iterable[TxPd]) -> None:
        words = self._image.words
        for pd in pds:
            words[pd.place.words + TxWord.SKIPPED] += 1
            words[pd.place.words + TxWord.STATE] = NOT_SENT
