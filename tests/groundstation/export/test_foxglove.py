"""Output for 3-D viewers: the log with a scene in it, a layout that finds everything, and the same live."""

import dataclasses
import json
import re
import shutil
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, get_type_hints

import numpy as np
import pytest
from foxglove import layouts as their_layouts
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory
from typer.testing import CliRunner
from websockets.sync.client import ClientConnection, connect

from groundstation.__main__ import cli
from groundstation.export.foxglove_layout import Layout, layout
from groundstation.export.foxglove_live import ViewerServer
from groundstation.export.foxglove_scene import FRAMES, GONE_NS, MOVING, POOL_FRAME, STANDING, SceneDrawer, upright
from groundstation.logs.reader import key_topic
from shoal.bus.bus import Bus
from shoal.bus.memory_transport import MemoryHub, MemoryTransport
from shoal.config.experiment import load_experiment
from shoal.messages import topics
from shoal.messages.codec import encode
from shoal.messages.messages import Estimate, Obstacles, Plan, RobotState
from shoal.messages.schema import nested_message
from sim_bridge.lockstep.clock import LockstepClock
from tests.groundstation.synthetic import Script, write_run

pytestmark = pytest.mark.real_time

SECOND = 1_000_000_000


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A run's folder, and what was made of it."""
    run, out = tmp_path_factory.mktemp("run"), tmp_path_factory.mktemp("out")
    write_run(run, Script(duration_s=6.0))
    done = CliRunner().invoke(cli, ["log", "export", str(run), "--out", str(out), "--foxglove"])
    assert done.exit_code == 0, done.output
    return run, out


def used_topics(made: Layout) -> set[str]:
    """Every topic that a layout looks at."""
    panels = made["configById"]
    plotted = [path["value"].partition(".")[0] for panel in panels.values() for path in panel.get("paths", ())]
    shown = [
        *panels["3D!pool"]["topics"],
        panels["Image!camera"]["imageMode"]["imageTopic"],
        panels["RosOut!log"]["topicToRender"],
    ]
    return {*plotted, *shown}


def viewer_topics(fleet: str) -> set[str]:
    """Those that only an exported log and a live viewer have."""
    return {f"{fleet}/{name}" for name in (MOVING, STANDING, FRAMES)}


def messages(path: Path, decoded: bool = False) -> list[Any]:
    with path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        if decoded:
            return [(m.channel.topic, m.message, m.decoded_message) for m in reader.iter_decoded_messages()]
        return [(c.topic, m.log_time, m.publish_time, m.sequence, m.data) for _, c, m in reader.iter_messages()]


def log_of(out: Path) -> Path:
    (path,) = out.glob("*.mcap")
    return path


def test_export_leaves_all_recorded_messages_unchanged(exported: tuple[Path, Path]) -> None:
    run, out = exported
    before, after = messages(run / "run.mcap"), messages(log_of(out))
    added = [m for m in after if m[0] in viewer_topics("shoal")]
    assert sorted(before) == sorted(m for m in after if m not in added)
    assert len(added) > 70  # ten a second


def test_another_reader_takes_both(exported: tuple[Path, Path], capsys: pytest.CaptureFixture[str]) -> None:
    from pymcap_cli.cli import app as pymcap  # takes 0.7 s of every process that collects this file

    run, out = exported
    for path in (run / "run.mcap", log_of(out)):
        with pytest.raises(SystemExit) as ended:
            pymcap(["doctor", str(path)])
        output = capsys.readouterr()
        assert ended.value.code in (0, None), output.out + output.err


