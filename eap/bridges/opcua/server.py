"""The OPC UA server of a plant: address space, endpoints, clients, and the plant behind them."""

from __future__ import annotations

import asyncio
import gc
import logging
import socket
from collections.abc import Iterable
from copy import copy
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from asyncua import Server, ua
from asyncua.server.event_generator import EventGenerator

from eap.ams.spec import Role
from eap.bridges.bridge import Bridge
from eap.bridges.opcua.address_space import PlantAddressSpace, taken_value
from eap.bridges.opcua.certificates import (
    OwnCertificate,
    TrustStore,
    given_certificate,
    own_certificate,
)
from eap.bridges.opcua.nodes import STATES, MethodNode, StationFacts, VariableNode, plan_nodes
from eap.bridges.opcua.sessions import Client, PlantListener, PlantServer, TrustingPolicy
from eap.bridges.values import Sample
from eap.codec.ads import AdsError, AdsRange, IndexGroup, SdoOffset
from eap.codec.ams import AmsCommand
from eap.config.listen import Listen, parse_listen, role_of_anonymous
from eap.config.opcua import channel_securities
from eap.config.opcua_sections import ChannelSecurity, ClientTrust, OpcUaSection
from eap.control.device import REQUEST_STATE
from eap.control.logins import NOTE_LOGINS
from eap.control.protocol import ErrorCode, WriteOrigin
from eap.control.routes import AMS_ASK
from eap.errors import ControlError, EapError, EnvironmentalError
from eap.patterns import match_names
from eap.release import RELEASE
from eap.runtime.logins import LoginRefusals, Logins, Principal
from eap.runtime.store import plant_folder

STATUS_S = 1.0
_FIRST_PLAN_S = 5.0
"""Time for the plant to answer before clients are served without its nodes."""
_DETECT_MODULES = 0xF002
"""Object of a master whose first entry, written, begins a scan of its bus."""
_SCAN = b"\0\0"
_POLICIES = {
    ChannelSecurity.NONE: (ua.SecurityPolicyType.NoSecurity,),
    ChannelSecurity.BASIC256SHA256: (
        ua.SecurityPolicyType.Basic256Sha256_Sign,
        ua.SecurityPolicyType.Basic256Sha256_SignAndEncrypt,
    ),
    ChannelSecurity.AES256SHA256RSAPSS: (
        ua.SecurityPolicyType.Aes256Sha256RsaPss_Sign,
        ua.SecurityPolicyType.Aes256Sha256RsaPss_SignAndEncrypt,
    ),
}
_CODES: dict[ErrorCode, ua.StatusCodes] = {
    ErrorCode.VALUE: ua.StatusCodes.BadOutOfRange,
    ErrorCode.REFUSED: ua.StatusCodes.BadUserAccessDenied,
    ErrorCode.UNKNOWN_NAME: ua.StatusCodes.BadNodeIdUnknown,
    ErrorCode.BUSY: ua.StatusCodes.BadResourceUnavailable,
    ErrorCode.UNAVAILABLE: ua.StatusCodes.BadNoCommunication,
}
_HEALTHY, _NO_DATA = 255, 1
"""Service levels (OPC 10000-4, 6.6.2.4.2)."""

logger = logging.getLogger(__name__)


class OpcUaServer(Server):  # type: ignore[misc]
    """Server of asyncua with the sessions and channels of this package.

    Args:
        services: Its services.
        trust: The trusted certificates.
    """

    def __init__(self, services: PlantServer, trust: TrustStore) -> None:
        super().__init__(iserver=services)
        self._trust = trust

    async def listen(self, listener: socket.socket) -> None:
        """Listen at a socket that is bound."""
        await self._setup_server_nodes()
        self._policies: list[Any] = [TrustingPolicy(each, self._trust) for each in self._policies]
        await self.iserver.start()
        self.bserver = PlantListener(self.iserver, listener, self.limits)
        self.bserver.set_policies(self._policies)
        await self.bserver.start()


def bound_socket(listen: Listen) -> socket.socket:
    """Return a socket that is bound, not listening; raise EnvironmentalError if refused."""
    family = socket.AF_INET6 if ":" in listen.host else socket.AF_INET
    made = socket.socket(family, socket.SOCK_STREAM)
    try:
        # Connections of the process before may still be in TIME_WAIT.
        made.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        made.bind((listen.host, listen.port))
    except OSError as exc:
        made.close()
        raise EnvironmentalError(f"{listen.url('opc.tcp')}: {exc.strerror}") from None
    return made


