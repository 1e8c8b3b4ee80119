"""Several cameras of an experiment: what may stand in the file, and what each part of the fleet makes of it."""

import os
import tomllib
from pathlib import Path

import numpy as np
import pytest
import tomli_w

from groundstation.logs.reader import key_topic
from localizer.tracking.check_marks import with_camera
from shoal.bus import frame_ring
from shoal.bus.access_control import Member, grants
from shoal.config.experiment import EXPERIMENTS, dump_experiment, load_experiment
from shoal.config.fault_injection import Break, read_what
from shoal.errors import ConfigError
from shoal.messages import topics
from shoal.messages.camera_coverage import outside_m
from shoal.messages.messages import Frame
from sim_bridge.node.simulated_camera import Exposure, SimulatedCamera

EXPERIMENT = load_experiment("two-cameras")
FULL = tomllib.loads((EXPERIMENTS / "two-cameras.toml").read_text(encoding="utf-8"))


@pytest.mark.parametrize(
    ("setting", "complaint"),
    [
        ("cameras.1.name=west", "cameras.1.name = 'west': is used twice"),
        ("cameras.1.name=dark", "cameras.1.name = 'dark': `camera dark` is a fault (not: gone, slow, frozen"),
        ("cameras.1.name=North/East", "cameras.1.name = 'North/East'"),
        ("cameras.1.rate_hz=25.0", "cameras.1.rate_hz = 25: not that of west (allowed: 20)"),
        ("cameras.1={name='east'}", "cameras.1.position_m: missing"),
        ("cameras.1={like='lost.toml', name='east'}", "lost.toml: no such file"),
        ("cameras.1.position_m=[1.35,0.0,0.5]", "must hang above the water"),
        ("camera={size_px=[640,480]}", "camera.position_m: missing"),
        ("localizer.markers=false", "localizer.markers = false: from camera to camera robots are known by their markers"),
        ("landmarks=[{id=30,position_m=[0.0,0.0,1.0]}]", "landmarks: they place one moving camera"),
        ("sim.faults=[{at_s=1.0,what='camera north dark'}]", "no camera 'north' (allowed: west, east)"),
        ("sim.faults=[{at_s=1.0,what='process localizer-north killed'}]", "localizer, localizer-west, localizer-east"),
    ],
)
def test_cameras_that_do_not_go_together_are_refused_by_name(setting: str, complaint: str) -> None:
    with pytest.raises(ConfigError) as caught:
        load_experiment("two-cameras", [setting])
    assert complaint in str(caught.value)


def test_a_camera_beside_several_is_refused_and_so_is_a_name_where_there_is_one(tmp_path: Path) -> None:
    alone = {key: value for key, value in FULL["cameras"][0].items() if key != "name"}
    path = tmp_path / "both.toml"
    path.write_text(tomli_w.dumps(FULL | {"camera": alone}), encoding="utf-8")
    with pytest.raises(ConfigError, match=r"camera: stands beside \[\[cameras\]\]"):
        load_experiment(str(path))
    with pytest.raises(ConfigError, match=r"no camera 'west' \(allowed: no name: there is one camera\)"):
        load_experiment("pool", faults=["t=1 camera west dark"])
    for name, complaint in (
        ("", r"--camera: missing, 'two-cameras' has several \(allowed: west, east\)"),
        ("north", "west, east"),
    ):
        with pytest.raises(ConfigError, match=complaint):
            EXPERIMENT.of_camera(name)
    with pytest.raises(ConfigError, match="'pool' has one camera"):
        load_experiment("pool").of_camera("west")


def test_cameras_may_lie_in_files_and_the_dump_is_the_same_experiment(tmp_path: Path) -> None:
    named = []
    for camera in FULL["cameras"]:
        name = camera["name"]
        table = {key: value for key, value in camera.items() if key != "name"}
        (tmp_path / f"{name}.toml").write_text(tomli_w.dumps({"camera": table}), encoding="utf-8")
        named.append({"name": name, "like": f"{name}.toml"})
    path, dumped = tmp_path / "lab.toml", tmp_path / "dump.toml"
    path.write_text(tomli_w.dumps(FULL | {"cameras": named}), encoding="utf-8")
    loaded = load_experiment(str(path))
    dumped.write_text(dump_experiment(loaded), encoding="utf-8")
    assert loaded.hash == EXPERIMENT.hash == load_experiment(str(dumped)).hash
    assert load_experiment(str(path), ["cameras.1.exposure_s=0.004"]).cameras[1].exposure_s == 0.004