def test_hulls_are_drawn_where_robots_say_they_are(exported: tuple[Path, Path]) -> None:
    """Each hull stands at one of the poses that its robot has told within 0.1 s."""
    etas: dict[int, list[tuple[int, Any]]] = {1: [], 2: []}
    drawn: list[tuple[int, int, list[float]]] = []
    for topic, message, decoded in messages(log_of(exported[1]), decoded=True):
        topic_and_robot = key_topic(topic)
        if topic_and_robot is not None and topic_and_robot[0] is topics.STATE:
            etas[topic_and_robot[1]].append((message.log_time, decoded.estimate.eta))
        if topic == "shoal/viewer/scene":
            for entity in decoded.entities:
                if entity.id.startswith("robot"):
                    assert entity.frame_id == POOL_FRAME
                    place, turn = entity.spheres[0].pose.position, entity.arrows[0].pose.orientation
                    eta = [place.x, place.y, place.z, 2.0 * np.arctan2(turn.z, turn.w)]
                    drawn.append((message.log_time, int(entity.id.split()[1]), eta))
    assert len(drawn) > 120
    for at_ns, robot, eta in drawn:
        near = [told_eta for told_ns, told_eta in etas[robot] if abs(told_ns - at_ns) <= SECOND // 10]
        assert min(np.abs(np.subtract(eta, one)).max() for one in near) < 1e-9


def test_silent_robots_and_old_obstacles_are_not_drawn() -> None:
    picture = SceneDrawer(load_experiment("pool"))
    picture.take(topics.STATE, 1, RobotState(estimate=Estimate()), SECOND)
    picture.take(topics.PLAN, 2, Plan(0.05, np.ones((5, 4)), np.ones((5, 4))), SECOND)
    obstacles = Obstacles((4,), np.ones((1, 12, 2)), np.zeros((1, 2)), 0.3, unseen_s=np.zeros(1))
    picture.take(topics.OBSTACLES, 0, obstacles, SECOND)
    assert {e.id for e in picture.moving(SECOND + GONE_NS).entities} == {"robot 1", "plan 2", "obstacle 4"}
    assert not picture.moving(SECOND + GONE_NS + 1).entities
    assert all(e.lifetime.ToNanoseconds() == GONE_NS for e in picture.moving(SECOND).entities)


def test_down_in_the_pool_is_down_on_the_screen() -> None:
    """Half a turn about x by the quaternion in the transform takes the pool's z to minus z, and keeps handedness."""
    rotation = upright(0).rotation
    w, x, y, z = rotation.w, rotation.x, rotation.y, rotation.z
    turn = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    np.testing.assert_allclose(turn @ [0.0, 0.0, 1.0], [0.0, 0.0, -1.0], atol=1e-12)
    assert np.linalg.det(turn) == pytest.approx(1.0)


def test_every_topic_of_the_layout_is_in_the_log(exported: tuple[Path, Path]) -> None:
    made = json.loads((exported[1] / "foxglove-layout.json").read_text())
    for topic in used_topics(made) - viewer_topics("shoal"):
        topic_and_robot = key_topic(topic)
        assert topic_and_robot is not None and topic_and_robot[0].recorded, topic
    for panel in made["configById"].values():
        for path in panel.get("paths", ()):
            topic, _, rest = path["value"].partition(".")
            kind = key_topic(topic)
            assert kind is not None
            *parts, last = rest.split(".")
            cls: Any = kind[0].type
            for part in parts:
                cls = nested_message(get_type_hints(cls)[part])
            field = re.fullmatch(r"(\w+)(\[\d\])?", last)
            assert field is not None and field[1] in {f.name for f in dataclasses.fields(cls)}
    assert viewer_topics("shoal") <= {m[0] for m in messages(log_of(exported[1]))}


def test_the_layouts_words_are_those_of_the_viewers_own_library() -> None:
    """Names of settings are looked up in the SDK's own classes; the title of a panel is a setting of every panel."""
    theirs = {
        "3D": their_layouts.ThreeDeeConfig(),
        "Image": their_layouts.ImageConfig(),
        "Plot": their_layouts.PlotConfig(),
        "StateTransitions": their_layouts.StateTransitionsConfig(),
        "RosOut": their_layouts.LogConfig(),
    }
    for name, config in layout(load_experiment("fleet-20"), "shoal")["configById"].items():
        # the SDK has no public way to list the settings of a panel
        unknown = set(config) - set(theirs[name.partition("!")[0]]._to_dict()) - {"foxglovePanelTitle"}
        assert not unknown, f"{name}: {unknown}"


@pytest.mark.parametrize("name", ["pool", "two-cameras"])
def test_every_panel_has_its_place(name: str) -> None:
    made = layout(load_experiment(name), "shoal")

    def leaves(node: Any) -> Iterator[str]:
        if isinstance(node, str):
            yield node
        else:
            yield from (leaf for side in ("first", "second") for leaf in leaves(node[side]))

    assert sorted(leaves(made["layout"])) == sorted(made["configById"])


def test_each_of_several_cameras_has_a_panel_for_its_picture() -> None:
    panels = layout(load_experiment("two-cameras", ["recording.video=h264"]), "lab")["configById"]
    topics_shown = {key: panel["imageMode"]["imageTopic"] for key, panel in panels.items() if key.startswith("Image!")}
    assert topics_shown == {"Image!camera-west": "lab/camera/west/video", "Image!camera-east": "lab/camera/east/video"}


def test_the_layout_is_printed_for_any_experiment() -> None:
    done = CliRunner().invoke(cli, ["foxglove", "layout", "fleet-20", "--fleet", "lab"])
    assert "lab/robot/20/state" in str(sorted(used_topics(json.loads(done.output))))


# --- live


@pytest.fixture
def served() -> Iterator[tuple[Bus, ViewerServer]]:
    hub, clock = MemoryHub(), LockstepClock()
    bus = Bus(MemoryTransport(hub))
    with ViewerServer(load_experiment("pool"), bus, clock, "127.0.0.1", 0) as server:
        yield Bus(MemoryTransport(hub)), server


def advertised(viewer: ClientConnection, wanted: set[str]) -> dict[str, dict[str, Any]]:
    channels: dict[str, dict[str, Any]] = {}
    while not wanted <= set(channels):
        text = viewer.recv(timeout=10.0)
        if isinstance(text, str):
            message = json.loads(text)
            channels |= {channel["topic"]: channel for channel in message.get("channels", ())}
            if message["op"] == "serverInfo":
                assert message["capabilities"] == []  # no viewer may send anything
    return channels


def test_a_viewer_hears_what_is_on_the_bus_and_sees_the_scene(served: tuple[Bus, ViewerServer]) -> None:
    bus, server = served
    state = RobotState(estimate=Estimate(eta=np.array([1.0, 2.0, 0.3, 0.1])))
    with connect(f"ws://127.0.0.1:{server.port}", subprotocols=["foxglove.sdk.v1"]) as viewer:  # type: ignore[list-item]
        bus.publish(topics.STATE, state, SECOND, 1)
        channels = advertised(viewer, {"shoal/robot/1/state", "shoal/viewer/scene", "shoal/viewer/pool"})
        assert channels["shoal/robot/1/state"]["schemaName"] == "fleet.RobotState"
        wanted = ("shoal/robot/1/state", "shoal/viewer/scene")
        subscriptions = [{"id": k, "channelId": channels[topic]["id"]} for k, topic in enumerate(wanted)]
        viewer.send(json.dumps({"op": "subscribe", "subscriptions": subscriptions}))
        payloads: dict[int, bytes] = {}
        for _ in range(500):
            bus.publish(topics.STATE, state, SECOND, 1)
            time.sleep(0.002)
            data = viewer.recv(timeout=10.0)
            if isinstance(data, bytes) and data[0] == 1:
                payloads[int.from_bytes(data[1:5], "little")] = data[13:]
            if len(payloads) == 2:
                break
    assert payloads[0] == encode(state)
    scene = SceneDrawer(load_experiment("pool"))
    scene.take(topics.STATE, 1, state, SECOND)
    assert payloads[1] == scene.moving(SECOND).SerializeToString()


def test_a_bad_message_is_passed_on_and_not_drawn(served: tuple[Bus, ViewerServer]) -> None:
    bus, server = served
    bus.forward(topics.STATE, b"\xff\xff", SECOND, 1)
    bus.publish(topics.STATE, RobotState(), SECOND, 2)
    with connect(f"ws://127.0.0.1:{server.port}", subprotocols=["foxglove.sdk.v1"]) as viewer:  # type: ignore[list-item]
        advertised(viewer, {"shoal/robot/1/state", "shoal/robot/2/state", "shoal/viewer/scene"})


def test_an_error_while_drawing_costs_one_picture(
    served: tuple[Bus, ViewerServer], monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """Otherwise the scene would stand still for the rest of the run, without a word."""
    bus, server = served
    draw, drawn = SceneDrawer.moving, list[int]()

    def fails_twice(scene: SceneDrawer, now_ns: int) -> Any:
        drawn.append(now_ns)
        if len(drawn) <= 2:
            raise RuntimeError("no colour")
        return draw(scene, now_ns)

    monkeypatch.setattr(SceneDrawer, "moving", fails_twice)
    with connect(f"ws://127.0.0.1:{server.port}", subprotocols=["foxglove.sdk.v1"]) as viewer:  # type: ignore[list-item]
        while len(drawn) < 3:
            bus.publish(topics.STATE, RobotState(), SECOND, 1)
            time.sleep(0.02)
        advertised(viewer, {"shoal/viewer/scene"})
    assert caplog.text.count("the scene for viewers could not be drawn: RuntimeError: no colour") == 1


def test_an_address_that_cannot_be_is_refused() -> None:
    done = CliRunner().invoke(cli, ["run", "pool", "--foxglove", "8765"])
    assert "127.0.0.1:8765" in str(done.exception)


READ_WITH_NODE = """
import { readFile } from "node:fs/promises";
import { McapIndexedReader } from "@mcap/core";
import { loadDecompressHandlers } from "@mcap/support";
const bytes = await readFile(process.argv[2]);
const readable = {
  size: async () => BigInt(bytes.length),
  read: async (offset, length) => new Uint8Array(bytes.subarray(Number(offset), Number(offset + length))),
};
const reader = await McapIndexedReader.Initialize({ readable, decompressHandlers: await loadDecompressHandlers() });
const counted = {};
for await (const message of reader.readMessages({ validateCrcs: true })) {
  const topic = reader.channelsById.get(message.channelId).topic;
  counted[topic] = (counted[topic] ?? 0) + 1;
}
console.log(JSON.stringify(counted));
"""


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("npm") is None, reason="needs Node")
def test_the_viewers_own_reader_takes_both(exported: tuple[Path, Path], tmp_path: Path) -> None:
    """@mcap/core, which Foxglove and Lichtblick read with; fetched by npm."""
    (tmp_path / "read.mjs").write_text(READ_WITH_NODE)
    subprocess.run(["npm", "install", "--silent", "@mcap/core@2", "@mcap/support@1"], cwd=tmp_path, check=True)
    for path in (exported[0] / "run.mcap", log_of(exported[1])):
        done = subprocess.run(["node", "read.mjs", str(path)], cwd=tmp_path, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
        counted: dict[str, int] = {}
        for topic, *_ in messages(path):
            counted[topic] = counted.get(topic, 0) + 1
        assert json.loads(done.stdout) == counted
