"""SHELL: the film of the camera in a run's log (recording.video = "h264") as a video file, for what reads video files."""

import importlib
from collections.abc import Iterator, Sequence
from fractions import Fraction
from itertools import islice
from pathlib import Path
from typing import IO, Any

from shoal.errors import ConfigError, os_errors_as_config_errors
from shoal.messages import topics
from shoal.messages.codec import DecodeError, decode
from shoal.messages.messages import Video
from shoal.runtime import mcap_records
from shoal.system.regular_files import open_regular

CLOCK_HZ = 90_000  # of a film's stamps
WHOLE_PICTURE = b"\x00\x00\x01\x65"  # H.264: start code and head of a picture that needs no other (IDR)


def film_of_log(log: Path, camera: str, out: Path) -> tuple[int, str]:
    """Write the packets of the log's film, as they are, to `out` (.mkv): from the first whole picture to where the stamps go
    back, or the log was cut. Returns the stamp of the first in ns, and a sentence about pictures that are left out, or "".
    Raises ConfigError for a log without film."""
    try:
        av: Any = importlib.import_module("av")
    except ModuleNotFoundError:
        raise ConfigError(f"{log}: reading its film is not installed here (pip install 'shoal[video]')") from None
    name, damage = topics.VIDEO.of_camera(camera).name, list[str]()
    try:
        with os_errors_as_config_errors(log), open_regular(log) as file:
            pictures = [(stamp_ns, _begins(packed)) for stamp_ns, packed in _packets(log, file, name, damage)]
        kept = _playable(pictures)
        stamps_ns = [stamp_ns for stamp_ns, _ in pictures[kept]]
        if len(stamps_ns) < 2:
            if damage:
                raise ConfigError(damage[0])
            raise ConfigError(f'{log}: holds no film of the camera (recording.video = "h264" keeps one)')
        # The mean rate: where the recorder left pictures out, a reader must not count on any other.
        rate_hz = Fraction(10**9 * (len(stamps_ns) - 1), stamps_ns[-1] - stamps_ns[0]).limit_denominator(10_000)
        with os_errors_as_config_errors(log), open_regular(log) as file, av.open(str(out), "w") as film:
            stream: Any = None
            for stamp_ns, packed in islice(_packets(log, file, name, []), kept.start, kept.stop):
                stream = _add_stream(av, film, packed, rate_hz) if stream is None else stream
                packet = av.Packet(packed)
                packet.stream, packet.time_base = stream, Fraction(1, CLOCK_HZ)
                packet.pts = packet.dts = (stamp_ns - stamps_ns[0]) * CLOCK_HZ // 10**9
                packet.is_keyframe = _begins(packed)
                film.mux(packet)
    except DecodeError as error:
        raise ConfigError(f"{log}: {error}") from None
    except av.error.FFmpegError as error:
        raise ConfigError(f"{log}: its film cannot be read: {error}") from None
    why = "what comes before the first whole one, and after the camera's clock was set back"
    left_out = len(pictures) - len(stamps_ns)
    sentences = [f"{log}: {left_out} of {len(pictures)} pictures are left out: {why}"] if left_out else []
    return stamps_ns[0], "; ".join([*sentences, *damage])


def _packets(log: Path, file: IO[bytes], name: str, damage: list[str]) -> Iterator[tuple[int, bytes]]:
    """Stamp and packet of each picture of the log, up to where it was cut or is damaged, which `damage` takes."""
    try:
        for topic, stamp_ns, data in mcap_records.messages(file):
            if topic.endswith(f"/{name}"):
                yield stamp_ns, decode(Video, data, str(log), name).h264
    except mcap_records.Damaged as error:
        damage.append(f"{log}: was cut, and the film ends there: {error}")


def _playable(pictures: Sequence[tuple[int, bool]]) -> slice:
    """The pictures, given by stamp and whether one needs no other, from the first whole one to where their stamps no longer
    rise: no video file has a time twice."""
    first = next((k for k, (_, begins) in enumerate(pictures) if begins), len(pictures))
    end = first + 1
    while end < len(pictures) and pictures[end][0] > pictures[end - 1][0]:
        end += 1
    return slice(first, end)


def _add_stream(av: Any, film: Any, packed: bytes, rate_hz: Fraction) -> Any:
    """Add an H.264 stream to the film. Its size is that of the first picture, its decoder's parameters are the bytes before
    that picture in the first packet `packed`."""
    decoder = av.CodecContext.create("h264", "r")
    pictures = [*decoder.decode(av.Packet(packed)), *decoder.decode(None)]
    if not pictures:
        raise av.error.InvalidDataError(0, "its first picture is damaged")
    stream = film.add_stream("libx264", rate=rate_hz)
    stream.width, stream.height = pictures[0].width, pictures[0].height
    stream.pix_fmt = "yuv420p"
    stream.codec_context.extradata = packed[: packed.index(WHOLE_PICTURE)]
    return stream


def _begins(packed: bytes) -> bool:
    """True for a picture that needs no other one."""
    return WHOLE_PICTURE in packed