def test_each_localizer_has_its_camera_and_the_marks_in_its_picture_alone() -> None:
    west, east = (with_camera(EXPERIMENT, name) for name in EXPERIMENT.camera_names)
    assert west.camera.position_m[0] == -1.35 and west.cameras == () and east.camera.exposure_s == 0.005
    assert [mark.id for mark in west.check_marks] == [40, 41, 42, 43, 44]
    assert [mark.id for mark in east.check_marks] == [43, 44, 45, 46, 47]
    assert with_camera(load_experiment("figure-eight"), "").hash == load_experiment("figure-eight").hash


def test_a_place_is_in_the_picture_if_one_camera_shows_it() -> None:
    places = np.array([[-1.35, 0.0, 0.3], [0.0, 0.0, 0.3], [1.35, 0.0, 0.3], [4.0, 0.0, 0.3]])
    west, east = EXPERIMENT.cameras
    assert (outside_m([west], places, 0.2) <= 0.0).tolist() == [True, True, False, False]
    assert (outside_m([east], places, 0.2) <= 0.0).tolist() == [False, True, True, False]
    assert (outside_m([west, east], places, 0.2) <= 0.0).tolist() == [True, True, True, False]


def test_a_fault_of_a_camera_may_name_it() -> None:
    assert read_what("camera east bump 20") == Break("camera", "bump", 20.0, camera="east")
    assert read_what("camera slow 0.2") == Break("camera", "slow", 0.2)
    with pytest.raises(ValueError, match=r"must read: camera \[CAMERA\] gone\|slow \[delay in s\]\|frozen"):
        read_what("camera east")


def test_topics_of_cameras_are_told_apart_in_keys_logs_and_rights() -> None:
    assert topics.FRAME.of_camera("west").key() == "camera/west/frame" and topics.FRAME.of_camera("") is topics.FRAME
    assert topics.POSE.of_camera("west").key(3) == "camera/west/robot/3/pose"
    assert key_topic("shoal/camera/west/robot/3/pose") == (topics.POSE.of_camera("west"), 3)
    assert key_topic("shoal/camera/west/localizer/status") == (topics.LOCALIZER.of_camera("west"), 0)
    topic_and_robot = key_topic("shoal/camera/preview")
    assert topic_and_robot is not None and topic_and_robot[0] is topics.PREVIEW
    assert key_topic("shoal/camera/WEST/preview") is None
    rights = grants(Member(topics.Role.LOCALIZER, "localizer"))
    assert "camera/*/robot/*/pose" in [topic.key() for topic in rights.write]
    assert "presence/localizer-$*" in rights.announce
    assert not any("camera" in topic.key() for topic in grants(Member(topics.Role.ROBOT, "robot 1", 1)).write)


def test_a_ring_has_frames_of_every_camera() -> None:
    descriptor = frame_ring.create([(16, 8), (32, 8)])
    assert descriptor is not None
    try:
        writer, reader = frame_ring.FrameRing(descriptor), frame_ring.FrameRing(descriptor)
        shapes = [(8, 16), (8, 32)]
        headers = [writer.encode(Frame(np.full(shapes[k % 2], k, np.uint8))) for k in range(2 * frame_ring.SLOTS)]
        for k, data in enumerate(headers):
            pixels = reader.decode(Frame, data, "camera", "frame").pixels
            assert pixels.shape == shapes[k % 2] and (pixels == k).all()
    finally:
        os.close(descriptor)


# --- simulated


def test_a_slow_camera_hands_its_frames_out_late_and_a_gone_one_none() -> None:
    small = [
        f"cameras.{k}.{key}" for k in range(2) for key in ("size_px=[64,64]", "focal_px=[50.0,50.0]", "centre_px=[32.0,32.0]")
    ]
    experiment = load_experiment("two-cameras", [*small, "check_marks=[]", "sim.picture.glare=0.0"])
    camera, still = SimulatedCamera(experiment, "east"), np.zeros((2, 4))
    slow, gone, other = read_what("camera east slow 0.1"), read_what("camera east gone"), read_what("camera west gone")
    handed = {}
    for k, broken in enumerate([(), (slow,), (slow,), (other,), (gone,), ()]):
        at_ns = k * 50_000_000
        camera.expose(Exposure(still, still, still, at_ns * 1e-9, k, at_ns, broken))
        handed[k] = [stamp_ns // 50_000_000 for stamp_ns, _ in camera.due(at_ns)]
    assert handed == {0: [0], 1: [], 2: [], 3: [1], 4: [2, 3], 5: [5]}
    assert camera.frame_ns == 250_000_000
