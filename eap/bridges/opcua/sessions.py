"""Sessions of OPC UA clients: logins, rights, writes and methods.

asyncua would let a client read and write its address space alone.  Here writes and method calls go
to the plant; and what asyncua leaves open is closed: a channel without security where none is
offered, certificates that nobody checked, numbered session tokens, subscriptions of others, and
answers that a client does not read.
"""

from __future__ import annotations

import asyncio
import logging
import secrets
import socket
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from datetime import UTC, datetime
from typing import Any, NamedTuple, Protocol

from asyncua import ua
from asyncua.common.utils import ServiceError
from asyncua.crypto.permission_rules import User, UserRole
from asyncua.crypto.security_policies import SecurityPolicyFactory, SecurityPolicyNone
from asyncua.server.binary_server_asyncio import BinaryServer, OPCUAProtocol
from asyncua.server.internal_server import InternalServer
from asyncua.server.internal_session import InternalSession
from asyncua.server.uaprocessor import UaProcessor
from asyncua.ua.ua_binary import struct_from_binary, uatcp_to_binary

from eap.bridges.opcua.certificates import TrustStore, UntrustedError
from eap.runtime.logins import Principal
from eap.services.tasks import TaskSet

MAX_CONNECTIONS, MAX_OF_HOST = 256, 128
MAX_UNREAD = 8 << 20
"""Bytes of answers that wait for a client to read them."""
MAX_ITEMS = 10_000
"""Nodes of one request."""
_MAX_SUBSCRIPTIONS, _MAX_QUEUE, _MAX_UNACKNOWLEDGED = 512, 100, 20
_ENCRYPTIONS = {
    "http://www.w3.org/2001/04/xmlenc#rsa-oaep",
    "http://opcfoundation.org/UA/security/rsa-oaep-sha2-256",
}
"""Encryptions of passwords; RSA 1.5 is open to padding attacks."""
_CREATE = ua.NodeId(ua.ObjectIds.CreateSessionRequest_Encoding_DefaultBinary)
_ACTIVATE = ua.NodeId(ua.ObjectIds.ActivateSessionRequest_Encoding_DefaultBinary)

logger = logging.getLogger(__name__)


class Client(NamedTuple):
    """Client of a session: its user, and the address of its host."""

    user: Principal
    host: str


class PlantService(Protocol):
    """Plant behind the server, for sessions."""

    period_ms: int

    async def login(self, user: str, password: str, host: str) -> Principal | ua.StatusCode:
        """Return the user with this password, or the reason that it is refused."""

    def anonymous(self, host: str) -> Principal | None:
        """Return the user of clients without login, None if they have to log in."""

    def may_write(self, node_id: ua.NodeId, user: Principal) -> bool:
        """Return whether the role of a user allows to write a node."""

    async def write(self, value: ua.WriteValue, client: Client) -> ua.StatusCode:
        """Write the value of a node for a client."""

    async def call(
        self, request: ua.CallMethodRequest, client: Client
    ) -> ua.CallMethodResult | None:
        """Call a method of the plant; None if it is none of the plant's."""


def refused(code: int) -> ServiceError:
    """Return the exception that refuses a request with a status code."""
    return ServiceError(code)


