"""A station of the engine, and what is built to take its place.

All that takes time is done when a successor is made, beside the running cycles, of which it only
reads.  It belongs to nobody until it takes over, which copies numbers and little else.
"""

from __future__ import annotations

from eap.engine import tcp_ports
from eap.engine.bus_mapping import BusMapping
from eap.engine.engine_bus import EngineBus
from eap.errors import EngineRefusedError
from eap.net.image_file import ImageFile, prepare_image
from eap.net.tcpport import TcpPort
from eap.pd.engine import Engine
from eap.pd.handover import ImageHandover, needs_new_start
from eap.pd.layout import plan_layout
from eap.pd.spec import StationSpec
from eap.pd.station import Station


class EngineStation:
    """A station of the engine and its image; both are replaced together."""

    def __init__(self, station: Station, file: ImageFile) -> None:
        self.station = station
        self.file = file
        self.buses: dict[str, EngineBus] = {}
        """By port."""
        self.tcp_ports: dict[str, TcpPort] = {}

    def settle_tcp(self) -> None:
        """Have connections only to where the station sends now."""
        for name, port in self.tcp_ports.items():
            tcp_ports.follow(port, self.station, name)

    def close(self) -> None:
        """Let go of the image and of all connections."""
        self.file.close()
        for port in self.tcp_ports.values():
            port.close()


class Successor:
    """What is to take the place of a station; made in a thread, or in a test without one.

    Raises:
        EngineRefusedError: this cannot be done without a new start.
        EapError, ValueError, LookupError: the specification is not that of a station.
    """

    def __init__(self, place: EngineStation, spec: StationSpec) -> None:
        before = place.station
        if reasons := needs_new_start(before.spec, spec):
            raise EngineRefusedError("\n".join(reasons))
        self._place = place
        self._file = prepare_image(place.file.path, plan_layout(spec), place.file.generation + 1)
        try:
            image = self._file.image
            self._images = ImageHandover(before.image, image)
            self._images.carry_words()
            self._images.carry_values(before.inputs.memory)
            self._station = Station(spec, image, self._file.wake_waiters)
            self._tcp_ports = _new_tcp_ports(place, spec)
            self._station.prepare_handover(before, self._tcp_ports)
            self._images.commit()
            memory_of = self._station.memory_of
            self._mappings: list[tuple[EngineBus, BusMapping]] = []
            for port in spec.ports:
                if (bus := place.buses.get(port.name)) is not None:
                    self._mappings.append((bus, bus.prepare_mapping(port, image, memory_of)))
        except BaseException:
            self.discard()
            raise

    @property
    def is_current(self) -> bool:
        """Whether it still fits what it is to follow."""
        return self._images.is_current

    def take_over(self, engine: Engine, now_ns: int) -> Station:
        """Take the place, between two cycles; return who had it.

        Raises:
            EnvironmentalError: the image cannot be put in its place; nothing has changed.
        """
        place, station = self._place, self._station
        before = place.station
        self._images.carry_words()
        self._images.carry_values(before.inputs.memory)
        self._file.take_name(place.file.path)
        place.file.retire()
        # Who writes from now on sees that the image is retired, and writes in the new one again.
        if before.inputs.refresh():
            self._images.carry_values(before.inputs.memory)
        station.follow(before, now_ns)
        for bus, mapping in self._mappings:
            bus.swap_mapping(mapping)
        engine.replace(before, station, now_ns)
        self._file.release()
        place.file.wake_waiters()
        place.file.close()
        place.file, place.station = self._file, station
        place.tcp_ports.update(self._tcp_ports)
        return before

    def discard(self) -> None:
        """Give it up."""
        self._file.discard()


def _new_tcp_ports(place: EngineStation, spec: StationSpec) -> dict[str, TcpPort]:
    """Return the channels of ports that have not had any TCP so far."""
    return {
        port.name: tcp_ports.open_tcp_port(port, place.station.channel(port.name))
        for port in spec.ports
        if port.name not in place.tcp_ports and tcp_ports.has_tcp(spec, port)
    }
