"""A connection to a broker, made anew whenever it is lost."""

from __future__ import annotations

import contextlib
import logging
import random
import socket
import ssl
import threading
import time
from collections import deque
from collections.abc import Callable
from typing import Any, Optional
from urllib.parse import urlsplit

from paho.mqtt import client as mqtt
from paho.mqtt.enums import CallbackAPIVersion
from paho.mqtt.packettypes import PacketTypes
from paho.mqtt.properties import Properties

from .codec import MAX_BYTES
from .errors import Invalid, Refused, Unreachable

log = logging.getLogger("ecod")

# As the default of nodes, in seconds: silence after which the broker is pinged.
KEEP_ALIVE_S = 5

# Wait in seconds before the first new attempt, doubled with every failure, and the longest.
RETRY_MIN_S, RETRY_MAX_S = 0.1, 5.0

# Time in seconds to send what waits when the connection is closed.
FLUSH_S = 1.0

# Messages that wait for the network at most; more are dropped, as late ones are worthless.
MAX_WAITING = 16

# Reason codes of MQTT 5 by which a broker refuses a login that it will refuse again: malformed, protocol, version,
# client id, password, authorisation, banned, method.
FINAL = frozenset({0x81, 0x82, 0x84, 0x85, 0x86, 0x87, 0x8A, 0x8C})

# Reason code of MQTT 5 by which a broker states that a message has no receiver.
NO_SUBSCRIBERS = 0x10

# Remedy for a program without TLS.
WITH_CERTIFICATES = " A cell with certificates has port 8883, and takes `ca`, `cert` and `key`"


