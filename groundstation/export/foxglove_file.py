"""SHELL: a log for 3-D viewers: all that is in it, bytes unchanged, with the scene that they draw added."""

import json
from pathlib import Path
from typing import Any

from mcap.records import Channel
from mcap.writer import Writer
from mcap_protobuf.schema import build_file_descriptor_set

from groundstation.export.foxglove_layout import layout
from groundstation.export.foxglove_scene import DRAWN, FRAMES, MOVING, SCHEMAS, STANDING, SceneDrawer, upright
from groundstation.logs.reader import Channels, LogMessage, open_log, valid_records
from groundstation.logs.recorder import CHUNK_BYTES
from groundstation.logs.repair import RecordCopier
from shoal.config.experiment import load_experiment
from shoal.messages.codec import DecodeError, decode
from shoal.messages.topics import Topic
from shoal.runtime.output_files import RUN, check_output, replacing_together

LAYOUT_NAME = "foxglove-layout.json"
COPY_ENDING = "-viewer.mcap"  # never run.mcap: an export is no run
SCENE_NS = 100_000_000  # a new scene this often: smooth to the eye
STANDING_NS = 5_000_000_000  # and what stands, for viewers that jump into the middle


def export(run: Path, folder: Path) -> list[Path]:
    """Write the log of a run with the scene in it, and a layout that shows it. Returns the files. Raises ConfigError for what
    is no run, and for a folder where one of the files would be written over the run's own."""
    experiment = load_experiment(str(run / "experiment.toml"))
    copy, described = folder / f"{run.resolve().name}{COPY_ENDING}", folder / LAYOUT_NAME
    for path in (copy, described):
        check_output(path, [run / name for name in RUN])
    with open_log(run) as log:
        folder.mkdir(parents=True, exist_ok=True)
        with replacing_together() as opened:
            drawer = _Copy(Writer(opened(copy), chunk_size=CHUNK_BYTES), SceneDrawer(experiment))
            scene = layout(experiment, drawer.run(log.path).removesuffix("/"))
            opened(described).write((json.dumps(scene, indent=1) + "\n").encode())
    return [copy, described]


class _Copy:
    """Copy of a log with the scene added, in one pass."""

    def __init__(self, writer: Any, picture: SceneDrawer) -> None:
        self._writer, self._picture = writer, picture
        self._viewer: dict[str, int] = {}
        self._fleet = ""
        self._next_ns, self._next_standing_ns, self._scenes = 0, 0, 0

    def run(self, path: Path) -> str:
        """Copy a log. Returns what its keys begin with."""
        self._writer.start(library="shoal")
        copier, channels = RecordCopier(self._writer), Channels()
        for record in valid_records(path):
            copier.copy(record)
            line = channels.take(record)
            if isinstance(record, Channel) and record.id in channels and not self._viewer:
                self._register_scene(record.topic, *channels[record.id][:2])
            elif line is not None:
                self._add_to_scene(line)
        self._writer.finish()
        return self._fleet

    def _register_scene(self, key: str, topic: Topic, robot: int) -> None:
        """Register the scene's channels in the copy, beside a recorded channel's `key`: they begin with the same fleet."""
        self._fleet = key.removesuffix(topic.key(robot or None))
        for name, cls in SCHEMAS.items():
            files = build_file_descriptor_set(cls).SerializeToString()
            schema = self._writer.register_schema(cls.DESCRIPTOR.full_name, "protobuf", files)
            self._viewer[name] = self._writer.register_channel(f"{self._fleet}{name}", "protobuf", schema)

    def _add_to_scene(self, line: LogMessage) -> None:
        """Take a message into the scene; before that, draw the scene if it is due: it shows what came before its instant."""
        if line.arrived_ns >= self._next_ns:
            self._draw(line.arrived_ns)
        if line.topic in DRAWN:
            try:
                message: Any = decode(line.topic.type, line.payload, "log", line.topic.name)
            except DecodeError:
                return
            self._picture.take(line.topic, line.robot, message, line.arrived_ns)

    def _draw(self, now_ns: int) -> None:
        """Write the moving part of the scene, and now and then what stands still."""
        self._next_ns = now_ns + SCENE_NS
        drawn: list[tuple[str, Any]] = [(MOVING, self._picture.moving(now_ns))]
        if self._picture.replanned or now_ns >= self._next_standing_ns:
            self._next_standing_ns = now_ns + STANDING_NS
            drawn += [(STANDING, self._picture.standing(now_ns)), (FRAMES, upright(now_ns))]
        for name, message in drawn:
            self._writer.add_message(self._viewer[name], now_ns, message.SerializeToString(), now_ns, self._scenes)
        self._scenes += 1
