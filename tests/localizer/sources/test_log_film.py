"""The film in a run's log is read as a video is: every picture, at its time."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from groundstation.logs.recorder import Recorder
from localizer.sources.log_film import film_of_log
from localizer.sources.video import VideoReader
from localizer.view.video_encoder import packer
from shoal.config.experiment import load_experiment
from shoal.errors import ConfigError
from shoal.messages import topics
from shoal.messages.codec import Header, encode
from shoal.messages.messages import Event, Video

BEGIN_NS, EVERY_NS, PICTURES = 1_000_000_000, 50_000_000, 25


def test_every_picture_of_a_log_is_in_the_film_at_its_time(tmp_path: Path) -> None:
    experiment = load_experiment("pool", ['recording.video="h264"'])
    pack, recorder = packer(experiment.recording, experiment.camera.size_px), Recorder(tmp_path / "run.mcap", "", {})
    for k in (*range(5), *range(8, PICTURES)):  # the recorder left some out
        grey, stamp_ns = np.full(experiment.camera.size_px[::-1], 40 + 6 * k, dtype=np.uint8), BEGIN_NS + k * EVERY_NS
        video = encode(Video(pack(grey, stamp_ns)), stamp_ns)
        recorder.put(topics.VIDEO, "shoal/camera/video", Header(7, k + 1, stamp_ns), video, stamp_ns + 5)
    recorder.close()
    assert film_of_log(tmp_path / "run.mcap", "", tmp_path / "film.mkv") == (BEGIN_NS, "")
    film = VideoReader(tmp_path / "film.mkv")
    assert film.size_px == experiment.camera.size_px
    pictures = list(film.pictures())
    assert [picture.stamp_ns for picture in pictures] == [k * EVERY_NS for k in (*range(5), *range(8, PICTURES))]
    assert film.damage() == ""
    assert np.all(np.diff([float(picture.pixels.mean()) for picture in pictures]) > 3.0)  # in their order
    film.close()


def test_a_log_without_film_says_which_key_keeps_one(tmp_path: Path) -> None:
    recorder = Recorder(tmp_path / "run.mcap", "", {})
    recorder.put(topics.EVENT, "shoal/event", Header(7, 1, 1), encode(Event(2, "agent-1", "armed")), 1)
    recorder.close()
    with pytest.raises(ConfigError, match=r"recording\.video"):
        film_of_log(tmp_path / "run.mcap", "", tmp_path / "film.mkv")


def _logged(folder: Path, pictures: Sequence[tuple[int, bool]]) -> Path:
    """A log with a picture for each stamp, of an encoder that is started anew where the second is True; none for stamp 0."""
    experiment = load_experiment("pool", ['recording.video="h264"'])
    pack, recorder = packer(experiment.recording, experiment.camera.size_px), Recorder(folder / "run.mcap", "", {})
    for k, (stamp_ns, begins) in enumerate(pictures):
        pack = packer(experiment.recording, experiment.camera.size_px) if begins else pack
        video = pack(np.full(experiment.camera.size_px[::-1], 40 + 6 * k, dtype=np.uint8), BEGIN_NS + k * EVERY_NS)
        if stamp_ns:
            recorder.put(
                topics.VIDEO, "shoal/camera/video", Header(7, k + 1, stamp_ns), encode(Video(video), stamp_ns), stamp_ns
            )
    recorder.close()
    return folder / "run.mcap"


def test_the_film_begins_with_the_first_whole_picture_and_ends_where_the_clock_goes_back(tmp_path: Path) -> None:
    stamps_ns = [0, *(BEGIN_NS + k * EVERY_NS for k in range(1, 8)), *(BEGIN_NS // 2 + k * EVERY_NS for k in range(8, 12))]
    log = _logged(tmp_path, [(stamp_ns, k in (3, 8)) for k, stamp_ns in enumerate(stamps_ns)])
    first_ns, left_out = film_of_log(log, "", tmp_path / "film.mkv")
    assert first_ns == stamps_ns[3] and "6 of 11 pictures are left out" in left_out
    film = VideoReader(tmp_path / "film.mkv")
    assert [picture.stamp_ns for picture in film.pictures()] == [k * EVERY_NS for k in range(5)]
    film.close()


def test_the_film_of_a_cut_log_ends_where_it_was_cut_and_says_so(tmp_path: Path) -> None:
    log = _logged(tmp_path, [(BEGIN_NS + k * EVERY_NS, False) for k in range(PICTURES)])
    log.write_bytes(log.read_bytes()[: -log.stat().st_size // 3])
    first_ns, damage = film_of_log(log, "", tmp_path / "film.mkv")
    assert first_ns == BEGIN_NS and damage.startswith(f"{log}: was cut, and the film ends there: ")
    film = VideoReader(tmp_path / "film.mkv")
    stamps_ns = [picture.stamp_ns for picture in film.pictures()]
    assert 2 <= len(stamps_ns) <= PICTURES and stamps_ns == [k * EVERY_NS for k in range(len(stamps_ns))]
    film.close()


@pytest.mark.parametrize("pictures", [[(BEGIN_NS, False)] * 4, [(0, False), (BEGIN_NS, False), (BEGIN_NS + EVERY_NS, False)]])
def test_a_log_of_which_no_film_can_be_made_is_refused(tmp_path: Path, pictures: list[tuple[int, bool]]) -> None:
    with pytest.raises(ConfigError, match="holds no film"):
        film_of_log(_logged(tmp_path, pictures), "", tmp_path / "film.mkv")