class PlantOpcUa:
    """OPC UA server of a plant (PlantService).

    Args:
        bridge: The plant.
        section: The key ``opcua``.
    """

    def __init__(self, bridge: Bridge, section: OpcUaSection) -> None:
        self.period_ms = section.period_ms
        self._bridge = bridge
        self._section = section
        self._logins = Logins(section.users)
        role = role_of_anonymous(section)
        self._anonymous = None if role is None else Principal("", role)
        self._listen = parse_listen(section.listen)
        self._feed = bridge.feed(
            section.variables,
            section.period_ms,
            on_variables=self._on_variables,
            on_values=self._on_values,
        )
        self._news = asyncio.Event()
        self._knows_variables = False
        self._has_changed = False
        self._samples: dict[str, Sample] = {}
        self._stations: dict[str, tuple[StationFacts, int | None]] = {}
        self._answers: bool | None = None
        self._first_plan = asyncio.Event()

    async def run(self) -> None:
        """Serve until cancelled; raise EnvironmentalError if that is not possible."""
        # asyncua logs each request, and its own standard nodes that it cannot enter.
        logging.getLogger("asyncua").setLevel(logging.CRITICAL)
        url = f"opc.tcp://{self._section.listen}/"
        folder = plant_folder(self._bridge.plant) / "opcua"
        trust = TrustStore(folder, trusts_all=self._section.clients is ClientTrust.ANY)
        own = self._certificate(folder)
        with bound_socket(self._listen) as listener:
            self._bridge.ready()
            self._bridge.away(url, "")
            await self._serve(await self._make_server(url, own, trust), listener)

    async def _serve(self, server: OpcUaServer, listener: socket.socket) -> None:
        try:
            async with asyncio.TaskGroup() as group:
                group.create_task(self._feed.run())
                group.create_task(self._follow_status())
                group.create_task(self._follow_plant())
                group.create_task(self._logins.report(self._note_logins))
                try:
                    async with asyncio.timeout(_FIRST_PLAN_S):
                        await self._first_plan.wait()
                except TimeoutError:
                    logger.info("the plant does not answer yet: its nodes follow")
                await server.listen(listener)
                self._bridge.connected(server.endpoint.geturl())
        finally:
            if server.bserver is not None:
                await server.stop()

    async def _note_logins(self, refused: list[LoginRefusals]) -> None:
        await self._bridge.call(NOTE_LOGINS, transport="opcua", refused=tuple(refused))

    def anonymous(self, host: str) -> Principal | None:
        """Return the user of clients without login, None if they have to log in."""
        del host
        return self._anonymous

    async def login(self, user: str, password: str, host: str) -> Principal | ua.StatusCode:
        """Return the user with this password, or the reason that it is refused."""
        found = await self._logins.verify(user, password, host)
        if isinstance(found, Principal):
            return found
        return ua.StatusCode(ua.StatusCodes.BadUserAccessDenied)

    def may_write(self, node_id: ua.NodeId, user: Principal) -> bool:
        """Return whether the role of a user allows to write a node."""
        node = self._space.find(node_id)
        if not isinstance(node, VariableNode) or not node.is_settable:
            return False
        if user.may_act_as(Role.ENGINEER):
            return True
        names = (node.variable, node.node_id)
        is_for_operators = any(match_names(each, names) for each in self._section.operators)
        return is_for_operators and user.may_act_as(Role.OPERATOR)

    async def write(self, value: ua.WriteValue, client: Client) -> ua.StatusCode:
        """Write the value of a node for a client."""
        node = self._space.find(value.NodeId)
        if refusal := self._refusal_of_write(node, value, client):
            return ua.StatusCode(refusal)
        assert isinstance(node, VariableNode)  # noqa: S101  the refusal has looked
        try:
            plain = taken_value(node, value.Value.Value, self._space.node_id)
        except TypeError:
            return ua.StatusCode(ua.StatusCodes.BadTypeMismatch)
        except ValueError:
            return ua.StatusCode(ua.StatusCodes.BadOutOfRange)
        try:
            await self._bridge.write(
                node.node_id,
                plain,
                transport="opcua",
                host=client.host,
                user=client.user.name,
                role=client.user.role_in_rules,
            )
        except EapError as exc:
            logger.info("%s by %s@%s: %s", node.node_id, client.user.name, client.host, exc)
            return ua.StatusCode(_code_of(exc))
        await self._space.take_part(node, plain)
        self._feed.report_again(node.node_id)
        return ua.StatusCode()

    async def call(
        self, request: ua.CallMethodRequest, client: Client
    ) -> ua.CallMethodResult | None:
        """Call a method of the plant; None if it is none of the plant's."""
        node = self._space.find(request.MethodId)
        if not isinstance(node, MethodNode):
            return None
        result = ua.CallMethodResult()
        result.StatusCode = ua.StatusCode(await self._call(node, request, client))
        return result

    def _refusal_of_write(
        self, node: object, value: ua.WriteValue, client: Client
    ) -> ua.StatusCodes | None:
        if node is None and self._space.is_own(value.NodeId):
            return ua.StatusCodes.BadNodeIdUnknown
        if value.AttributeId != ua.AttributeIds.Value or not isinstance(node, VariableNode):
            return ua.StatusCodes.BadUserAccessDenied
        if not node.is_settable:
            return ua.StatusCodes.BadNotWritable
        if not self.may_write(value.NodeId, client.user):
            return ua.StatusCodes.BadUserAccessDenied
        status = value.Value.StatusCode
        # The plant keeps neither parts of arrays that a client wrote nor a status of its values.
        if value.IndexRange or (status is not None and not status.is_good()):
            return ua.StatusCodes.BadWriteNotSupported
        return None

    async def _call(
        self, node: MethodNode, request: ua.CallMethodRequest, client: Client
    ) -> ua.StatusCodes:
        if request.ObjectId != self._space.node_id(node.parent):
            return ua.StatusCodes.BadMethodInvalid
        if not client.user.may_act_as(Role.ENGINEER):
            return ua.StatusCodes.BadUserAccessDenied
        given = request.InputArguments or []
        if len(given) != (node.argument is not None):
            return (
                ua.StatusCodes.BadTooManyArguments if given else ua.StatusCodes.BadArgumentsMissing
            )
        try:
            if node.argument is None:
                await self._rescan(node.parent, client)
            else:
                states = dict(STATES.names)
                if (state := given[0].Value) not in states:
                    return ua.StatusCodes.BadInvalidArgument
                await self._request_state(node.parent, states[state], client)
        except EapError as exc:
            logger.info("%s by %s@%s: %s", node.node_id, client.user.name, client.host, exc)
            return _code_of(exc)
        return ua.StatusCodes.Good

    async def _request_state(self, station: str, state: str, client: Client) -> None:
        origin = _origin_of(client)
        answer = await self._bridge.call(REQUEST_STATE, target=station, state=state, origin=origin)
        if answer.error is not None:
            raise ControlError(answer.error.text, code=ErrorCode.REFUSED)
        # A client that reads the state at once finds the one that it has requested.
        await self._take_status((await self._bridge.request("status"))["stations"])

    async def _rescan(self, bus: str, client: Client) -> None:
        origin = _origin_of(client)
        offset = SdoOffset(1, index=_DETECT_MODULES).encode()
        head = AdsRange(IndexGroup.SDO, int.from_bytes(offset, "little"), len(_SCAN))
        body = head.encode() + _SCAN
        answer = await self._bridge.call(
            AMS_ASK,
            target=bus,
            via=bus.partition("/")[0],
            command=AmsCommand.WRITE,
            data=body.hex(),
            origin=origin,
        )
        result = answer.error or int.from_bytes(bytes.fromhex(answer.data)[:4], "little")
        if result:
            raise ControlError(AdsError.words_of(result), code=ErrorCode.BUSY)

    def _certificate(self, folder: Path) -> OwnCertificate:
        section, plant = self._section, self._bridge.plant
        if section.certificate:
            return given_certificate(Path(section.certificate), Path(section.key), plant)
        # A listener on every address has no host name of its own for the certificate.
        hosts = [] if self._listen.is_any else [self._listen.host]
        return own_certificate(folder, plant, hosts)

    async def _make_server(self, url: str, own: OwnCertificate, trust: TrustStore) -> OpcUaServer:
        offered = channel_securities(self._section)
        services = PlantServer(
            self,
            offers_none=ChannelSecurity.NONE in offered,
            takes_clear_passwords=self._listen.is_loopback,
        )
        server = OpcUaServer(services, trust)
        # Collections take as long as making the 6,000 standard nodes, and would look through all of
        # them again and again.
        gc.disable()
        await server.init()
        gc.freeze()
        gc.enable()
        server.set_endpoint(url)
        server.set_server_name(f"EAP appliance {self._bridge.plant}")
        server.application_type = ua.ApplicationType.Server
        server.product_uri = "urn:eap-appliance"
        await server.set_application_uri(own.application_uri)
        server.set_security_policy([each for one in offered for each in _POLICIES[one]])
        tokens = [ua.UserNameIdentityToken] if self._section.users else []
        tokens += [ua.AnonymousIdentityToken] if self._anonymous is not None else []
        server.set_identity_tokens(tokens)
        services.certificate, services.private_key = own.certificate, own.key
        uri = f"urn:eap-appliance:plant:{self._bridge.plant}"
        namespace = await server.register_namespace(uri)
        self._server = server
        self._space = PlantAddressSpace(services, namespace, uri, self.period_ms)
        await self._describe_server(server)
        self._changes: EventGenerator = await server.get_event_generator(
            ua.ObjectIds.BaseModelChangeEventType
        )
        return server

    async def _describe_server(self, server: OpcUaServer) -> None:
        await server.set_build_info(
            server.product_uri, "EAP appliance", server.name, RELEASE, "", datetime.now(UTC)
        )
        ids = ua.ObjectIds
        for number, value, kind in (
            (ids.Server_ServiceLevel, _NO_DATA, ua.VariantType.Byte),
            (ids.Server_ServerRedundancy_RedundancySupport, 0, ua.VariantType.Int32),
            (ids.Server_ServerDiagnostics_EnabledFlag, False, ua.VariantType.Boolean),
            (ids.Server_Auditing, False, ua.VariantType.Boolean),
            (
                ids.Server_ServerCapabilities_MinSupportedSampleRate,
                float(self.period_ms),
                ua.VariantType.Double,
            ),
            (
                ids.Server_ServerCapabilities_MaxBrowseContinuationPoints,
                0,
                ua.VariantType.UInt16,
            ),
        ):
            await server.write_attribute_value(
                ua.NodeId(number), ua.DataValue(ua.Variant(value, kind))
            )

    def _on_variables(self) -> None:
        self._knows_variables = True
        self._on_change()

    def _on_change(self) -> None:
        self._has_changed = True
        self._news.set()

    def _on_values(self, samples: Any) -> None:
        # Of a variable that changes again before it is written, only the latest value counts.
        self._samples |= samples
        self._news.set()

    async def _follow_plant(self) -> None:
        """Keep nodes and values as the plant has them."""
        while True:
            await self._news.wait()
            self._news.clear()
            if self._has_changed and self._knows_variables and self._stations:
                self._has_changed = False
                await self._plan_again()
            samples, self._samples = self._samples, {}
            self._bridge.status.sent += await self._space.take(samples)

    async def _plan_again(self) -> None:
        facts = [each for each, _ in self._stations.values()]
        ranges = {name: (each.low, each.high) for name, each in self._section.ranges.items()}
        plan = plan_nodes(facts, self._feed.variables.values(), ranges)
        change = await self._space.follow(plan)
        for station, state in self._stations.values():
            await self._space.set_station(station.name, state, station.net_id)
        await self._space.take(self._feed.samples)
        is_new = not self._first_plan.is_set()
        self._first_plan.set()
        if not is_new and (change.added or change.removed or change.replaced):
            logger.info("nodes: %d added, %d removed", len(change.added), len(change.removed))
            await self._changes.trigger(message="the plant was configured anew")

    async def _follow_status(self) -> None:
        """Keep the states of the stations and the server's own status current."""
        while True:
            try:
                document = await self._bridge.request("status")
                await self._take_status(document["stations"])
                answers = True
            except EapError:
                answers = False
                for facts, _ in list(self._stations.values()):
                    await self._set_station(facts, None)
            await self._report(answers=answers)
            await asyncio.sleep(STATUS_S)

    async def _take_status(self, rows: Iterable[dict[str, Any]]) -> None:
        states = {name: number for number, name in STATES.names}
        found = {}
        for row in rows:
            buses = tuple(each["name"] for each in row["ports"] if each["kind"] == "bus")
            facts = StationFacts(row["name"], row["net_id"], buses)
            found[facts.name] = facts, states.get(row["state"])
        if [each for each, _ in found.values()] != [each for each, _ in self._stations.values()]:
            self._on_change()
        self._stations = found
        for facts, state in found.values():
            await self._set_station(facts, state)

    async def _set_station(self, facts: StationFacts, state: int | None) -> None:
        await self._space.set_station(facts.name, state, facts.net_id)

    async def _report(self, *, answers: bool) -> None:
        self._bridge.status.clients = len(self._server.iserver.sessions())
        self._bridge.status.dropped = self._server.iserver.dropped
        if answers is self._answers:
            return
        self._answers = answers
        level = ua.Variant(_HEALTHY if answers else _NO_DATA, ua.VariantType.Byte)
        state = ua.ServerState.Running if answers else ua.ServerState.CommunicationFault
        ids = ua.ObjectIds
        node = self._server.iserver.server_status_node
        status = copy(await node.read_value())
        status.State = state
        for number, variant in (
            (ids.Server_ServiceLevel, level),
            (ids.Server_ServerStatus, ua.Variant(status, ua.VariantType.ExtensionObject)),
            (ids.Server_ServerStatus_State, ua.Variant(state, ua.VariantType.Int32)),
        ):
            value = ua.DataValue(variant, SourceTimestamp=datetime.now(UTC))
            await self._server.write_attribute_value(ua.NodeId(number), value)


def _origin_of(client: Client) -> WriteOrigin:
    user = client.user
    return WriteOrigin(user.name, client.host, transport="opcua", role=user.role_in_rules)


def _code_of(error: EapError) -> ua.StatusCodes:
    code = error.code if isinstance(error, ControlError) else ErrorCode.BUS
    found: ua.StatusCodes = _CODES.get(ErrorCode(code), ua.StatusCodes.BadInternalError)
    return found
