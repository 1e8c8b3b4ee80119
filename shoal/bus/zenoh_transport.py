"""SHELL: the real transport: Zenoh sessions of a client, or of the fleet's router behind its gate.

Every setting is explicit, so that a network without multicast and a Zenoh with other defaults behave the same. Each was
measured; the reason stands beside it.
"""

import contextlib
import json
import logging
import os
import threading
import time
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, Protocol

import zenoh
import zenoh.ext

from shoal.bus.access_control import DOOR, listed
from shoal.bus.connection_diagnostics import trouble_listening, trouble_reaching
from shoal.bus.endpoint import MOST_SESSIONS, Endpoint, client_of, settings
from shoal.bus.transport import Answer, Await, Collect, Deliver, Presence, Urgent
from shoal.errors import ConfigError, Unreached
from shoal.messages.topics import RECOVERED, Qos
from shoal.system.open_files import FILES_APART, allow_files

log = logging.getLogger("shoal")

UNCOLLECTED = 8192  # messages of a subscription that wait to be collected: 20 s of the busiest topic of 20 robots
UNCOLLECTED_IMAGES = 256  # 12 s, in some 30 MB
TRY_AGAIN_S = 0.2
DRAWS = 3  # of free ports behind the gate
SAY_AGAIN_S = 10.0  # how often a process says that it still waits
MOST_LINKS_OF_ONE = 64  # connections of one certificate: a robot has two, a viewer's may be used by many people
NO_ANSWER = "something listens there, but does not answer as a station without keys (one that has them wants --keys FOLDER)"

# Zenoh's own log, on stdout, of a router with keys, with --verbose: who came in, why a handshake failed, and what access
# control is applied. Without, only what RUST_LOG asks for: our own log has what a person needs, in one format.
DETAILS = "warn,zenoh_link_tls::unicast=debug,zenoh::net::routing::interceptor::access_control=info"

# Zenoh hands every message on from thread to thread, of which it has six. What is received, and links, can do with one: an
# agent that hears 19 plans then takes 8 to 15 % less of the processor. Sending keeps its own, so that a full queue empties
# while a receiver waits for it.
ONE_RECEIVER = "(rx: (handover: app), net: (handover: app), acc: (handover: app))"


def receive_on_one_thread() -> None:
    """Let Zenoh receive on one thread. Only for a process that has opened no session yet, that does not route (a router of
    this kind accepts no peer for minutes) and that starts no others, which would inherit it. The user's own ZENOH_RUNTIME
    wins."""
    os.environ.setdefault("ZENOH_RUNTIME", ONE_RECEIVER)


_QOS: dict[Qos, dict[str, Any]] = {
    Qos.CONTROL: {"priority": zenoh.Priority.REAL_TIME, "express": True},
    Qos.STATE: {"priority": zenoh.Priority.DATA_HIGH, "express": True},
    Qos.IMAGE: {"priority": zenoh.Priority.DATA_LOW, "express": False},
    Qos.JOURNAL: {"priority": zenoh.Priority.DATA, "express": False},
    Qos.EVENT: {"priority": zenoh.Priority.DATA, "express": False},
}


def _config(endpoint: Endpoint) -> zenoh.Config:
    config = zenoh.Config()
    for key, value in settings(endpoint).items():
        config.insert_json5(key, json.dumps(value))
    return config


