"""Observer of process data on a network: each PD that is sent, by anyone to anyone.

It is fed with frames and their arrival times and configures nothing.  Memory is bounded: beyond the
limit a PD that was seen once makes room for a new one, so a flood of invented publishers cannot
push out those that send again; what is not kept is counted.
"""

from __future__ import annotations

from ipaddress import IPv4Address
from typing import NamedTuple

from eap.codec.ethercat import EtherCatHeader, FrameType
from eap.codec.pd import FollowedFrame, PdHeader, follow_pds
from eap.codec.wire import Buffer
from eap.errors import CodecError
from eap.ids import NetId
from eap.pd.link import TOGGLE_BIT
from eap.pd.rhythm import CycleOrder, CycleWatch, Measured, Rhythm
from eap.pd.words import Reason

MAX_PDS = 4096
"""PDs that are kept; a frame of 1500 bytes holds 185 at most."""
_MAX_SOURCES = 4
"""Addresses that are kept of a PD's senders: a second one is a finding, a hundredth is a flood."""
_MAX_HOSTS = 4096
_SAMPLES_SIZE = 16 << 20
"""Bytes of all samples together."""
_SAMPLED = frozenset((*range(1, 9), 16, 32, 64, 128, 256, 512))
"""Arrivals whose data is kept: some in a row, for counters, and some far apart."""
_ANSWER_NS = 100_000_000
"""Time within which a frame can be the answer to another one."""
_LEAST_ANSWERS = 4
_NOTHING_SENT = 0, 0
_BOTH = 3
"""Both values of the toggle bit."""


class ObservedPath(NamedTuple):
    """Route of a frame: addresses as in the plant file, ports only where not the usual one."""

    transport: str
    """``ethernet``, ``udp`` or ``tcp``."""
    source: str
    destination: str
    """MAC address, or ``IPv4[:PORT]``."""
    vlan_id: int | None = None

    @property
    def source_host(self) -> str:
        """Source without a port number."""
        return self.source if self.transport == "ethernet" else self.source.partition(":")[0]

    @property
    def destination_host(self) -> str:
        """Destination without a port number."""
        if self.transport == "ethernet":
            return self.destination
        return self.destination.partition(":")[0]


class ObservedPdKey(NamedTuple):
    """Identity of an observed PD: two versions, lengths or destinations are two PDs."""

    publisher: bytes
    pd_id: int
    version: int
    length: int
    transport: str
    destination: str
    vlan_id: int | None

    @property
    def destination_kind(self) -> str:
        """``unicast``, ``multicast`` or ``broadcast``."""
        if self.transport == "ethernet":
            if self.destination == "ff:ff:ff:ff:ff:ff":
                return "broadcast"
            return "multicast" if int(self.destination[:2], 16) & 1 else "unicast"
        host = self.destination.partition(":")[0]
        if IPv4Address(host).is_multicast:
            return "multicast"
        # Without a netmask a host number of 255 is taken for the directed broadcast.
        return "broadcast" if host.endswith(".255") else "unicast"


class ObservedPd:
    """One PD on the network.

    Attributes:
        key: Its identity.
        rhythm: Its arrivals.
        sources: Addresses that it came from, as long as there are few.
        samples: Data of some arrivals, oldest first.
        cycle: The cycle counter of its frames.
        wrong_length: Length of the EtherCAT header where that is not what the PDs take, else None.
        eap_sm: The last EAP SM byte.
        toggles: Whether the toggle bit of that byte has had both values.
        repeated: Arrivals with the cycle counter and the toggle bit of the one before.
        quality: That of the last arrival, in units of 100 us.
    """

    __slots__ = (
        "_answers",
        "_data",
        "_last_cycle",
        "_request",
        "_toggled",
        "cycle",
        "eap_sm",
        "key",
        "quality",
        "repeated",
        "rhythm",
        "samples",
        "sources",
        "wrong_length",
    )

    def __init__(self, key: ObservedPdKey) -> None:
        self.key = key
        self.rhythm = Rhythm()
        self.sources: list[str] = []
        self.samples: list[bytes] = []
        self.cycle = CycleWatch()
        self.wrong_length: int | None = None
        self.eap_sm = self.repeated = self.quality = 0
        self._toggled = 0
        self._data: bytes | None = None
        self._last_cycle = -1
        self._request = self._answers = 0

    @property
    def publisher(self) -> NetId:
        """NetID in its frames."""
        return NetId(self.key.publisher)

    @property
    def toggles(self) -> bool:
        """True if the toggle bit has had both values."""
        return self._toggled == _BOTH

    @property
    def is_answer(self) -> bool:
        """True if each arrival followed a frame of the host that it is sent to."""
        received = self.rhythm.received
        return received >= _LEAST_ANSWERS and self._answers >= received - 1

    def measure(self) -> Measured:
        """Return the statistics of the latest arrivals.

        A regular answer looks like a cyclic PD.  It is told from one by the port number, where the
        requester sends from another one than 34980, and by the cycle counter: a cyclic PD has the
        same step each time, an answer only if the rhythms of both stations fit.
        """
        found = self.rhythm.measure(self.cycle.order)
        port = self.key.destination.partition(":")[2] if self.key.transport == "udp" else ""
        is_uneven = not found.step and self.cycle.order is not CycleOrder.CONSTANT
        if self.is_answer and found.trigger is not None and (port or is_uneven):
            found.trigger = Reason.POLL
        return found

    def enter(
        self, frame: FollowedFrame, pd: PdHeader, data: memoryview, at_ns: int, source: str
    ) -> None:
        """Note an arrival."""
        header = frame.header
        if source not in self.sources and len(self.sources) < _MAX_SOURCES:
            self.sources.append(source)
        if frame.has_wrong_length:
            self.wrong_length = frame.length
        toggle = header.eap_sm & TOGGLE_BIT
        if self.toggles and header.cycle == self._last_cycle and toggle == self.eap_sm & TOGGLE_BIT:
            self.repeated += 1
        self._toggled |= 2 if toggle else 1
        self.eap_sm, self._last_cycle, self.quality = header.eap_sm, header.cycle, pd.quality
        self.cycle.enter(header.cycle)
        is_changed = self._data is None or data != self._data
        if is_changed:
            self._data = bytes(data)
        self.rhythm.enter(at_ns, header.cycle, is_changed=is_changed)

    def enter_request(self, number: int, at_ns: int, asked_ns: int) -> None:
        """Note that the host that this PD is sent to has sent *number* frames, the last at a time.

        An answer follows each of them: a PD that comes after some only is sent by itself.
        """
        if number == self._request + 1 and 0 <= at_ns - asked_ns <= _ANSWER_NS:
            self._answers += 1
        self._request = number


