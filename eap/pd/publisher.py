"""All TxFrames of one EAP port: what is due in a cycle, and what became of it."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from eap.ids import NetId
from eap.pd.gather import Gather
from eap.pd.image import Image
from eap.pd.inputs import Inputs
from eap.pd.layout import FRAME_CTRL, VAR_CTRL, FramePlace, TxPlace
from eap.pd.link import Channel, OutFrame
from eap.pd.spec import TxFrameSpec
from eap.pd.trigger import EVENT_BIT, SUPPRESS_BIT, Trigger, plan_schedule
from eap.pd.txframe import Selection, TxFrame, TxPd
from eap.pd.words import FrameWord, TxWord

_NOT_SENT = 1
_WHOLE, _SENT_AT, _STATE = int(FrameWord.WHOLE), int(FrameWord.SENT_AT_NS), int(FrameWord.STATE)


class Publisher:
    """Sends the frames of one port.

    Args:
        image: The station's process image.
        inputs: The variables as the cycle sees them.
        publisher: NetID of the port.
        channel: Where the frames go; it decides what stands before the EtherCAT header.
        frames: The port's TxFrames, each with its place and the places of its PDs.
    """

    def __init__(
        self,
        image: Image,
        inputs: Inputs,
        publisher: NetId,
        channel: Channel,
        frames: Iterable[tuple[TxFrameSpec, FramePlace, tuple[TxPlace, ...]]],
    ) -> None:
        self._image = image
        self._inputs = inputs
        self._words = image.words
        cycle_us = image.layout.cycle_us
        self.frames: list[TxFrame] = []
        for spec, place, places in frames:
            gate = (spec.divider, spec.modulo)
            pds = tuple(
                TxPd(
                    where,
                    Trigger(pd.trigger, plan_schedule(pd.trigger, cycle_us, gate)),
                    Gather(image, inputs, pd.variables),
                )
                for pd, where in zip(spec.pds, places, strict=True)
            )
            self.frames.append(TxFrame(place, publisher, pds, gate, channel))
        self._controls: dict[str, int] = {}
        self._plain: list[TxFrame] = []
        self._others: list[TxFrame] = []
        self._sending: list[tuple[TxFrame, Selection]] = []
        self.read_controls()

    def read_controls(self) -> None:
        """Follow the control variables; called when the application has written."""
        for frame in self.frames:
            control = self._control(frame.place.name + FRAME_CTRL)
            frame.suppressed = bool(control & SUPPRESS_BIT)
            for pd in frame.pds:
                name = pd.place.name + VAR_CTRL
                control = self._control(name)
                before = self._controls.get(name, control)  # a bit left set is no rising bit
                self._controls[name] = control
                pd.trigger.suppressed = bool(control & SUPPRESS_BIT)
                if control & ~before & EVENT_BIT and pd.trigger.takes_events:
                    pd.trigger.raise_event()
        self._plain = [frame for frame in self.frames if frame.is_plain]
        self._others = [frame for frame in self.frames if not frame.is_plain]

    def frames_to_send(self, cycle: int, now_ns: int) -> list[OutFrame]:
        """Return the frames due in this cycle, patched; :meth:`sent` must follow."""
        sending = self._sending
        sending.clear()
        for frame in self._plain:
            schedule = frame.schedule
            if schedule is not None and cycle % schedule.step == schedule.phase:
                selection = frame.whole
                selection.patch(cycle)
                sending.append((frame, selection))
        for frame in self._others:
            chosen, skipped = frame.select(cycle, now_ns)
            if skipped:
                self._skip(frame, skipped)
            if chosen is not None:
                chosen.patch(cycle)
                sending.append((frame, chosen))
        return [selection.out for _, selection in sending]

    def sent(self, failed: Sequence[OutFrame], now_ns: int) -> None:
        """Count what was sent since :meth:`frames_to_send`, all but *failed*."""
        words = self._words
        for frame, selection in self._sending:
            first = frame.place.words
            if failed and selection.out in failed:
                self._fail(frame, selection)
                continue
            words[first + _STATE] = 0
            words[first + _SENT_AT] = now_ns
            if frame.schedule is not None and selection is frame.whole:
                words[first + _WHOLE] += 1
            else:
                words[first + FrameWord.PARTIAL] += 1
                self._count(selection, now_ns)

    def _count(self, selection: Selection, now_ns: int) -> None:
        words = self._words
        for pd in selection.pds:
            first = pd.place.words
            words[first + TxWord.REASON + pd.reason] += 1
            words[first + TxWord.LAST_REASON] = pd.reason
            words[first + TxWord.SENT_AT_NS] = now_ns
            pd.trigger.sent(pd.reason, now_ns, pd.data)

    def _fail(self, frame: TxFrame, selection: Selection) -> None:
        """The network refused a frame: change and event triggers try again in the next cycle."""
        words, first = self._words, frame.place.words
        words[first + FrameWord.STATE] = _NOT_SENT
        words[first + FrameWord.SKIPPED] += 1
        for pd in selection.pds:
            words[pd.place.words + TxWord.SKIPPED] += 1

    def _skip(self, frame: TxFrame, pds: Sequence[TxPd]) -> None:
        words = self._words
        if frame.suppressed:
            words[frame.place.words + FrameWord.STATE] = _NOT_SENT
            words[frame.place.words + FrameWord.SKIPPED] += 1
        for pd in pds:
            words[pd.place.words + TxWord.SKIPPED] += 1
            pd.trigger.use_up_event()

    def _control(self, name: str) -> int:
        place = self._image.places[name]
        return int.from_bytes(self._inputs.memory[place.bit_offset // 8 :][:2], "little")