def _open(endpoint: Endpoint, stopped: Callable[[], bool], patience_s: float) -> zenoh.Session:
    """A session. A client tries until the station is there: a robot may be switched on before it. Raises Unreached when
    `stopped()`, or with the reason when the patience is over; ConfigError where a router cannot listen.

    In attempts, because Zenoh's own endless wait hears neither Ctrl-C nor SIGTERM."""
    config = _config(endpoint)
    if endpoint.router:
        try:
            return zenoh.open(config)
        except zenoh.ZError as error:
            raise ConfigError(f"cannot listen at {endpoint.address}: {trouble_listening(endpoint.address) or error}") from None
    began_s, say_s = time.monotonic(), 0.0
    while True:
        try:
            return zenoh.open(config)
        except zenoh.ZError as error:
            at_door = endpoint.address.startswith(DOOR)
            reason = "" if at_door else trouble_reaching(endpoint.address, endpoint.keys)
            reason = reason or (str(error) if at_door or endpoint.keys else NO_ANSWER)
        now_s = time.monotonic()
        if stopped():
            raise Unreached(f"stopped while waiting for the station at {endpoint.address}: {reason}")
        if now_s - began_s > patience_s:
            raise Unreached(f"no station at {endpoint.address}: {reason}")
        if now_s >= say_s:
            say_s = now_s + SAY_AGAIN_S
            log.info("waiting for the station at %s: %s", endpoint.address, reason)
        time.sleep(TRY_AGAIN_S)


class RouterGate(Protocol):
    """The ways into a router with keys (groundstation/gate/gate.py): made before the router, opened after it."""

    endpoint: Endpoint  # where the router listens

    @property
    def inside(self) -> Endpoint:
        """The endpoint for another session of the station's own process."""

    def draw(self) -> None:
        """Choose other free ports for the router to listen at."""

    def open(self) -> None:
        """Let connections in."""

    def expel(self, port: int) -> None:
        """End the connection that reaches the router from this loopback port."""

    def close(self) -> None:
        """Let nobody in any more, and give the public port back."""


def _open_gate(endpoint: Endpoint, make_gate: Callable[[Endpoint], RouterGate]) -> tuple[zenoh.Session, RouterGate]:
    """A router with keys behind its gate. Raises ConfigError where it cannot listen."""
    os.environ.setdefault("NO_COLOR", "1")  # it ends in files and journals
    if log.isEnabledFor(logging.DEBUG):
        zenoh.init_log_from_env_or(DETAILS)
    else:
        zenoh.try_init_log_from_env()
    try:
        gate = make_gate(endpoint)
    except OSError as error:
        raise ConfigError(f"cannot listen at {endpoint.address}: {error.strerror or error}") from None
    try:
        session = _open_router(gate)
        if endpoint.access is not None:
            _expel_unlisted(session, gate, frozenset(listed(endpoint.access)))
        gate.open()
    except BaseException:
        gate.close()
        raise
    return session, gate


class _Members:
    """The router's connections by the name in their certificate. Pure: time is an argument, in s."""

    def __init__(self, listed: frozenset[str]) -> None:
        self._listed = listed
        self._links: dict[str, set[int]] = {}  # ports, by name
        self._said_s: dict[str, float] = {}

    def objection(self, name: str, port: int) -> str:
        """Note a new connection. Returns the reason why it is not wanted, or nothing."""
        if name not in self._listed:
            return f"{name} is not on the list of members (revoked?): its connections are closed"
        links = self._links.setdefault(name, set())
        if len(links) >= MOST_LINKS_OF_ONE:
            return f"{name} has {MOST_LINKS_OF_ONE} connections: more of them are closed"
        links.add(port)
        return ""

    def gone(self, name: str, port: int) -> None:
        """Note the end of a connection."""
        self._links.get(name, set()).discard(port)

    def to_be_told(self, name: str, now_s: float) -> bool:
        """True once in SAY_AGAIN_S for a name."""
        if now_s - self._said_s.get(name, float("-inf")) < SAY_AGAIN_S:
            return False
        self._said_s[name] = now_s
        return True