class Connection:
    """An MQTT 5 client with a thread of its own, which gives messages to `take`."""

    def __init__(
        self,
        address: tuple[str, int],
        client_id: str,
        tls: Optional[ssl.SSLContext],
        login: tuple[Optional[str], Optional[str]],
        take: Callable[[str, bytes], None],
        timeout: float,
    ) -> None:
        host, port = address
        self.at = f"{host}:{port}"
        self.changed = threading.Condition()
        """Notified with every message, connection and refusal, and when the connection is closed."""
        self.is_connected, self._connected_at = False, 0.0
        self.closing = threading.Event()
        self._answer: Optional[Any] = None
        self._refusal: Optional[Refused] = None
        self._filters: set[str] = set()
        self._waiting: deque[mqtt.MQTTMessageInfo] = deque()
        # Topics and filters that were requested from the broker on this connection, by message id, and its refusals.
        self._asked: dict[int, str] = {}
        self._denied: dict[int, str] = {}
        self._client = client = mqtt.Client(CallbackAPIVersion.VERSION2, client_id, protocol=mqtt.MQTTv5)
        client.on_connect = self._on_connect
        client.on_disconnect = lambda _client, _userdata, _flags, reason, _properties: self._lose(reason)
        client.on_message = lambda _client, _userdata, message: take(message.topic, bytes(message.payload))
        client.on_subscribe = lambda _client, _userdata, mid, reasons, properties: self._on_answer(mid, reasons[0], properties)
        client.on_publish = lambda _client, _userdata, mid, reason, properties: self._on_answer(mid, reason, properties)
        client.on_socket_open = _without_delay
        client.on_socket_close = lambda _client, _userdata, sock: self._drain(sock)
        # The thread of `_run` alone writes to the socket; otherwise every caller would.
        client.on_socket_register_write = lambda *_: None
        if tls is not None:
            client.tls_set_context(tls)
        if login[0]:
            client.username_pw_set(*login)
        self._log_in(host, port, tls, timeout)
        self._thread = threading.Thread(target=self._run, name=client_id, daemon=True)
        self._thread.start()

    def subscribe(self, topic_filter: str) -> None:
        """Asks for messages, on this connection and all that follow."""
        self._filters.add(topic_filter)
        if topic_filter not in list(self._asked.values()):
            _, mid = self._client.subscribe(topic_filter, qos=1)
            if mid is not None:
                self._asked[mid] = topic_filter

    def publish(self, topic: str, payload: bytes) -> bool:
        """Sends a message if that is possible at once; gives whether it is."""
        while self._waiting and _is_done(self._waiting[0]):
            self._waiting.popleft()
        if not self.is_connected or len(self._waiting) >= MAX_WAITING:
            return False
        # The first message requests an answer, because only an answer shows that the broker does not allow the topic.
        is_question = topic not in list(self._asked.values())
        info = self._client.publish(topic, payload, qos=1 if is_question else 0)
        if is_question:
            self._asked[info.mid] = topic
        else:
            self._waiting.append(info)
        return info.rc == mqtt.MQTT_ERR_SUCCESS

    def raise_if_refused(self, topic: str) -> None:
        """Raises what the broker refused: the login, or this topic or filter, each refusal of it once."""
        if self._refusal is not None:
            raise self._refusal
        for mid in [mid for mid, asked in list(self._asked.items()) if asked == topic and mid in self._denied]:
            self._asked.pop(mid, None)
            reason = self._denied.pop(mid, None)
            raise Refused(f"the broker at {self.at} refuses {topic}: {reason}")

    def close(self) -> None:
        """Sends what waits, and ends the connection."""
        self.closing.set()
        self._client.disconnect()
        with self.changed:
            self.changed.notify_all()
        if threading.current_thread() is not self._thread:
            self._thread.join(timeout=2 * FLUSH_S)

    def _log_in(self, host: str, port: int, tls: Optional[ssl.SSLContext], timeout: float) -> None:
        at = f"{self.at} (argument `broker` or ECOD_BROKER)"
        properties = Properties(PacketTypes.CONNECT)  # type: ignore[no-untyped-call]
        properties.MaximumPacketSize = MAX_BYTES + 4096
        deadline = time.monotonic() + timeout
        self._client.connect_timeout = timeout
        try:
            self._client.connect(host, port, KEEP_ALIVE_S, clean_start=True, properties=properties)
            while self._answer is None and time.monotonic() < deadline:
                if self._client.loop(0.1) != mqtt.MQTT_ERR_SUCCESS:
                    break
        except ssl.SSLError as error:
            raise Unreachable(f"no TLS with {at}: {error}; check `ca`, `cert`, `key`, `broker_name`") from error
        except OSError as error:
            remedy = f"is a node or a broker running there?{'' if tls else WITH_CERTIFICATES}"
            raise Unreachable(f"cannot connect to {at}: {error}; {remedy}") from error
        except Exception as error:  # of many kinds, for bytes that are no MQTT
            raise Unreachable(f"{at} does not speak MQTT 5: {error!r}") from error
        if self._answer is None or self._answer.is_failure:
            self._client.disconnect()
            self._client.loop(0.0)
            if self._answer is not None:
                raise self._refusal or Refused(f"{at} refuses the login: {self._answer}; try again later")
            if tls is None:
                check = f"without TLS?{WITH_CERTIFICATES}"
            elif getattr(tls, "has_certificate", True):
                check = "and take the certificate in `cert`?"
            else:
                check = "and take programs without a certificate? `cert` and `key` are not given"
            raise Unreachable(f"{at} does not answer the login; does it speak MQTT 5, {check}")

    def _run(self) -> None:
        """Carries messages until the connection is closed, and connects anew after every loss."""
        wait = RETRY_MIN_S
        while not self.closing.is_set():
            if self._carry():
                # If the broker admits the program only to end the connection, the retry interval is not shortened.
                if self.is_connected and time.monotonic() - self._connected_at > RETRY_MAX_S:
                    wait = RETRY_MIN_S
            elif not self.closing.wait(wait * random.uniform(0.5, 1.0)):
                wait = min(2 * wait, RETRY_MAX_S)
                try:
                    self._client.reconnect()
                except (OSError, ValueError) as error:
                    log.debug("cannot connect to %s: %s", self.at, error)
        deadline = time.monotonic() + FLUSH_S
        while self._carry(0.1) and time.monotonic() < deadline:
            pass

    def _carry(self, seconds: float = 1.0) -> bool:
        """Sends and receives; gives whether the connection holds."""
        try:
            result: Any = self._client.loop(seconds)
        except Exception as error:  # of many kinds, for bytes that are no MQTT
            result = repr(error)
        if result == mqtt.MQTT_ERR_SUCCESS:
            return True
        self._lose(result)
        return False

    def _drain(self, sock: Any) -> None:
        """Reads what still comes, at the end. Otherwise the system resets the connection, and the broker loses what it has not read."""
        deadline = time.monotonic() + FLUSH_S
        if self.closing.is_set():
            with contextlib.suppress(OSError):
                sock.shutdown(socket.SHUT_WR)
                sock.settimeout(FLUSH_S)
                while sock.recv(65536) and time.monotonic() < deadline:
                    pass

    def _lose(self, reason: Any) -> None:
        if self.is_connected and not self.closing.is_set():
            log.warning("connection to %s lost: %s; trying again, reports are dropped until then", self.at, reason)
        self.is_connected = False

    def _on_connect(self, _client: mqtt.Client, _userdata: Any, _flags: Any, reason: Any, _properties: Any) -> None:
        self._answer = reason
        if reason.is_failure:
            if reason.value in FINAL:
                check = "check node name (argument `node` or ECOD_NAME), certificate, user and password"
                self._refusal = Refused(f"{self.at} refuses the login: {reason}; {check}")
            log.warning("%s refuses the login: %s", self.at, reason)
        else:
            log.info("connected to %s", self.at)
            self._refusal, self._asked, self._denied = None, {}, {}
            self._waiting.clear()
            self.is_connected, self._connected_at = True, time.monotonic()
            for topic_filter in list(self._filters):
                self.subscribe(topic_filter)
        with self.changed:
            self.changed.notify_all()

    def _on_answer(self, mid: int, reason: Any, properties: Any) -> None:
        is_unheard = reason.value == NO_SUBSCRIBERS and "/boxes/" in self._asked.get(mid, "")
        if reason.is_failure or is_unheard:
            text = getattr(properties, "ReasonString", None) or f"{reason}; does the certificate or user allow it?"
            if is_unheard:
                text = "it is no broker of a node, and only nodes place boxes: connect to a node of the cell"
            log.warning("%s refuses %s: %s", self.at, self._asked.get(mid, "a request"), text)
            self._denied[mid] = text
            with self.changed:
                self.changed.notify_all()


