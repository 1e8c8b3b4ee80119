"""The camera's film: what viewers can decode picture by picture, and nothing that the poses wait for."""

import io
import re
import threading
from typing import Any

import av
import cv2
import numpy as np
import pytest

from localizer.detection.image_regions import BAYER_TO_BGR, Pixels
from localizer.sources.base import CapturedFrame
from localizer.view.video_encoder import VideoEncoder, packer
from shoal.bus.bus import Bus
from shoal.bus.memory_transport import MemoryHub, MemoryTransport
from shoal.config.experiment import Experiment, load_experiment
from shoal.messages import topics
from shoal.messages.codec import Header, decode
from shoal.messages.messages import Picture, Video
from shoal.messages.topics import Topic
from shoal.runtime.runtime import Stop
from sim_bridge.camera.renderer import Renderer

pytestmark = pytest.mark.long

SECOND = 1_000_000_000
START = b"\0\0\1"  # of each unit of H.264
KEY, PARAMETERS = 5, 7  # kinds of units


@pytest.fixture(scope="module")
def pictures() -> list[Pixels]:
    """Twelve simulated ones, a robot moving."""
    experiment = load_experiment("pool")
    renderer = Renderer(experiment, 1)
    still = np.zeros((2, 4))
    poses = [np.array([[0.3 + 0.01 * k, 0.4, 0.3, 0.1 * k], [-0.4, -0.3, 0.3, 0.0]]) for k in range(12)]
    return [renderer.render(eta, still, 0.05 * k, k) for k, eta in enumerate(poses)]


def experiment(video: str, **more: object) -> Experiment:
    settings = [f'recording.video="{video}"', *(f"recording.{key}={value}" for key, value in more.items())]
    return load_experiment("pool", settings)


def coloured(pixels: Pixels) -> Any:
    return cv2.cvtColor(pixels, BAYER_TO_BGR)


def likeness_db(one: Any, other: Any) -> float:
    """Peak signal to noise."""
    apart = np.mean((one.astype(np.float64) - other.astype(np.float64)) ** 2)
    return float(10.0 * np.log10(255.0**2 / apart))


def units(data: bytes) -> list[int]:
    """Kinds of the units in H.264's Annex B form."""
    return [part[0] & 0x1F for part in data.split(START)[1:]]