def _expel_unlisted(session: zenoh.Session, gate: RouterGate, listed: frozenset[str]) -> None:
    """Close connections whose certificate is revoked, or whose name has too many already: TLS lets them in, and one such
    certificate could fill the router. In a thread of its own, because a warning goes out as an event, for which a thread of
    Zenoh would wait on itself."""
    link_events = session.info.declare_link_events_listener(zenoh.handlers.FifoChannel(UNCOLLECTED))

    def follow() -> None:
        """Judge each new connection, and close those to which there is an objection."""
        members = _Members(listed)
        with contextlib.suppress(zenoh.ZError):  # the session is closed
            for event in link_events:
                name = event.link.auth_identifier
                where = str(event.link.dst).partition("#")[0].rpartition(":")[2]
                if name is None or not where.isdecimal():  # the door
                    continue
                port = int(where)
                if event.kind != zenoh.SampleKind.PUT:
                    members.gone(name, port)
                elif objection := members.objection(name, port):
                    gate.expel(port)
                    if members.to_be_told(name, time.monotonic()):
                        log.warning("%s", objection)

    threading.Thread(target=follow, name="unlisted", daemon=True).start()


def _open_router(gate: RouterGate) -> zenoh.Session:
    """The router at its loopback ports: at others where a program took one of them meanwhile."""
    for left in reversed(range(DRAWS)):
        try:
            return zenoh.open(_config(gate.endpoint))
        except zenoh.ZError as error:
            if not left:
                raise ConfigError(f"cannot listen behind {gate.endpoint.address}: {error}") from None
            gate.draw()
    raise AssertionError


def _parts(sample: zenoh.Sample) -> tuple[str, bytes, bytes]:
    """Key, payload, header."""
    header = sample.attachment.to_bytes() if sample.attachment is not None else b""
    return str(sample.key_expr), sample.payload.to_bytes(), header