def _is_done(info: mqtt.MQTTMessageInfo) -> bool:
    try:
        return info.is_published()
    except (RuntimeError, ValueError):  # lost with its connection
        return True


def _without_delay(_client: mqtt.Client, _userdata: Any, sock: Any) -> None:
    # Otherwise small messages wait for acknowledgements.
    sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)


def host_and_port(address: str, default_port: int) -> tuple[str, int]:
    """The parts of HOST:PORT; the port may be absent."""
    try:
        parts = urlsplit(f"//{address}")
        if parts.hostname and "@" not in parts.netloc and not parts.path and parts.port != 0:
            return parts.hostname, parts.port or default_port
    except ValueError:
        pass
    _, at, host = address.rpartition("@")
    if at:
        raise Invalid(f"broker '***@{host}' must be HOST:PORT; a login is `user` and `password`")
    raise Invalid(f"broker {address.partition('?')[0]!r} must be HOST:PORT")


class _CellContext(ssl.SSLContext):
    """TLS with a broker that is known by a name and not by its address."""

    broker_name: str
    has_certificate: bool

    def wrap_socket(self, *args: Any, **named: Any) -> ssl.SSLSocket:
        return super().wrap_socket(*args, **{**named, "server_hostname": self.broker_name})


def tls_context(ca: str, cert: Optional[str], key: Optional[str], broker_name: str) -> ssl.SSLContext:
    """TLS by PEM files, with a broker of this name."""
    context = _CellContext(ssl.PROTOCOL_TLS_CLIENT)
    context.broker_name, context.has_certificate = broker_name, bool(cert)
    try:
        context.load_verify_locations(ca)
        if cert:
            context.load_cert_chain(cert, key)
    except OSError as error:
        raise Invalid(f"cannot use ca {ca!r}, cert {cert!r}, key {key!r}: {error}") from error
    return context
