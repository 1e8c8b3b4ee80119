"""SHELL: the camera's pictures of a run as an MP4, with what the robots did drawn over them, for slides and papers.

    write_film(run, Path("pool.mp4"))

Circles are the robots' own estimates, crosses their references, lines where they have been. Time 0 is the report's.
"""

import importlib
from collections import Counter, deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from groundstation.logs.reader import LogFile, open_log, read_log
from groundstation.palette import colour as colour_of
from shoal.config.experiment import Experiment, load_experiment
from shoal.config.perception import Camera
from shoal.errors import ConfigError
from shoal.frames import Array
from shoal.messages import topics
from shoal.messages.camera_coverage import project
from shoal.messages.codec import DecodeError, decode
from shoal.messages.messages import Estimate, Mode, Picture, Preview, RobotState, StationHeartbeat, Video
from shoal.messages.session_clocks import SessionClocks
from shoal.runtime.output_files import replacing

CLOCK_HZ = 90_000  # of the film's stamps
CLOCKS = (topics.STATE, topics.HEARTBEAT, topics.LOCALIZER)  # topics that say how old they were when they were sent
TRAIL = 600  # states of a robot's trail: half a minute
RING = np.array([[np.cos(a), np.sin(a)] for a in np.linspace(0.0, 2.0 * np.pi, 33)])
CROSS_M = 0.06  # half of the cross at a reference
FLIES = (Mode.TRACKING, Mode.HOLDING, Mode.DRIVEN)


