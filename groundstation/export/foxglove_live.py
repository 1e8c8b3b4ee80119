"""SHELL: a run on the WebSocket that Foxglove-family viewers speak, by their own SDK, for the eyes only: no viewer can send.

Bytes go through as they are on the wire. The SDK keeps a queue for each viewer and drops the oldest when one is slow; nobody
else waits for it.
"""

import importlib
import threading
import time
from types import TracebackType
from typing import Any

from mcap_protobuf.schema import build_file_descriptor_set

from groundstation.export.foxglove_scene import DRAWN, FRAMES, MOVING, SCHEMAS, STANDING, SceneDrawer, upright
from shoal.bus.bus import Bus
from shoal.config.experiment import Experiment
from shoal.errors import ConfigError
from shoal.messages import topics
from shoal.messages.codec import DecodeError, Header, decode, protobuf_class
from shoal.messages.topics import Topic
from shoal.runtime.runtime import Clock, log

SCENE_S = 0.1
STANDING_S = 2.0  # a viewer that comes later waits no longer for the pool
SHOWN = (*DRAWN, topics.PREVIEW, topics.VIDEO, topics.PICTURE, topics.POSE, topics.LOCALIZER, topics.HEARTBEAT, topics.EVENT)


class ViewerServer:
    """Listens to the bus, serves viewers, draws the scene. Closed by `with`."""

    def __init__(self, experiment: Experiment, bus: Bus, clock: Clock, host: str, port: int) -> None:
        """Raises ConfigError if the SDK is not installed or the port is taken."""
        try:
            self._sdk: Any = importlib.import_module("foxglove")
        except ModuleNotFoundError:
            raise ConfigError("--foxglove: not installed here (pip install 'shoal[foxglove]')") from None
        self._clock, self._context = clock, self._sdk.Context()
        self._channels: dict[str, Any] = {}
        self._newest: dict[tuple[Topic, int], tuple[int, bytes]] = {}  # what is drawn: the newest of each
        self._picture, self._turn = SceneDrawer(experiment), threading.Lock()
        self._closing = threading.Event()
        try:
            self._server = self._sdk.start_server(name=f"shoal {experiment.name}", host=host, port=port, context=self._context)
        except (RuntimeError, OSError) as error:
            raise ConfigError(f"--foxglove {host}:{port}: {error}") from None
        self.port: int = self._server.port
        of_cameras = (topic.of_camera("*") for topic in SHOWN if topic in topics.OF_CAMERAS)
        for topic in (*SHOWN, *(of_cameras if experiment.cameras else ())):
            bus.subscribe(topic, None, self._keep_newest)
        self._standing_s = 0.0  # when what stands still was drawn last, monotonic
        self._drawer = threading.Thread(target=self._draw_until_closed, name="viewer", daemon=True)
        self._drawer.start()

    def _keep_newest(self, topic: Topic, key: str, header: Header, payload: bytes) -> None:
        """Keep the newest bytes of a topic. Called by a network thread, so nothing is decoded here."""
        now_ns = max(self._clock.arrival_ns(header.stamp_ns), 0)
        self._channel(key, protobuf_class(topic.type)).log(payload, log_time=now_ns)
        if topic in DRAWN:
            robot = int(key.split("/")[-2]) if "{robot}" in topic.name else 0
            with self._turn:
                self._fleet = key.removesuffix(topic.key(robot or None))
                self._newest[topic, robot] = now_ns, payload

    def _channel(self, key: str, cls: Any) -> Any:
        """The channel of a key, made at its first message."""
        with self._turn:
            if key not in self._channels:
                files = build_file_descriptor_set(cls).SerializeToString()
                schema = self._sdk.Schema(name=cls.DESCRIPTOR.full_name, encoding="protobuf", data=files)
                options = {"schema": schema, "message_encoding": "protobuf", "context": self._context}
                self._channels[key] = self._sdk.Channel(key, **options)
            return self._channels[key]

    def _draw_until_closed(self) -> None:
        """Draw again and again. An error costs one picture: the run does not depend on viewers."""
        reasons: set[str] = set()
        while not self._closing.wait(SCENE_S):
            try:
                self._draw()
            except Exception as error:  # whatever it is: the next picture may be whole again
                reason = f"{type(error).__name__}: {error}"
                if reason not in reasons:
                    reasons.add(reason)
                    log.error("the scene for viewers could not be drawn: %s", reason)

    def _draw(self) -> None:
        """Draw what has come since the last call: moving things now, standing ones every STANDING_S or when they change."""
        with self._turn:
            newest, self._newest = self._newest, {}
        for (topic, robot), (at_ns, payload) in newest.items():
            try:
                self._picture.take(topic, robot, decode(topic.type, payload, "bus", topic.name), at_ns)
            except DecodeError:
                continue
        if not newest:
            return
        now_ns = max(at_ns for at_ns, _ in newest.values())
        self._log(MOVING, self._picture.moving(now_ns), now_ns)
        if self._picture.replanned or time.monotonic() - self._standing_s >= STANDING_S:
            self._standing_s = time.monotonic()
            self._log(STANDING, self._picture.standing(now_ns), now_ns)
            self._log(FRAMES, upright(now_ns), now_ns)

    def _log(self, name: str, message: Any, now_ns: int) -> None:
        self._channel(f"{self._fleet}{name}", SCHEMAS[name]).log(message.SerializeToString(), log_time=now_ns)

    def close(self) -> None:
        """Let the viewers go."""
        self._closing.set()
        self._drawer.join(1.0)
        self._server.stop()

    def __enter__(self) -> "ViewerServer":
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.close()