class PlantSession(InternalSession):  # type: ignore[misc]
    """Session of one client."""

    iserver: PlantServer

    def __init__(self, *args: Any, **more: Any) -> None:
        super().__init__(*args, **more)
        self.client: Client | None = None
        self.certificate: bytes | None = None
        self.login: Principal | None = None

    @property
    def host(self) -> str:
        """Address of the client."""
        name = self.name
        return str(name[0]) if isinstance(name, tuple) else ""

    def activate_session(self, params: Any, peer_certificate: bytes | None) -> Any:
        """Give the session the user whose login :meth:`check_login` has accepted."""
        if self.external:
            if self.login is None:
                raise refused(ua.StatusCodes.BadIdentityTokenRejected)
            self.client = Client(self.login, self.host)
        return super().activate_session(params, peer_certificate)

    async def check_login(
        self, params: ua.ActivateSessionParameters, *, is_encrypted: bool
    ) -> None:
        """Find the user of a request to activate the session; raise ServiceError if refused."""
        self.login = None
        token = params.UserIdentityToken
        plant = self.iserver.plant
        if isinstance(token, ua.UserNameIdentityToken):
            algorithm = token.EncryptionAlgorithm
            if algorithm and algorithm not in _ENCRYPTIONS:
                raise refused(ua.StatusCodes.BadIdentityTokenInvalid)
            # A password in clear goes over no network.
            if not (algorithm or is_encrypted or self.iserver.takes_clear_passwords):
                raise refused(ua.StatusCodes.BadIdentityTokenRejected)
            try:
                user, password = self.iserver.decrypt_user_token(self, token)
            except Exception:  # noqa: BLE001  bytes of a client, decrypted
                raise refused(ua.StatusCodes.BadIdentityTokenInvalid) from None
            found = await plant.login(user or "", password or "", self.host)
            if isinstance(found, ua.StatusCode):
                raise refused(found.value)
            self.login = found
        elif isinstance(token, ua.X509IdentityToken):
            raise refused(ua.StatusCodes.BadIdentityTokenRejected)
        elif (anonymous := plant.anonymous(self.host)) is not None:
            self.login = anonymous
        else:
            raise refused(ua.StatusCodes.BadIdentityTokenRejected)

    async def read(self, params: ua.ReadParameters) -> list[ua.DataValue]:
        """Read attributes; UserAccessLevel is that of this session's user."""
        _check_count(params.NodesToRead)
        results: list[ua.DataValue] = await super().read(params)
        for position, (wanted, found) in enumerate(zip(params.NodesToRead, results, strict=True)):
            if wanted.IndexRange:
                code = ua.StatusCode(ua.StatusCodes.BadIndexRangeNoData)
                results[position] = ua.DataValue(ua.Variant(), code)
            elif (
                wanted.AttributeId == ua.AttributeIds.UserAccessLevel
                and self.client is not None
                and found.Value.Value
                and not self.iserver.plant.may_write(wanted.NodeId, self.client.user)
            ):
                level = ua.Variant(ua.AccessLevel.CurrentRead.mask, ua.VariantType.Byte)
                results[position] = replace(found, Value=level)
        return results

    async def write(self, params: ua.WriteParameters) -> list[ua.StatusCode]:
        """Write values to the plant."""
        if self.client is None:  # the server itself
            return list(await super().write(params))
        _check_count(params.NodesToWrite)
        return [await self.iserver.plant.write(each, self.client) for each in params.NodesToWrite]

    async def call(self, params: list[ua.CallMethodRequest]) -> list[ua.CallMethodResult]:
        """Call methods of the plant, or of the standard."""
        _check_count(params)
        results: list[ua.CallMethodResult] = []
        for each in params:
            client = self.client
            found = None if client is None else await self.iserver.plant.call(each, client)
            results += [found] if found is not None else await super().call([each])
        return results

    async def browse(self, params: ua.BrowseParameters) -> list[ua.BrowseResult]:
        """Browse nodes; one that is gone is unknown, and not invalid."""
        _check_count(params.NodesToBrowse)
        results = await super().browse(params)
        for result in results:
            if result.StatusCode.value == ua.StatusCodes.BadNodeIdInvalid:
                result.StatusCode = ua.StatusCode(ua.StatusCodes.BadNodeIdUnknown)
        return list(results)

    async def translate_browsepaths_to_nodeids(self, params: Any) -> Any:
        """Find nodes by their browse names."""
        _check_count(params)
        if any(not each.RelativePath.Elements for each in params):
            raise refused(ua.StatusCodes.BadNothingToDo)
        return await super().translate_browsepaths_to_nodeids(params)

    async def create_subscription(self, params: Any, *args: Any, **more: Any) -> Any:
        """Begin a subscription, which publishes no faster than values come."""
        shortest_ms = float(self.iserver.plant.period_ms)
        wanted_ms = params.RequestedPublishingInterval
        # NaN is neither larger nor smaller.
        params.RequestedPublishingInterval = max(shortest_ms, wanted_ms)
        return await super().create_subscription(params, *args, **more)

    async def create_monitored_items(self, params: Any) -> Any:
        """Monitor nodes by a subscription of this session."""
        _check_count(params.ItemsToCreate)
        self._check_own(params.SubscriptionId)
        return await super().create_monitored_items(params)

    async def modify_monitored_items(self, params: Any) -> Any:
        """Change monitored items of this session."""
        self._check_own(params.SubscriptionId)
        return await super().modify_monitored_items(params)

    async def delete_monitored_items(self, params: Any) -> Any:
        """Delete monitored items of this session."""
        self._check_own(params.SubscriptionId)
        return await super().delete_monitored_items(params)

    async def set_monitoring_mode(self, params: Any) -> Any:
        """Change the mode of monitored items of this session."""
        self._check_own(params.SubscriptionId)
        return await super().set_monitoring_mode(params)

    async def set_publishing_mode(self, params: Any) -> Any:
        """Enable or disable subscriptions of this session."""
        for number in params.SubscriptionIds:
            self._check_own(number)
        return await super().set_publishing_mode(params)

    def modify_subscription(self, params: Any) -> Any:
        """Change a subscription of this session."""
        self._check_own(params.SubscriptionId)
        return super().modify_subscription(params)

    def republish(self, params: Any) -> Any:
        """Send a notification of this session again."""
        self._check_own(params.SubscriptionId)
        return super().republish(params)

    async def delete_subscriptions(self, ids: list[int]) -> Any:
        """Delete subscriptions of this session."""
        for number in ids:
            self._check_own(number)
        return await super().delete_subscriptions(ids)

    async def transfer_subscriptions(self, params: Any, *args: Any, **more: Any) -> Any:
        """Take over subscriptions that a session of the same user has left."""
        for number in params.SubscriptionIds:
            owner = self._owner_of(number)
            if owner is not None and (owner.client, owner.certificate) != (
                self.client,
                self.certificate,
            ):
                raise refused(ua.StatusCodes.BadUserAccessDenied)
        return await super().transfer_subscriptions(params, *args, **more)

    def _owner_of(self, number: int) -> PlantSession | None:
        found = self.subscription_service.subscriptions.get(number)
        if found is None:
            return None
        sessions = self.iserver.sessions()
        return next((each for each in sessions if each.session_id == found.session_id), None)

    def _check_own(self, number: int) -> None:
        found = self.subscription_service.subscriptions.get(number)
        # The numbers of subscriptions are those of the server: a client may guess those of others.
        if self.external and found is not None and found.session_id != self.session_id:
            raise refused(ua.StatusCodes.BadSubscriptionIdInvalid)


