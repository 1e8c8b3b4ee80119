"""`localizer setup` as a process, as the documentation writes it: on the fleet's frames, and on a camera that is absent."""

import json
import os
import re
import shlex
import signal
import subprocess
import sys
import urllib.request
from contextlib import closing
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from shoal.bus import frame_ring
from shoal.bus.bus import Bus
from shoal.bus.endpoint import Endpoint
from shoal.bus.frame_ring import codec_of
from shoal.bus.zenoh_transport import ZenohTransport
from shoal.config.experiment import EXPERIMENTS, load_experiment
from shoal.messages import topics
from shoal.messages.messages import Frame
from shoal.runtime.runtime import Stop
from sim_bridge.camera.renderer import Renderer
from tests.waiting import eventually

pytestmark = [pytest.mark.real_time, pytest.mark.long]

SETUP_PAGE = Path(__file__).parents[3] / "docs" / "camera-setup.md"


def _open(address: str, path: str) -> Any:
    """The answer that a page with the printed address gets."""
    base, key = address.split("#key=")
    return urllib.request.urlopen(urllib.request.Request(f"{base.rstrip('/')}{path}", headers={"x-key": key}), timeout=30)


def _state(address: str) -> Any:
    with _open(address, "/state") as answer:
        return json.load(answer)


def _picture(address: str) -> NDArray[np.uint8]:
    """The next picture of the live stream, grey."""
    with _open(address, "/live") as stream:
        while not (size := re.match(rb"Content-Length: (\d+)", stream.readline())):
            pass
        stream.readline()
        jpeg = stream.read(int(size[1]))
    return np.asarray(cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_GRAYSCALE), dtype=np.uint8)


@pytest.mark.skipif(not hasattr(os, "memfd_create"), reason="no anonymous files here")
@pytest.mark.parametrize("shared", [False, True], ids=["network", "shared memory"])
def test_it_shows_the_frames_of_the_simulated_camera(shared: bool, address: str, tmp_path: Path) -> None:
    """The program's default source. What its page shows is the picture that was rendered."""
    experiment, out = load_experiment("pool"), tmp_path / "lab.toml"
    ring = frame_ring.create([experiment.camera.size_px]) if shared else None
    eta = np.array([[0.5, 0.3, 0.3, 0.4], [-0.5, 0.0, 0.3, 1.0]])
    frame = Renderer(experiment, 1).render(eta, np.zeros((2, 4)), 0.0, 0)
    command = [sys.executable, "-m", "localizer", "setup", "pool", "--out", str(out), "--port", "0", "--station", address]
    beside = () if ring is None else (ring,)
    process = subprocess.Popen(
        [*command, *(("--frame-ring", str(ring)) if shared else ())], stdout=subprocess.PIPE, text=True, pass_fds=beside
    )
    try:
        assert process.stdout is not None
        link = re.search(r"http://\S+", process.stdout.readline())
        assert link is not None
        with closing(Bus(ZenohTransport(Endpoint(address), Stop()), "shoal", *codec_of(ring))) as camera:

            def is_seen() -> bool:
                camera.publish(topics.FRAME, Frame(frame), 1)
                return _state(link[0])["figures"] is not None

            assert eventually(is_seen, 20.0)
        state, shown = _state(link[0]), _picture(link[0])
        assert state["experiment"] == "pool" and state["source"] == "bus" and state["size_px"] == [1280, 960]
        drawn = cv2.resize(cv2.cvtColor(frame, cv2.COLOR_BayerRGGB2GRAY), shown.shape[::-1], interpolation=cv2.INTER_AREA)
        assert np.corrcoef(shown.ravel(), drawn.ravel())[0, 1] > 0.9
    finally:
        process.send_signal(signal.SIGINT)
        assert process.wait(30) == 0
        for descriptor in beside:
            os.close(descriptor)


@pytest.mark.skipif(Path("/dev/video0").exists(), reason="there is a camera")
def test_the_documented_command_names_the_camera_that_is_absent(tmp_path: Path) -> None:
    """As docs/camera-setup.md writes it, in a folder with a lab.toml."""
    line = next(text for text in SETUP_PAGE.read_text().splitlines() if text.startswith("localizer setup lab.toml"))
    (tmp_path / "lab.toml").write_text((EXPERIMENTS / "pool.toml").read_text())
    words = shlex.split(line, comments=True)
    done = subprocess.run(
        [sys.executable, "-m", *words, "--port", "0"], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert done.returncode == 2 and "/dev/video0" in done.stderr