def write_film(
    run: Path, out: Path, camera: str = "", report: Callable[[int, int], None] = lambda written, of: None
) -> tuple[int, int]:
    """Write the film of one camera; returns the number of its pictures, and of those of the log that cannot be decoded.
    `report` is told of each picture how many are written, and of how many. Raises ConfigError where the log holds none."""
    try:
        av: Any = importlib.import_module("av")
    except ModuleNotFoundError:
        raise ConfigError("--video: not installed here (pip install 'shoal[video]')") from None
    experiment = load_experiment(str(run / "experiment.toml"))
    names = experiment.camera_names or ("",)
    camera = camera or names[0]
    if camera not in names:
        raise ConfigError(f"--camera {camera}: no such camera (allowed: {', '.join(names)})")
    if out.suffix != ".mp4":
        raise ConfigError(f"--video {out}: must end in .mp4")
    clocks = read_log(run / "run.mcap", CLOCKS, lambda message: None).clocks
    overlay, stamps_ns = Overlay(experiment, experiment.of_camera(camera).camera), list[int]()
    written, begin_ns, pts = 0, 0, -1
    with open_log(run) as log, replacing(out) as file, av.open(file, "w", format="mp4") as film:
        stream: Any = None
        chosen, total = _best_film(log, camera)
        for stamp_ns, picture in _pictures(log, clocks, overlay, av, camera, chosen, stamps_ns):
            if stream is None:
                stream = film.add_stream("libx264", rate=20)
                stream.width, stream.height, stream.pix_fmt = picture.width & ~1, picture.height & ~1, "yuv420p"
                stream.codec_context.time_base, begin_ns = Fraction(1, CLOCK_HZ), stamp_ns
            drawn = overlay.draw(picture.crop((0, 0, stream.width, stream.height)), stamp_ns)
            frame = av.VideoFrame.from_image(drawn)
            pts = max((stamp_ns - begin_ns) * CLOCK_HZ // 10**9, pts + 1)  # the encoder would sort what goes back
            frame.pts, frame.time_base = pts, Fraction(1, CLOCK_HZ)
            film.mux(stream.encode(frame))
            written += 1
            report(written, max(written, total))
        if stream is None:
            raise ConfigError(
                f"{run}: the log holds no pictures of the camera (recording.video or recording.preview keep them)"
            )
        film.mux(stream.encode())
    return written, len(stamps_ns) - written


def _best_film(log: LogFile, camera: str) -> tuple[str, int]:
    """Name of the topic with the best pictures of a camera that the log holds, and how many; "" and 0 without any."""
    films = [topic.of_camera(camera).name for topic in (topics.VIDEO, topics.PICTURE, topics.PREVIEW)]
    held = Counter(line.topic.name for line in log.messages(lambda topic, _: topic.name in films))
    return next(((name, held[name]) for name in films if name in held), ("", 0))


def _pictures(
    log: LogFile, clocks: SessionClocks, overlay: "Overlay", av: Any, camera: str, chosen: str, stamps_ns: list[int]
) -> Iterator[tuple[int, Image.Image]]:
    """Stamp on the recorder's clock and picture of a film in the log; what robots and station say on the way
    goes to the overlay. `stamps_ns` takes the stamps of all pictures, also of those that cannot be decoded."""
    codec = av.CodecContext.create("h264" if chosen == topics.VIDEO.of_camera(camera).name else "mjpeg", "r")
    wanted = {chosen, topics.STATE.name, topics.HEARTBEAT.name}
    for line in log.messages(lambda topic, _: topic.name in wanted):
        try:
            message: Any = decode(line.topic.type, line.payload, "log", line.topic.name)
        except DecodeError:
            continue
        header = line.header
        shift_ns = clocks.shift_ns(line.topic.name, header.session, header.stamp_ns)
        if line.topic.name != chosen:
            overlay.hear(line.robot, message, shift_ns)
            continue
        packet = av.Packet(_bytes(message))
        packet.pts = len(stamps_ns)
        stamps_ns.append(header.stamp_ns + shift_ns)
        yield from _decoded(av, codec, packet, stamps_ns)
    yield from _decoded(av, codec, None, stamps_ns)


def _decoded(av: Any, codec: Any, packet: Any, stamps_ns: Sequence[int]) -> Iterator[tuple[int, Image.Image]]:
    """The pictures that come out of the decoder for a packet whose number is its `pts`; None: those that wait in it. A
    damaged picture, or one of which the log lacks what it is the change from, gives none."""
    with suppress(av.error.FFmpegError):
        for frame in codec.decode(packet):
            yield stamps_ns[-1 if frame.pts is None else frame.pts], frame.to_image()


def _bytes(message: Video | Picture | Preview) -> bytes:
    return message.h264 if isinstance(message, Video) else message.jpeg


class Overlay:
    """Drawing over a picture: estimates, references, trails and the time."""

    def __init__(self, experiment: Experiment, camera: Camera) -> None:
        self._experiment, self._camera = experiment, camera
        self._states: dict[int, tuple[RobotState, Estimate]] = {}
        self._trails: dict[int, deque[Array]] = {robot: deque(maxlen=TRAIL) for robot in experiment.robot_ids}
        self._began_ns, self._mission = 0, ""

    def hear(self, robot: int, message: RobotState | StationHeartbeat, shift_ns: int) -> None:
        """Take in a message of a robot or the station, whose clock is behind the pictures' by `shift_ns`."""
        if isinstance(message, StationHeartbeat):
            self._began_ns = message.began_ns + shift_ns if message.began_ns else self._began_ns
            self._mission = message.mission
        elif robot in self._trails and message.estimate is not None:
            self._states[robot] = message, message.estimate
            self._trails[robot].append(message.estimate.eta[:3])

    def draw(self, picture: Image.Image, stamp_ns: int) -> Image.Image:
        """The picture with the robots' estimates, references and trails, and the time."""
        pen = ImageDraw.Draw(picture)
        font = ImageFont.load_default(max(14, picture.height // 40))
        scale = np.array(picture.size) / np.array(self._camera.size_px)

        def line(points_m: Array, colour: str, width: int) -> None:
            places = project(self._camera, points_m) * scale
            if np.isfinite(places).all():
                pen.line([(float(x), float(y)) for x, y in places], fill=colour, width=width)

        def write(at: tuple[float, float], text: str, colour: str) -> None:
            pen.text(at, text, fill=colour, font=font, stroke_width=2, stroke_fill="black")

        radius_m = self._experiment.vehicle.radius_m
        for index, robot in enumerate(sorted(self._states)):
            state, estimate = self._states[robot]
            colour = colour_of(index)
            x, y, z, yaw = estimate.eta
            if len(self._trails[robot]) > 1:
                line(np.array(self._trails[robot]), colour, 2)
            hull = np.column_stack([np.array([x, y]) + radius_m * RING, np.full(len(RING), z)])
            line(hull, colour, 3)
            nose = np.array([[x, y, z], [x + 1.5 * radius_m * np.cos(yaw), y + 1.5 * radius_m * np.sin(yaw), z]])
            line(nose, colour, 3)
            if state.mode in FLIES and state.control is not None:  # a cross at its reference
                reference = state.control.eta_reference[:3]
                for arm in (np.array([CROSS_M, 0.0, 0.0]), np.array([0.0, CROSS_M, 0.0])):
                    line(np.array([reference - arm, reference + arm]), "white", 2)
            (name_at,) = project(self._camera, np.array([[x + 1.3 * radius_m, y, z]])) * scale
            if np.isfinite(name_at).all():
                write((float(name_at[0]), float(name_at[1])), str(robot), colour)
        since = f"{(stamp_ns - self._began_ns) * 1e-9:7.2f} s" if self._began_ns else "before the start"
        text = f"{since}   {self._mission.lower().replace('_', ' ')}"
        write((10.0, 8.0), text, "white")
        return picture