class PlantServer(InternalServer):  # type: ignore[misc]
    """Services of the server, with the plant behind them.

    Args:
        plant: The plant.
        offers_none: True if clients may use channels without security.
        takes_clear_passwords: True if a password may come unencrypted: on this host alone.

    Attributes:
        dropped: Connections that were ended because the client did not read.
    """

    def __init__(
        self, plant: PlantService, *, offers_none: bool, takes_clear_passwords: bool
    ) -> None:
        super().__init__()
        self.plant = plant
        self.offers_none = offers_none
        self.takes_clear_passwords = takes_clear_passwords
        self.dropped = 0
        self.user_manager = _SessionUsers()
        self.allow_remote_admin = False
        self.supported_tokens = (ua.AnonymousIdentityToken, ua.UserNameIdentityToken)
        self.max_connections = MAX_CONNECTIONS
        self.max_subscriptions = _MAX_SUBSCRIPTIONS
        self.max_monitored_item_queue_size = _MAX_QUEUE
        self.max_unacked_messages_per_subscription = _MAX_UNACKNOWLEDGED
        self.max_session_timeout_ms = 120_000
        self.max_pending_activation_seconds = 30.0

    def create_session(self, name: Any, user: Any = None, external: bool = False) -> PlantSession:
        """Return a new session, whose token cannot be guessed."""
        session = PlantSession(
            self, self.aspace, self.subscription_service, name, user=User(), external=False
        )
        session.external = external
        session.auth_token = ua.NodeId(secrets.token_bytes(32), 0, ua.NodeIdType.ByteString)
        if external:
            self.register_external_session(session)
        return session

    def sessions(self) -> list[PlantSession]:
        """Return the sessions of clients."""
        return list(self._external_sessions.values())

    def register_server(self, server: Any, conf: Any = None) -> None:
        """Refuse to be a discovery server for others."""
        raise refused(ua.StatusCodes.BadServiceUnsupported)


class _SessionUsers:
    """Users as asyncua knows them: none of them is an administrator of the address space."""

    def get_user(self, *_: Any, **__: Any) -> User:
        return User(role=UserRole.User)


