"""One recording of a running appliance, driven by looks at its shared memory.

The recorder attaches to the appliance, and again when that was stopped and runs again; restarts of
its processes change nothing.  A station that is changed begins another file if what is recorded of
it is changed.  A look takes little time and never waits for the disk, see
:mod:`eap.recording.disk`.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from time import monotonic_ns
from typing import Any, TypeAlias

import msgspec

from eap.closeable import Closeable
from eap.config.record_texts import matcher
from eap.errors import EapError, EnvironmentalError, ImageError
from eap.expressions import Condition
from eap.net.image_file import open_image
from eap.pd.layout import ImageLayout
from eap.recording.capture import (
    CapturedBlock,
    Gap,
    Look,
    PortCapture,
    StationCapture,
    frames_in,
    samples_in,
    unix_offset_ns,
)
from eap.recording.condition import ConditionWatch
from eap.recording.disk import DiskThread
from eap.recording.files import FileSequence, RecordingFile
from eap.recording.header import EventKind, RecordingEvent
from eap.recording.published import published_by
from eap.recording.ring import BlockRing, RecordingTrigger, TriggerAction
from eap.recording.selection import select_variables
from eap.recording.sinks import FramesSink, ValuesSink, header_of, placed_variables
from eap.recording.stores import StoreSequence, StoreSink, make_store, shown_url
from eap.runtime.folder import ApplianceFolder, ApplianceInfo
from eap.runtime.recordings import RecordingState

Sequenced: TypeAlias = FileSequence | StoreSequence
ENDINGS = {"values": ".mcap", "frames": ".pcapng"}
_LOOK_NS = 50_000_000
_SHORTEST_LOOK_NS = 2_000_000
_ATTACH_NS = 500_000_000
_CHECK_NS = 1_000_000_000
_KEPT_EVENTS = 1000
_CLOCK_STEP_NS = 1_000_000_000
"""Step of the host's clock that begins another file."""


class RecorderOptions(msgspec.Struct, frozen=True, kw_only=True):
    """Options of one recording; 0 or empty is without.

    Attributes:
        name: Of the recording.
        kind: ``values`` or ``frames``.
        base: Path of the files without number and ending.
        plant: Name of the plant.
        folder: Of the appliance.
        patterns: Of variables or ports; none for all.
        every_cycles: Distance of recorded cycles.
        every_ms: The same as a time.
        ring_ns: Time in memory.
        when: Condition.
        before_ns: Time to record before it becomes true.
        after_ns: Time to record behind that.
        split_ns: Longest time of a file.
        split_bytes: Largest size of a file.
        keep: Number of files.
        for_ns: Time of the whole recording.
        to: URL of a store that takes the values instead of files.
        room: Bytes to leave free on the disk; None for the default.
        is_of_plant: Whether the plant file has it: it continues the files of earlier runs, and
            ends with the plant.
    """

    name: str
    kind: str
    base: str
    plant: str
    folder: str
    patterns: tuple[str, ...] = ()
    every_cycles: int = 1
    every_ms: int = 0
    ring_ns: int = 0
    when: str = ""
    before_ns: int = 0
    after_ns: int = 0
    split_ns: int = 0
    split_bytes: int = 0
    keep: int = 0
    for_ns: int = 0
    to: str = ""
    room: int | None = None
    is_of_plant: bool = False

    def texts(self) -> dict[str, str]:
        """Return those of the command line that were given, by name."""
        every = f"{self.every_ms}ms" if self.every_ms else f"{self.every_cycles}"
        found = {
            "patterns": " ".join(self.patterns),
            "kind": self.kind,
            "every": every if every != "1" else "",
            "ring": _seconds(self.ring_ns),
            "when": self.when,
            "before": _seconds(self.before_ns),
            "after": _seconds(self.after_ns),
            "split": f"{self.split_bytes} B" if self.split_bytes else _seconds(self.split_ns),
            "keep": str(self.keep or ""),
            "for": _seconds(self.for_ns),
            "to": shown_url(self.to) if self.to else "",
        }
        return {name: text for name, text in found.items() if text}