def test_a_film_can_be_decoded_picture_by_picture(pictures: list[Pixels]) -> None:
    """Each message decodes to its own picture at once, as foxglove.CompressedVideo asks; none waits for one behind it."""
    made = experiment("h264")
    pack = packer(made.recording, made.camera.size_px)
    decoder: Any = av.CodecContext.create("h264", "r")
    decoder.flags |= 1 << 19  # low delay: what can be shown is shown
    for k, pixels in enumerate(pictures):
        data = pack(pixels, 5 * SECOND + k * SECOND // 20)
        assert data.startswith((b"\0" + START, START))
        (frame,) = decoder.decode(av.Packet(data))
        assert likeness_db(frame.to_ndarray(format="bgr24"), coloured(pixels)) > 27.0


def test_viewer_that_joins_a_film_waits_a_second_at_most(pictures: list[Pixels]) -> None:
    made = experiment("h264", video_scale=0.25)
    pack = packer(made.recording, made.camera.size_px)
    kinds_by_picture = [units(pack(pictures[k % 12], k * SECOND // 20)) for k in range(45)]
    assert [k for k, kinds in enumerate(kinds_by_picture) if KEY in kinds] == [0, 20, 40]
    assert [k for k, kinds in enumerate(kinds_by_picture) if PARAMETERS in kinds] == [0, 20, 40]


def test_a_film_keeps_to_its_rate_of_bits(pictures: list[Pixels]) -> None:
    made = experiment("h264", video_mbps=1.0)
    pack = packer(made.recording, made.camera.size_px)
    sizes = [len(pack(pictures[k % 12], k * SECOND // 20)) for k in range(60)]
    assert sum(sizes) * 8 / 3.0 < 1.6e6


def test_stills_are_plain_jpegs_of_the_size_asked_for(pictures: list[Pixels]) -> None:
    made = experiment("jpeg", video_scale=0.5)
    data = packer(made.recording, made.camera.size_px)(pictures[0], 0)
    shown: Any = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
    width, height = made.camera.size_px
    assert shown.shape == (height // 2, width // 2, 3)
    small = cv2.resize(coloured(pictures[0]), (width // 2, height // 2), interpolation=cv2.INTER_AREA)
    assert likeness_db(shown, small) > 30.0
    container: Any = av.open(io.BytesIO(data))  # another decoder
    (frame,) = container.decode(video=0)
    assert (frame.width, frame.height) == (width // 2, height // 2)


def captured(pixels: Pixels, k: int) -> CapturedFrame:
    stamp_ns = SECOND + k * SECOND // 20
    return CapturedFrame(pixels, stamp_ns, stamp_ns, stamp_ns)


@pytest.mark.parametrize(("video", "topic", "kind"), [("h264", topics.VIDEO, Video), ("jpeg", topics.PICTURE, Picture)])
def test_film_goes_out_on_its_topic_with_the_pictures_stamp(
    pictures: list[Pixels], video: str, topic: Topic, kind: type
) -> None:
    hub, enough = MemoryHub(), threading.Event()
    stamps_ns: list[int] = []

    def hear(topic: Topic, key: str, header: Header, payload: bytes) -> None:
        decode(kind, payload, "test", topic.name)
        stamps_ns.append(header.stamp_ns)
        enough.set()

    Bus(MemoryTransport(hub)).subscribe(topic, None, hear)
    maker = VideoEncoder(experiment(video, video_rate_hz=10), Bus(MemoryTransport(hub)), Stop(install=False))
    for k, pixels in enumerate(pictures[:6]):
        enough.clear()
        maker.offer(captured(pixels, k))
        if k % 2 == 0:
            assert enough.wait(10.0)
    maker.close()
    assert stamps_ns == [SECOND, SECOND + SECOND // 10, SECOND + SECOND // 5]  # every other one: 10 of 20 a second


def test_offering_never_waits_and_the_newest_counts(
    pictures: list[Pixels], monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    packed: list[int] = []
    busy, go_on, again = threading.Event(), threading.Event(), threading.Event()

    def slow(pixels: Pixels, stamp_ns: int) -> bytes:
        packed.append(stamp_ns)
        (again if busy.is_set() else busy).set()
        go_on.wait(10.0)
        return b""

    monkeypatch.setattr("localizer.view.video_encoder.packer", lambda recording, size_px: slow)
    maker = VideoEncoder(experiment("jpeg"), Bus(MemoryTransport(MemoryHub())), Stop(install=False))
    maker.offer(captured(pictures[0], 0))
    assert busy.wait(10.0)
    for k in range(1, 12):
        maker.offer(captured(pictures[k], k))  # would block for ever if it waited
    go_on.set()
    assert again.wait(10.0)
    maker.close()
    assert packed == [SECOND, captured(pictures[0], 11).stamp_ns]
    (line,) = [record.message for record in caplog.records if record.message.startswith("the video holds")]
    assert re.match(r"the video holds 2 of 1\d pictures", line)


@pytest.mark.parametrize("error", [RuntimeError("the codec is broken"), cv2.error("another size"), MemoryError()])
def test_a_picture_that_cannot_be_packed_costs_that_picture_and_the_packer(
    pictures: list[Pixels], monkeypatch: pytest.MonkeyPatch, error: Exception
) -> None:
    """The third goes out, packed by a packer made anew; the process goes on."""
    made, done = [0], threading.Semaphore(0)
    payloads: list[bytes] = []

    def make(recording: object, size_px: object) -> Any:
        made[0] += 1
        number = made[0]

        def pack(pixels: Pixels, stamp_ns: int) -> bytes:
            done.release()
            if number == 1 and stamp_ns > SECOND:
                raise error
            return b"%d" % number

        return pack

    monkeypatch.setattr("localizer.view.video_encoder.packer", make)
    hub, stop = MemoryHub(), Stop(install=False)
    Bus(MemoryTransport(hub)).subscribe(
        topics.PICTURE, None, lambda topic, key, header, payload: payloads.append(decode(Picture, payload, "", "").jpeg)
    )
    maker = VideoEncoder(experiment("jpeg"), Bus(MemoryTransport(hub)), stop)
    for k in range(3):
        maker.offer(captured(pictures[k], 4 * k))
        assert done.acquire(timeout=10.0)
    maker.close()
    assert payloads == [b"1", b"2"]
    assert not stop.requested