class PlantProcessor(UaProcessor):  # type: ignore[misc]
    """Messages of one connection."""

    async def process(self, header: Any, body: Any) -> bool:
        """Answer a message; return False to close the connection."""
        try:
            return bool(await super().process(header, body))
        except UntrustedError as exc:
            logger.warning("client %s refused: %s", self.name[0], exc)
            reason = "the certificate is not trusted: the log of the server has more"
            return self._abort(ua.StatusCodes.BadSecurityChecksFailed, reason)
        except Exception as exc:  # noqa: BLE001  bytes of a client: asyncua raises anything
            logger.info("client %s: %s: %s", self.name[0], type(exc).__name__, exc)
            return self._abort(ua.StatusCodes.BadSecurityChecksFailed, "message refused")

    async def _process_message(self, typeid: Any, requesthdr: Any, seqhdr: Any, body: Any) -> Any:
        policy = self._connection.security_policy
        is_open = policy.URI == SecurityPolicyNone.URI
        # On a channel without security clients may always find out which others there are.
        if typeid in {_CREATE, _ACTIVATE} and is_open and not self.iserver.offers_none:
            raise refused(ua.StatusCodes.BadSecurityPolicyRejected)
        if typeid == _ACTIVATE:
            session = self.session or self._left_session(requesthdr.AuthenticationToken)
            params = struct_from_binary(ua.ActivateSessionParameters, body.copy())
            is_encrypted = policy.Mode == ua.MessageSecurityMode.SignAndEncrypt
            await session.check_login(params, is_encrypted=is_encrypted)
        answer = await super()._process_message(typeid, requesthdr, seqhdr, body)
        if typeid == _CREATE:
            self.session.certificate = policy.peer_certificate
        return answer

    def send_response(self, *args: Any, **more: Any) -> None:
        """Send an answer, or end the connection of a client that reads none."""
        super().send_response(*args, **more)
        if self._transport.get_write_buffer_size() > MAX_UNREAD:
            self.iserver.dropped += 1
            logger.warning("client %s reads no answers: its connection is closed", self.name[0])
            self._transport.abort()

    def _left_session(self, token: Any) -> PlantSession:
        """Return the session that a client left when its connection broke off."""
        found = self.iserver.lookup_external_session(token)
        certificate = self._connection.security_policy.peer_certificate
        if found is None or found.certificate != certificate or found.host != self.name[0]:
            raise refused(ua.StatusCodes.BadSessionIdInvalid)
        session: PlantSession = found
        return session

    def _abort(self, code: int, reason: str) -> bool:
        message = ua.ErrorMessage(ua.StatusCode(code), reason)
        self._transport.write(uatcp_to_binary(ua.MessageType.Error, message))
        return False


class PlantProtocol(OPCUAProtocol):  # type: ignore[misc]
    """Connection of one client."""

    def connection_made(self, transport: Any) -> None:
        """Serve a connection, unless its host has too many already."""
        host = transport.get_extra_info("peername")[0]
        hosts = Counter(each.peer_name[0] for each in self.clients)
        if hosts[host] >= MAX_OF_HOST:
            self.peer_name = transport.get_extra_info("peername")
            logger.warning("client %s refused: it has %d connections", host, hosts[host])
            transport.close()
            return
        super().connection_made(transport)
        if self.processor is not None:
            self.processor: Any = PlantProcessor(self.iserver, transport, self.limits)
            self.processor.set_policies(self.policies)


class PlantListener(BinaryServer):  # type: ignore[misc]
    """Listening socket of the server.

    Args:
        services: The server.
        listener: The socket, which is bound.
        limits: Limits of messages.
    """

    def __init__(self, services: PlantServer, listener: socket.socket, limits: Any) -> None:
        host, port = listener.getsockname()[:2]
        super().__init__(services, host, port, limits)
        self._listener = listener
        self._tasks = TaskSet("OPC UA listener")

    async def start(self) -> None:
        """Listen."""
        loop = asyncio.get_running_loop()
        self._server = await loop.create_server(self._make_protocol, sock=self._listener)
        self.cleanup_task = self._tasks.start(self._close_task_loop())

    def _make_protocol(self) -> PlantProtocol:
        return PlantProtocol(
            iserver=self.iserver,
            policies=self._policies,
            clients=self.clients,
            closing_tasks=self.closing_tasks,
            limits=self.limits,
        )


class TrustingPolicy(SecurityPolicyFactory):  # type: ignore[misc]
    """Security policy that checks the client's certificate before it opens a channel.

    Args:
        policy: One of asyncua's, which it replaces.
        trust: The trusted certificates.
    """

    def __init__(self, policy: SecurityPolicyFactory, trust: TrustStore) -> None:
        super().__init__(
            policy.cls,
            policy.mode,
            policy.certificate,
            policy.private_key,
            policy.permission_ruleset,
        )
        self._trust = trust

    def create(self, peer_certificate: bytes | None) -> Any:
        """Return the policy for a client; raise UntrustedError if it is not trusted."""
        if self.cls is not SecurityPolicyNone:
            self._trust.check(peer_certificate or b"", datetime.now(UTC))
        return super().create(peer_certificate)


def _check_count(items: Sequence[Any]) -> None:
    if not items:
        raise refused(ua.StatusCodes.BadNothingToDo)
    if len(items) > MAX_ITEMS:
        raise refused(ua.StatusCodes.BadTooManyOperations)