class Attachment(Closeable):
    """The captures of one running appliance.

    Args:
        options: Of the recording.
        info: Of the appliance.

    Attributes:
        layouts: Of all its stations.

    Raises:
        ImageError: an image cannot be opened, or the patterns select nothing.
    """

    def __init__(self, options: RecorderOptions, info: ApplianceInfo) -> None:
        self._options = options
        self._folder = ApplianceFolder(Path(options.folder))
        self.info = info
        self._paths = {name: self._folder.image(name) for name in info.stations}
        self._stations: list[StationCapture] = []
        self.frames: PortCapture | None = None
        self.condition: ConditionWatch | None = None
        self._check_ns = 0
        try:
            self._files = self._image_files()
            self.layouts = self._read_layouts()
            if options.kind == "frames":
                self.frames = PortCapture(self._folder.frames)
            else:
                self._open_stations()
                self.layouts = self._read_layouts()
            if options.when:
                self.condition = ConditionWatch(Condition(options.when), self._paths)
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Release all."""
        for each in (*self._stations, self.frames, self.condition):
            if each is not None:
                each.close()

    @property
    def selected(self) -> int:
        """Number of variables or ports."""
        patterns = self._options.patterns
        if self._options.kind == "values":
            return sum(len(select_variables(each, patterns)) for each in self.layouts)
        is_selected = matcher(patterns)
        return sum(
            is_selected(f"{layout.station}/{port.name}")
            for layout in self.layouts
            for port in layout.ports
        )

    @property
    def period_ns(self) -> int:
        """Time between two looks: samples are kept for several times that."""
        depths = [capture.depth_ns for capture in self._stations]
        return max(min([_LOOK_NS, *(depth // 4 for depth in depths)]), _SHORTEST_LOOK_NS)

    def looks(self, offset_ns: int) -> list[Look]:
        """Return what came since the last call."""
        looks = [capture.look(offset_ns) for capture in self._stations]
        if self.frames is not None:
            looks.append(self.frames.look(offset_ns))
        return looks

    def follow(self, now_ns: int) -> bool:
        """Follow changes of the stations; return whether they concern what is recorded.

        Raises:
            ImageError: an image cannot be opened.
        """
        is_due = now_ns >= self._check_ns
        moved = [each.follow(thoroughly=is_due) for each in self._stations]
        has_moved = any(moved)
        if self.condition is not None:
            self.condition.follow(thoroughly=is_due)
        # Frames have no captures that move.
        if not is_due and not has_moved and self._stations:
            return False
        if is_due:
            self._check_ns = now_ns + _CHECK_NS
        files = self._image_files()
        if files == self._files and not has_moved:
            return False  # reading the directories of all images takes a while
        self._files = files
        layouts = self._read_layouts()
        before, self.layouts = self.layouts, layouts
        return layouts != before and self._facts(layouts) != self._facts(before)

    def file_maker(self, sequence: Sequenced) -> Callable[[Path, int], Any]:
        """Return the function that opens files in *sequence* of what is recorded now."""
        # Another thread calls it, perhaps after the layouts have changed.
        options, layouts, frames, info = self._options, self.layouts, self.frames, self.info

        def make(path: Path, time_ns: int) -> RecordingFile | StoreSink:
            header = header_of(info, layouts, options.texts(), time_ns)
            if isinstance(sequence, StoreSequence):
                return StoreSink(sequence, header, layouts, options.patterns)
            if frames is None:
                return ValuesSink(path, header, layouts, options.patterns)
            return FramesSink(path, header, layouts, options.patterns, lambda: frames.ports)

        return make

    def _open_stations(self) -> None:
        options = self._options
        for layout in self.layouts:
            if select_variables(layout, options.patterns):
                every = options.every_cycles
                if options.every_ms:
                    # There is one sample a cycle: the period becomes a number of cycles.
                    every = max(1, round(1000 * options.every_ms / layout.cycle_us))
                capture = StationCapture(self._paths[layout.station], every)
                self._stations.append(capture)
        if not self._stations:
            raise ImageError("the patterns select no variable of the plant as it is now")

    def _image_files(self) -> list[int]:
        """Return what tells the files of the images from those that replace them."""
        try:
            return [path.stat().st_ino for path in self._paths.values()]
        except OSError as exc:
            raise ImageError(f"a process image is missing: {exc}") from None

    def _read_layouts(self) -> list[ImageLayout]:
        # Of an image that was replaced since the last look, there are samples to come.
        found = {capture.layout.station: capture.layout for capture in self._stations}
        for station, path in self._paths.items():
            if station not in found:
                with open_image(path) as file:
                    found[station] = file.image.layout
        return [found[station] for station in self._paths]

    def _facts(self, layouts: Sequence[ImageLayout]) -> Any:
        """Return what the header and the channels of a file say."""
        patterns = self._options.patterns
        return published_by(layouts), [
            (each.samples.size, placed_variables(each, patterns)) for each in layouts
        ]


class Recorder:
    """One recording.

    Args:
        options: Of the recording.
        now_ns: The time on the monotonic clock.

    Attributes:
        state: For ``record list``.
        is_over: Whether it has ended by itself.
    """

    def __init__(self, options: RecorderOptions, now_ns: int) -> None:
        self._options = options
        self._offset_ns = offset_ns = unix_offset_ns()
        self.state = RecordingState(
            name=options.name,
            kind=options.kind,
            plant=options.plant,
            started_at=(now_ns + offset_ns) / 1e9,
            options=options.texts(),
            is_of_plant=options.is_of_plant,
        )
        self.is_over = False
        self._attached: Attachment | None = None
        self._attach_ns = 0
        self._end_ns = now_ns + options.for_ns if options.for_ns else None
        has_ring = bool(options.ring_ns)
        self._files: Sequenced
        if options.to:
            self._files = StoreSequence(make_store(options.to), options.to)
        else:
            self._files = FileSequence(
                Path(options.base),
                ENDINGS[options.kind],
                numbered=has_ring or bool(options.split_ns or options.split_bytes),
                continues=options.is_of_plant,
                split_ns=options.split_ns,
                split_bytes=options.split_bytes,
                keep=options.keep,
                room=options.room,
            )
        self._ring = _make_ring(options.ring_ns) if has_ring else None
        self._trigger = RecordingTrigger(options.before_ns, options.after_ns)
        self._events: deque[tuple[int, RecordingEvent | Gap]] = deque(maxlen=_KEPT_EVENTS)
        self._disk = DiskThread(self._files)
        self._needs_file = self._ring is None

    def look(self, now_ns: int) -> int:
        """Take what came since the last look; return when the next one is due."""
        if self._end_ns is not None and now_ns >= self._end_ns:
            self.end(f"{self._options.for_ns / 1e9:g} s are over", now_ns)
        if self._disk.failure:
            self.end(self._disk.failure, now_ns)
        if self.is_over:
            return now_ns
        attached = self._attached
        if attached is None:
            if now_ns >= self._attach_ns:
                self._attach_ns = now_ns + _ATTACH_NS
                self._attach()
            # The first samples of a plant that was just found are taken at once.
            return now_ns + (_LOOK_NS if self._attached is None else 0)
        offset_ns = unix_offset_ns()
        try:
            if abs(offset_ns - self._offset_ns) > _CLOCK_STEP_NS:
                self._set_clock(attached, now_ns, offset_ns)
            self._offset_ns = offset_ns
            self._take(attached, now_ns, offset_ns)
            if attached.follow(now_ns):
                self._change(attached, now_ns + offset_ns)
        except ImageError as exc:
            self._detach(str(exc))
            return now_ns
        return now_ns + attached.period_ns

    def check(self, now_ns: int) -> RecordingState:
        """Look whether the appliance still runs, and return the state; called once a second."""
        if self._attached is not None:
            folder = ApplianceFolder(Path(self._options.folder))
            if not folder.is_alive():
                # The shared memory of a killed appliance stays readable, without new samples.
                self._detach("the plant does not run")
        state = self.state
        state.messages, state.octets = self._files.messages, self._files.octets
        if isinstance(self._files, StoreSequence):
            state.not_stored = self._files.lost
            if state.state == "recording":
                state.reason = self._files.trouble
        state.files = [str(path) for path in self._files.paths]
        state.triggers = self._trigger.count
        if self._ring is not None:
            state.ring_s = round(self._ring.held_ns / 1e9, 1)
            state.ring_is_cut = self._ring.is_cut
        return state

    def mark(self, text: str, now_ns: int) -> None:
        """Write *text* into the recording, with the present time."""
        time_ns = now_ns + unix_offset_ns()
        self._add_event(RecordingEvent(time_ns=time_ns, kind=EventKind.MARK, text=text))

    def snapshot(self, now_ns: int) -> threading.Event:
        """Write the ring to a file; the event is set when that is done.

        Raises:
            EnvironmentalError: there is no ring, or nothing in it, or it is being written.
        """
        if self._ring is None:
            raise EnvironmentalError(
                f"recording {self.state.name!r} has no ring: start it with --ring SECONDS"
            )
        if self._trigger.is_recording:
            raise EnvironmentalError(
                f"recording {self.state.name!r} writes its ring already, for its condition became"
                f" true: {self._files.paths[-1]}"
            )
        if self._attached is None or not self._ring.held_ns:
            raise EnvironmentalError(f"recording {self.state.name!r} has nothing in its ring yet")
        if self._attached is not None:
            self._take(self._attached, now_ns, unix_offset_ns())
        self._open_ring(self._attached, 0)
        return self._disk.close_file(now_ns + unix_offset_ns())

    def end(self, reason: str, now_ns: int) -> None:
        """End the recording: what is in memory is written."""
        if self.is_over:
            return
        self.is_over = True
        if self._attached is not None:
            offset_ns = unix_offset_ns()
            with suppress(ImageError):  # what came before is in the file
                self._take(self._attached, now_ns, offset_ns)
        self._disk.end(now_ns + unix_offset_ns())
        if self._attached is not None:
            self._attached.close()
        self._attached = None
        self.state.state = "ended"
        self.state.reason = self._disk.failure or reason
        self.state.failed = self.has_failed
        self.state.ended_at = (now_ns + unix_offset_ns()) / 1e9

    @property
    def is_settled(self) -> bool:
        """True if it is certain that it records, or that it waits."""
        return self.state.state in {"armed", "waiting"} or self._files.is_open

    @property
    def has_failed(self) -> bool:
        """True if the disk ended the recording."""
        return bool(self._disk.failure)

    def _attach(self) -> None:
        folder = ApplianceFolder(Path(self._options.folder))
        try:
            if not folder.is_alive():
                raise ImageError("the plant does not run")
            self._attached = Attachment(self._options, folder.read_info())
        except (EapError, OSError, ValueError) as exc:
            self.state.state, self.state.reason = "waiting", str(exc)
            return
        self.state.selected = self._attached.selected
        self.state.state = "recording" if self._ring is None else "armed"
        self.state.reason = ""
        self._needs_file = self._ring is None

    def _detach(self, reason: str) -> None:
        if self._attached is not None:
            self._attached.close()
            self._attached = None
        # The plant may stay away for long: its file is whole in the meantime.
        self._disk.close_file(monotonic_ns() + unix_offset_ns())
        self._trigger.reset()
        if self._ring is not None:
            self._ring.clear()
        self.state.state, self.state.reason = "waiting", reason

    def _take(self, attached: Attachment, now_ns: int, offset_ns: int) -> None:
        if self._needs_file:
            self._needs_file = False
            self._disk.open(attached.file_maker(self._files), now_ns + offset_ns)
            self._write_events(0)
        ring, is_writing = self._ring, self._ring is None or self._trigger.is_recording
        for blocks, gaps in attached.looks(offset_ns):
            for gap in gaps:
                if gap.is_loss:
                    self.state.lost += gap.missing
                self._add_event(gap)
            for block in blocks:
                if ring is not None:
                    ring.add(block)
                if is_writing:
                    self._write(block)
        if attached.condition is not None:
            for time_ns, is_true in attached.condition.look(offset_ns):
                self._act(attached, time_ns, self._trigger.update(time_ns, is_true=is_true))
            action = self._trigger.handle_time(now_ns + offset_ns)
            self._act(attached, now_ns + offset_ns, action)

    def _write(self, block: CapturedBlock) -> None:
        # Looks go on while the disk is slow: samples stay in shared memory for a short time only.
        if not self._disk.write(block):
            lost = _count(block)
            self.state.lost += lost
            self._disk.add_gap(Gap(block.source, block.first_ns, lost, is_loss=True))

    def _act(self, attached: Attachment, time_ns: int, action: TriggerAction | None) -> None:
        if action is TriggerAction.OPEN:
            self._open_ring(attached, time_ns - self._trigger.before_ns)
            self.state.state = "recording"
        elif action is TriggerAction.CLOSE:
            self._disk.close_file(time_ns)
            self.state.state = "armed"
        if action in {TriggerAction.OPEN, TriggerAction.MARK}:
            text = self._options.when
            event = RecordingEvent(time_ns=time_ns, kind=EventKind.TRIGGER, text=text)
            self._disk.add_event(event)

    def _open_ring(self, attached: Attachment, since_ns: int) -> None:
        """Begin a file with what the ring has from *since_ns* on."""
        ring = self._ring
        assert ring is not None  # noqa: S101  only recordings with a ring come here
        blocks = list(ring.since(since_ns))
        first_ns = blocks[0].first_ns if blocks else since_ns
        self._disk.open(attached.file_maker(self._files), first_ns)
        for block in blocks:
            self._write(block)
        self._write_events(first_ns)

    def _set_clock(self, attached: Attachment, now_ns: int, offset_ns: int) -> None:
        """Begin anew at another time: in one file, and in a ring, times only grow."""
        self._take(attached, now_ns, self._offset_ns)
        self._trigger.reset()
        self._disk.close_file(now_ns + self._offset_ns)
        self._change(attached, now_ns + offset_ns)
        step_s = (offset_ns - self._offset_ns) / 1e9
        text = f"the clock of this host was set by {step_s:+.3f} s"
        event = RecordingEvent(time_ns=now_ns + offset_ns, kind=EventKind.MARK, text=text)
        self._add_event(event)

    def _change(self, attached: Attachment, time_ns: int) -> None:
        """Begin another file: the stations were changed."""
        if self._ring is not None:
            self._ring.clear()
        if self._ring is None or self._trigger.is_recording:
            self._disk.open(attached.file_maker(self._files), time_ns)
        self.state.selected = attached.selected

    def _add_event(self, event: RecordingEvent | Gap) -> None:
        if self._ring is not None or self._attached is None:
            self._events.append((event.time_ns, event))
        if self._attached is not None and (self._ring is None or self._trigger.is_recording):
            self._post(event)

    def _write_events(self, since_ns: int) -> None:
        for time_ns, event in self._events:
            if time_ns >= since_ns:
                self._post(event)
        if self._ring is None:
            self._events.clear()

    def _post(self, event: RecordingEvent | Gap) -> None:
        if isinstance(event, Gap):
            self._disk.add_gap(event)
        else:
            self._disk.add_event(event)


def _seconds(ns: int) -> str:
    return f"{ns / 1e9:g}s" if ns else ""


def _count(block: CapturedBlock) -> int:
    """Return the number of samples or frames of a block."""
    found = samples_in(block) if block.size else frames_in(block, ())
    return sum(1 for _ in found)


def _make_ring(length_ns: int) -> BlockRing:
    # A dependency of mcap; zlib takes five times as long.
    import zstandard

    return BlockRing(
        length_ns,
        zstandard.ZstdCompressor(level=1).compress,
        zstandard.ZstdDecompressor().decompress,
    )
