"""The objects of one EAP port as the records of a specification."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from ipaddress import IPv4Address
from typing import Any

from msgspec.structs import replace

from eap.device.eap_content import COUNTED, PORT
from eap.device.eap_dictionary import EapDictionary
from eap.device.eap_mapping import data_budget, frame_budget, place
from eap.device.eap_rules import GROUPS, is_group
from eap.device.fault import DeviceFault, FaultCode
from eap.ids import Destination, DestinationKind, MacAddr, NetId
from eap.od.abort import AbortCode, SdoAbortError
from eap.od.profiles import eap1000 as profile
from eap.od.profiles.eap1000keys import (
    AddressMode,
    Configured,
    Frame,
    Port,
    Rx,
    RxFlag,
    Substituted,
    Tx,
    Var,
    Waking,
    WrittenBy,
)
from eap.pd.spec import (
    REQUESTER,
    OnChangeSpec,
    PortSpec,
    RxPdSpec,
    Substitute,
    TriggerSpec,
    TxFrameSpec,
    TxPdSpec,
    VariableSpec,
    Wake,
    Writer,
)

_MODES = {
    "udp": (AddressMode.IP, AddressMode.TCP, AddressMode.REQUESTER),
    "tcp": (AddressMode.TCP, AddressMode.REQUESTER),
    "ethernet": (AddressMode.MAC, AddressMode.NETID, AddressMode.REQUESTER),
    "loop": (AddressMode.MAC, AddressMode.REQUESTER),
}
"""How a port of each kind of interface can address."""


class PortReader:
    """Reads the objects of one port.

    Attributes:
        name: Of the port.
        sent: Index, PD and frame of all TxPDs that :meth:`frames` has yielded.
    """

    def __init__(self, dictionary: EapDictionary) -> None:
        self._dictionary = dictionary
        self.name = dictionary.port.name
        self._scheme = dictionary.uri.scheme
        self.sent: list[tuple[int, TxPdSpec, TxFrameSpec]] = []

    def fault(self, code: FaultCode, detail: str, index: int, subindex: int = 0) -> DeviceFault:
        """Make a fault about an object of this port."""
        return DeviceFault(code, detail, index, subindex, self.name)

    def _values(self, index: int) -> Callable[[int], Any]:
        entries = self._dictionary[index].entries
        return lambda subindex: entries[subindex].value

    def times(self) -> tuple[int, int]:
        """Return device cycle and phase in microseconds."""
        value = self._values(COUNTED)
        return value(Configured.DEVICE_CYCLE_TIME), value(Configured.PHASE)

    def port(self) -> PortSpec:
        """Return the port as it is to be."""
        value, scheme = self._values(PORT), self._scheme
        for subindex, schemes in (
            (Port.VLAN_ID, {"ethernet"}),
            (Port.VLAN_PRIORITY, {"ethernet"}),
            (Port.TCP, {"udp", "tcp"}),
            (Port.BROADCAST, {"udp"}),
        ):
            if value(subindex) and scheme not in schemes:
                detail = f"only on {' and '.join(sorted(schemes))}, this is {scheme}"
                raise self.fault(FaultCode.PORT, detail, PORT, subindex)
        if value(Port.VLAN_PRIORITY) and not value(Port.VLAN_ID):
            raise self.fault(FaultCode.PORT, "a priority needs a VLAN", PORT, Port.VLAN_PRIORITY)
        return replace(
            self._dictionary.port,
            vlan_id=value(Port.VLAN_ID),
            vlan_priority=value(Port.VLAN_PRIORITY),
            join=tuple(self._groups()),
            broadcast=value(Port.BROADCAST),
            tcp=value(Port.TCP),
            wake=Wake[Waking(value(Port.WAKE)).name],
            eap_sm=value(Port.EAP_SM),
        )

    def _groups(self) -> Iterator[str]:
        for subindex, entry in self._dictionary[GROUPS].entries.items():
            if subindex and entry.value:
                kinds = {"ethernet": True, "udp": False}
                if not is_group(entry.value, ethernet=kinds.get(self._scheme)):
                    detail = f"{entry.value} cannot be joined on {self._scheme}"
                    raise self.fault(FaultCode.PORT, detail, GROUPS, subindex)
                yield entry.value

    def variables(self) -> Iterator[tuple[int, VariableSpec]]:
        """Yield index and record of each variable."""
        for index in self._dictionary.members(*profile.VARIABLES):
            value = self._values(index)
            is_sent = index <= profile.TX_VARIABLE.last
            kind = self._dictionary[index].entries[Var.DEFAULT].kind
            given = value(Var.DEFAULT_GIVEN)
            default: Any = kind.to_plain(value(Var.DEFAULT)) if given else None
            yield (
                index,
                VariableSpec(
                    name=value(Var.NAME),
                    type=kind.text,
                    writer=Writer[WrittenBy(value(Var.WRITER)).name] if is_sent else Writer.ENGINE,
                    default=default,
                    unit=value(Var.UNIT),
                    comment=value(Var.COMMENT),
                ),
            )

    def frames(self) -> Iterator[tuple[int, TxFrameSpec]]:
        """Yield index and record of each frame that is enabled, with the PDs that are."""
        seen: dict[int, int] = {}
        for index in self._dictionary.members(profile.TX_FRAME):
            listed = list(self._dictionary.listed_pds(index))
            for subindex, pd in listed:
                if pd in seen:
                    detail = f"0x{pd:04X} is in 0x{seen[pd]:04X} too"
                    raise self.fault(FaultCode.PD_IN_TWO_FRAMES, detail, index, subindex)
                if pd not in self._dictionary:
                    detail = f"TxPD 0x{pd:04X}"
                    raise self.fault(FaultCode.MISSING_OBJECT, detail, index, subindex)
                seen[pd] = index
            if self._values(index)(Frame.ENABLED):
                yield index, self._frame(index, [pd for _, pd in listed])
        for pd in self._dictionary.members(profile.TX_PD):
            if pd not in seen and self._values(pd)(Tx.ENABLED):
                raise self.fault(FaultCode.PD_WITHOUT_FRAME, self._dictionary.name_of(pd), pd)

    def _frame(self, index: int, listed: list[int]) -> TxFrameSpec:
        value = self._values(index)
        enabled = [pd for pd in listed if self._values(pd)(Tx.ENABLED)]
        pds = tuple(self._tx(pd) for pd in enabled)
        if not pds:
            raise self.fault(FaultCode.EMPTY_FRAME, value(Frame.NAME), index, Frame.TXPD)
        mode = value(Frame.ADDRESS_MODE)
        length, budget = self._dictionary.frame_length(index), frame_budget(self._scheme, mode)
        if length > budget:
            detail = f"{length} octets, at most {budget} go there"
            raise self.fault(FaultCode.FRAME_TOO_LONG, detail, index, Frame.FRAME_LENGTH)
        frame = TxFrameSpec(
            name=value(Frame.NAME),
            port=self.name,
            destination=self._destination(index, AddressMode(mode)),
            pds=pds,
            divider=value(Frame.DIVIDER),
            modulo=value(Frame.MODULO),
            changeable=value(Frame.CHANGEABLE),
            mac=_known_mac(value(Frame.DESTINATION_MAC)) if mode == AddressMode.NETID else "",
            monitor_interval_ms=value(Frame.MONITORING_INTERVAL),
            monitor_ip=_text_of_ip(value(Frame.MONITOR_IP)),
        )
        self.sent += [(at, pd, frame) for at, pd in zip(enabled, pds, strict=True)]
        return frame

    def _destination(self, index: int, mode: AddressMode) -> str:
        value = self._values(index)
        if mode not in _MODES[self._scheme]:
            detail = f"{mode.name} is no way to address from {self._scheme}"
            raise self.fault(FaultCode.NO_DESTINATION, detail, index, Frame.ADDRESS_MODE)
        if mode is AddressMode.REQUESTER:
            return REQUESTER
        if mode is AddressMode.MAC:
            address: bytes = MacAddr(value(Frame.DESTINATION_MAC))
            subindex = Frame.DESTINATION_MAC
            destination = Destination(DestinationKind.MAC, str(address))
        elif mode is AddressMode.NETID:
            address = NetId(value(Frame.DESTINATION_NETID))
            subindex = Frame.DESTINATION_NETID
            destination = Destination(DestinationKind.NET_ID, str(address))
        else:
            address = value(Frame.DESTINATION_IP)
            subindex = Frame.DESTINATION_IP
            kind = DestinationKind[mode.name]
            host = str(IPv4Address(address))
            destination = Destination(kind, host, value(Frame.PORT_NUMBER))
        if not any(address) or (mode is AddressMode.TCP and destination.is_group):
            raise self.fault(FaultCode.NO_DESTINATION, str(destination), index, subindex)
        return str(destination)

    def _tx(self, index: int) -> TxPdSpec:
        value = self._values(index)
        given = value(Tx.ON_CHANGE_TIMEOUT), value(Tx.ON_CHANGE_INHIBIT)
        trigger = TriggerSpec(
            cycle_us=value(Tx.CYCLE_TIME),
            divider=value(Tx.DIVIDER),
            modulo=value(Tx.MODULO),
            on_change=OnChangeSpec(*given) if value(Tx.ON_CHANGE) or any(given) else None,
            event=value(Tx.EVENT),
        )
        return TxPdSpec(
            name=value(Tx.NAME),
            pd_id=value(Tx.PD_ID),
            variables=self._mapped(index),
            version=value(Tx.VERSION),
            trigger=trigger,
            poll_request=self._asked(index, Tx.POLL_REQUEST_RXPD),
            changeable=value(Tx.CHANGEABLE),
        )

    def subscriptions(self) -> Iterator[tuple[int, RxPdSpec]]:
        """Yield index and record of each RxPD that is enabled."""
        for index in self._dictionary.members(profile.RX_PD):
            value = self._values(index)
            flags, publisher = value(Rx.FLAGS), NetId(value(Rx.PUBLISHER))
            if not flags & RxFlag.ENABLED:
                continue
            is_any = flags & RxFlag.IGNORE_NETID or not any(publisher)
            yield (
                index,
                RxPdSpec(
                    name=value(Rx.NAME),
                    port=self.name,
                    pd_id=value(Rx.PD_ID),
                    variables=self._mapped(index),
                    publisher="" if is_any else str(publisher),
                    version=value(Rx.VERSION),
                    ignore_version=bool(flags & RxFlag.IGNORE_VERSION),
                    timeout_ms=value(Rx.TIME_OUT),
                    substitute=Substitute[Substituted(value(Rx.SUBSTITUTE)).name],
                    sender_cycle_us=value(Rx.SENDER_CYCLE),
                    step=value(Rx.STEP),
                    poll_request=self._asked(index, Rx.POLL_REQUEST_TXPD),
                    changeable=value(Rx.CHANGEABLE),
                    source=value(Rx.SOURCE),
                ),
            )

    def _mapped(self, index: int) -> tuple[str, ...]:
        """Return the names of a PD's variables; its PDO has to be there and whole."""
        dictionary, pdo = self._dictionary, self._values(index)(Tx.PDO_INDEX)
        name = dictionary.name_of(index)
        if not pdo:
            raise self.fault(FaultCode.NO_PDO, name, index, Tx.PDO_INDEX)
        if pdo not in dictionary:
            detail = f"PDO 0x{pdo:04X} of {name}"
            raise self.fault(FaultCode.MISSING_OBJECT, detail, index, Tx.PDO_INDEX)
        try:
            placed = place(
                dictionary, pdo, dictionary[pdo].max_subindex, data_budget(dictionary.uri)
            )
        except SdoAbortError as exc:
            is_long = exc.code == AbortCode.PDO_LENGTH
            code = FaultCode.FRAME_TOO_LONG if is_long else FaultCode.BAD_MAPPING
            raise self.fault(code, str(exc), pdo, exc.subindex) from None
        if not placed.indexes:
            raise self.fault(FaultCode.EMPTY_PDO, f"PDO of {name}", pdo)
        return tuple(dictionary.name_of(each) for each in placed.indexes)

    def _asked(self, index: int, subindex: int) -> str:
        """Return the name of the PD that a poll request refers to, empty if it is 0."""
        asked = self._values(index)(subindex)
        if not asked:
            return ""
        if asked not in self._dictionary:
            raise self.fault(FaultCode.MISSING_OBJECT, f"PD 0x{asked:04X}", index, subindex)
        return self._dictionary.name_of(asked)


def _known_mac(octets: bytes) -> str:
    """Return the address behind a NetID; empty if it is to be learned, as a group is nobody's."""
    address = MacAddr(octets)
    return str(address) if any(address) and not address.is_group else ""


def _text_of_ip(octets: bytes) -> str:
    return str(IPv4Address(octets)) if any(octets) else ""