class Observer:
    """All PDs of a network.

    Attributes:
        pds: Those that are kept, in the order in which they were first seen.
        frames: Frames of process data.
        wrong_length: Those of them whose EtherCAT header does not cover their PDs.
        cut: Those of which the capture has the begin only.
        malformed: Frames whose PDs reach past their end, and those without a whole header.
        other_types: Frames of other types, by type.
        not_kept: PDs that were not kept, or made room for others: there were too many.
    """

    def __init__(self, limit: int = MAX_PDS) -> None:
        self.pds: dict[ObservedPdKey, ObservedPd] = {}
        self.frames = self.wrong_length = self.cut = self.malformed = self.not_kept = 0
        self.other_types: dict[int, int] = {}
        self._limit = limit
        self._seen_once: dict[ObservedPdKey, None] = {}
        self._hosts: dict[str, tuple[int, int]] = {}
        self._room = _SAMPLES_SIZE

    def receive_frame(self, data: Buffer, at_ns: int, path: ObservedPath) -> None:
        """Note a frame, which starts at its EtherCAT header; nothing in it raises."""
        try:
            ethercat = EtherCatHeader.decode(data)
            if ethercat.type != FrameType.PROCESS_DATA:
                kind = int(ethercat.type)
                self.other_types[kind] = self.other_types.get(kind, 0) + 1
                return
            frame = follow_pds(data)
        except CodecError:
            self.malformed += 1
            return
        self.frames += 1
        self.wrong_length += frame.has_wrong_length
        self.cut += frame.is_cut
        asked = self._hosts.get(path.destination_host)
        for pd, content in frame.pds:
            key = ObservedPdKey(
                frame.header.publisher, pd.pd_id, pd.version, pd.length,
                path.transport, path.destination, path.vlan_id,
            )  # fmt: skip
            observed = self._find(key)
            if observed is None:
                continue
            observed.enter(frame, pd, content, at_ns, path.source)
            if asked is not None:
                observed.enter_request(asked[0], at_ns, asked[1])
            if observed.rhythm.received in _SAMPLED and len(content) == pd.length:
                self._sample(observed, content)
        if path.source_host not in self._hosts and len(self._hosts) >= _MAX_HOSTS:
            self._hosts.clear()  # forged addresses: answers are recognised again a frame later
        sent = self._hosts.get(path.source_host, _NOTHING_SENT)[0]
        self._hosts[path.source_host] = sent + 1, at_ns

    def _find(self, key: ObservedPdKey) -> ObservedPd | None:
        """Return the PD of *key*, None if there is no room for it."""
        observed = self.pds.get(key)
        if observed is not None:
            self._seen_once.pop(key, None)
            return observed
        if len(self.pds) >= self._limit:
            self.not_kept += 1
            if not self._seen_once:
                return None
            oldest = next(iter(self._seen_once))
            del self._seen_once[oldest]
            self._room += sum(map(len, self.pds.pop(oldest).samples))
        observed = self.pds[key] = ObservedPd(key)
        self._seen_once[key] = None
        return observed

    def _sample(self, observed: ObservedPd, content: memoryview) -> None:
        if len(content) <= self._room:
            self._room -= len(content)
            observed.samples.append(bytes(content))