class ZenohTransport:
    """Two sessions: one for control, and one for pictures, opened when first needed, so that they never share a queue.

    Opening waits for the station until `stopped()`, at most `patience_s`; then it raises Unreached. A router with keys is
    opened behind the gate that `gate` makes for its endpoint."""

    def __init__(
        self,
        endpoint: Endpoint,
        stopped: Callable[[], bool] = lambda: False,
        patience_s: float = float("inf"),
        gate: Callable[[Endpoint], RouterGate] | None = None,
    ) -> None:
        self._endpoint, self._stopped = endpoint, stopped
        self._gate: RouterGate | None = None
        if endpoint.router:
            allow_files(MOST_SESSIONS + FILES_APART)
        if endpoint.router and endpoint.keys is not None:
            if gate is None:
                raise ValueError("a router with keys needs a gate")
            self._control, self._gate = _open_gate(endpoint, gate)
        else:
            self._control = _open(endpoint, stopped, patience_s)
        self._images: zenoh.Session | None = None
        self._opening = threading.Lock()  # around the pictures' session: previews and film begin in threads of their own
        self._kept: list[Any] = []  # Zenoh undeclares an object that is not referenced
        self._workers: list[ThreadPoolExecutor] = []

    def _session(self, qos: Qos) -> zenoh.Session:
        """The session for a quality of service: pictures have their own, which is opened when it is needed."""
        if qos is not Qos.IMAGE:
            return self._control
        with self._opening:
            if self._images is None:
                where = self._gate.inside if self._gate is not None else client_of(self._endpoint)
                self._images = _open(where, self._stopped, float("inf"))
            return self._images

    @property
    def _congestion(self) -> zenoh.CongestionControl:
        return zenoh.CongestionControl.BLOCK if self._endpoint.lossless else zenoh.CongestionControl.DROP

    def publisher(self, key: str, qos: Qos, cache_depth: int = 0) -> Callable[[bytes, bytes], None]:
        """The function that publishes on a key. With a cache, later subscribers get the last messages."""
        options = {"congestion_control": self._congestion, **_QOS[qos]}
        session = self._session(qos)
        publisher: Any
        if cache_depth:
            publisher = zenoh.ext.declare_advanced_publisher(
                session,
                key,
                cache=zenoh.ext.CacheConfig(max_samples=cache_depth),
                sample_miss_detection=zenoh.ext.MissDetectionConfig(heartbeat=0.5, sporadic_heartbeat=None),
                publisher_detection=True,
                **options,
            )
        else:
            publisher = session.declare_publisher(key, **options)
        self._kept.append(publisher)
        return lambda payload, header: publisher.put(payload, attachment=header)

    def subscribe(self, key: str, qos: Qos, deliver: Deliver) -> None:
        self._declare(key, qos, lambda sample: deliver(*_parts(sample)))

    def collect(self, key: str, qos: Qos) -> Collect:
        """Collect messages that can wait, at half the cost of a callback for each. Uncollected ones never hold up the session:
        the oldest go."""
        channel = zenoh.handlers.FifoChannel if self._endpoint.lossless else zenoh.handlers.RingChannel
        subscriber = self._declare(key, qos, channel(UNCOLLECTED_IMAGES if qos is Qos.IMAGE else UNCOLLECTED))

        def collected() -> Iterable[tuple[str, bytes, bytes]]:
            while (sample := subscriber.try_recv()) is not None:
                yield _parts(sample)

        return collected

    def _declare(self, key: str, qos: Qos, handler: Any) -> Any:
        """A subscriber with a callback, or a channel of Zenoh's, for its samples."""
        session = self._session(qos)
        subscriber: Any
        if qos in RECOVERED:
            subscriber = zenoh.ext.declare_advanced_subscriber(
                session,
                key,
                handler,
                history=zenoh.ext.HistoryConfig(detect_late_publishers=True) if qos is Qos.EVENT else None,
                recovery=zenoh.ext.RecoveryConfig(periodic_queries=None, heartbeat=True),
                subscriber_detection=True,
            )
        else:
            subscriber = session.declare_subscriber(key, handler)
        self._kept.append(subscriber)
        return subscriber

    def serve(self, key: str, answer: Answer, urgent: Urgent) -> None:
        """Queries are answered one after the other, in a thread of their own; an urgent one at once, in Zenoh's."""
        worker = ThreadPoolExecutor(1, "serve")
        self._workers.append(worker)

        def reply(query: zenoh.Query, payload: bytes) -> None:
            header = query.attachment.to_bytes() if query.attachment is not None else b""
            with query:
                query.reply(query.key_expr, answer(payload, header))

        def on_query(query: zenoh.Query) -> None:
            payload = query.payload.to_bytes() if query.payload is not None else b""
            if urgent(payload):
                reply(query, payload)
            else:
                with contextlib.suppress(RuntimeError):  # closed
                    worker.submit(reply, query, payload)

        self._kept.append(self._control.declare_queryable(key, on_query))

    def ask(self, key: str, payload: bytes, header: bytes, timeout_s: float) -> Await:
        """Send a query, first in every queue. The returned function waits for the reply; None if none came in time."""
        replies = self._control.get(
            key,
            payload=payload,
            attachment=header,
            timeout=timeout_s,
            priority=zenoh.Priority.REAL_TIME,
            congestion_control=self._congestion,
            express=True,
        )

        def answer() -> bytes | None:
            for reply in replies:
                if reply.ok is not None:
                    return reply.ok.payload.to_bytes()
            return None

        return answer

    def announce(self, key: str) -> None:
        self._kept.append(self._control.liveliness().declare_token(key))

    def watch(self, key: str, presence: Presence, anew: bool = False) -> None:
        """A token that is undeclared in the same millisecond in which a session begins to watch stays in that session's
        memory, as declared (1 of 100 times in Zenoh 1.10). `anew`: watch by the other session."""
        session = self._session(Qos.IMAGE) if anew else self._control

        def on_sample(sample: zenoh.Sample) -> None:
            presence(str(sample.key_expr), sample.kind == zenoh.SampleKind.PUT)

        self._kept.append(session.liveliness().declare_subscriber(key, on_sample, history=True))

    def close(self) -> None:
        """Undeclare and close. Without this a process that dies of an exception never exits."""
        self._kept.clear()
        for worker in self._workers:
            worker.shutdown(wait=False, cancel_futures=True)
        if self._images is not None:
            self._images.close()
        self._control.close()
        if self._gate is not None:
            self._gate.close()
