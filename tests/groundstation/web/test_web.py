"""The operator's page, station side, without a browser: who may do what, what is sent when, and what a page may say."""

import contextlib
import json
import math
import os
import re
from dataclasses import replace
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from groundstation.planning import planner
from groundstation.planning.segment import PlanSegment
from groundstation.telemetry import RobotView
from groundstation.web import experiment_editor, protocol
from groundstation.web.alarms import alarms
from groundstation.web.client_hub import SILENT_S, ControlLease
from groundstation.web.scene import mesh
from groundstation.web.send_window import MOST_NOTES, UNACKNOWLEDGED, SendWindow
from groundstation.web.snapshot import ellipse
from shoal.bus.access_control import INSECURE
from shoal.config.experiment import load_experiment, with_flight
from shoal.config.scene import Waypoints
from shoal.errors import ConfigError
from shoal.messages.camera_coverage import project
from shoal.messages.live_gains import tunable_parameters
from shoal.messages.messages import (
    BoardReading,
    CameraHealth,
    CommandKind,
    LocalizerStatus,
    Mode,
    Pose,
    RobotState,
    StepTiming,
    Track,
)
from shoal.runtime.web_access import host_allowed, origin_allowed, token_allowed, web_options
from sim_bridge.camera import optics

POOL = load_experiment("pool")
STRAIGHT = load_experiment("straight")


def test_the_page_knows_the_orders_that_the_station_takes() -> None:
    """The page's source writes them down once more: TypeScript cannot read Python."""
    source = (Path(protocol.__file__).parent / "page/src/wire.ts").read_text(encoding="utf-8")
    line = next(line for line in source.splitlines() if line.startswith("export type OrderName"))
    assert set(re.findall(r'"([a-z-]+)"', line)) == set(protocol.ORDERS)


# --- the window: latest wins, nobody waits


def test_at_most_two_frames_are_on_their_way() -> None:
    window = SendWindow()
    for k in range(10):
        window.offer("state", b"%d" % k)
        window.next(0.0)
    window.offer("state", b"newest")
    assert window.next(1.0) is None
    window.acknowledge(1, 1.0)
    assert window.next(1.0) == (UNACKNOWLEDGED + 1, b"newest")  # all between were passed over
    assert window.next(1.0) is None


def test_states_and_pictures_take_turns_and_so_do_notes_which_come_in_order() -> None:
    window = SendWindow()
    for body in (b"1", b"2", b"3"):
        window.note(body)
    window.offer("picture", b"p")
    window.offer("state", b"s")
    sent = []
    while (frame := window.next(0.0)) is not None:
        sent.append(frame[1])
        window.acknowledge(frame[0], 0.0)
    assert sent == [b"1", b"p", b"2", b"s", b"3"]


def test_notes_without_end_keep_no_state_waiting() -> None:
    window, sent = SendWindow(), []
    for _ in range(MOST_NOTES):
        window.note(b"note")
    for k in range(10):
        window.offer("state", b"%d" % k)
        for _ in range(2):
            frame = window.next(0.0)
            assert frame is not None
            window.acknowledge(frame[0], 0.0)
            sent.append(frame[1])
    assert sent == [body for k in range(10) for body in (b"note", b"%d" % k)]


def test_no_number_of_notes_drops_an_answer() -> None:
    window = SendWindow()
    window.answer(b"asked for")
    for _ in range(2 * MOST_NOTES):
        window.note(b"note")
    window.answer(b"asked for later")
    assert [window.next(0.0), window.next(0.0)] == [(1, b"asked for"), (2, b"asked for later")]


def test_a_stopped_page_costs_a_bounded_memory() -> None:
    window = SendWindow()
    for k in range(3 * MOST_NOTES):
        window.note(b"%d" % k)
        window.offer("state", b"x" * 1000)
        window.next(0.0)
    window.acknowledge(2, 9.0)
    left = []
    while (frame := window.next(9.0)) is not None:
        left.append(frame[1])
        window.acknowledge(frame[0], 9.5)
    assert len(left) <= MOST_NOTES + 1
    assert left[-1] == b"%d" % (3 * MOST_NOTES - 1)  # the newest note is there; the oldest were given up
    assert window.round_trip_s == 0.5


def test_an_unknown_acknowledgement_is_ignored() -> None:
    window = SendWindow()
    window.offer("state", b"a")
    window.next(0.0)
    window.acknowledge(0, 1.0)
    assert window.round_trip_s == 0.0
    window.offer("state", b"b")
    window.offer("picture", b"c")
    assert window.next(0.0) is not None
    assert window.next(0.0) is None


# --- the editor


def test_an_edit_begins_at_the_waypoint_that_the_editor_says() -> None:
    """A waypoint more before it moves its number on."""
    eight = load_experiment("figure-eight")
    assert isinstance(eight.path, Waypoints)
    begin, points = eight.path.start_index, list(eight.path.points_m)
    points.insert(1, (0.5 * (points[0][0] + points[1][0]), 0.5 * (points[0][1] + points[1][1])))
    path = experiment_editor.edited(eight, protocol.Edit(points_m=points, start_index=begin + 1)).path
    assert isinstance(path, Waypoints)
    assert path.points_m[path.start_index] == eight.path.points_m[begin]


# --- the lease


def test_one_page_has_control_and_a_silent_page_loses_it() -> None:
    lease = ControlLease()
    assert lease.ask(1, 0.0)
    assert not lease.ask(2, 1.0)
    lease.note_life(2, 4.0)  # a watcher's life does not keep the holder's lease
    assert lease.ask(1, 4.0)
    assert not lease.ask(2, 4.0 + SILENT_S)
    assert lease.ask(2, 4.1 + SILENT_S)
    lease.leave(1)  # the one that lost it cannot give away another's
    assert lease.holder == 2
    assert lease.ask(3, 10.0, over=True)
    lease.leave(3)
    assert lease.free(10.0)


def test_silent_page_that_comes_to_itself_has_control_again_unless_another_asked_or_it_was_gone() -> None:
    late = 2.0 * SILENT_S
    for another_asked, gone, holder in ((False, False, 1), (True, False, 2), (False, True, 0)):
        lease = ControlLease()
        lease.ask(1, 0.0)
        assert lease.free(late)
        if another_asked:
            lease.ask(2, late)
        if gone:
            lease.leave(1)
        lease.note_life(2, late)
        lease.note_life(1, late)
        assert lease.holder == holder


# --- who may look in


def test_off_loopback_tls_and_a_token_are_needed() -> None:
    certificate, key = Path("c.pem"), Path("k.pem")
    assert web_options("127.0.0.1:8000").url == "http://127.0.0.1:8000/"
    assert web_options("[::1]:8000").url == "http://[::1]:8000/"
    assert web_options("0.0.0.0:8000", certificate, key, "x" * 16).url == "https://0.0.0.0:8000/"
    for host in ("0.0.0.0", "192.168.1.10", "station.lab", "[::]"):
        for files, token in (
            ((None, None), ""),
            ((certificate, key), ""),
            ((certificate, key), "short"),
            ((None, None), "x" * 16),
        ):
            with pytest.raises(ConfigError, match="--web"):
                web_options(f"{host}:8000", files[0], files[1], token)
    for wrong in ("8000", "localhost", "localhost:", "localhost:0", "localhost:65536", "localhost:http"):
        with pytest.raises(ConfigError, match="HOST:PORT"):
            web_options(wrong)
    with pytest.raises(ConfigError, match="without the other"):
        web_options("127.0.0.1:8000", certificate)


def test_only_our_own_page_may_open_the_socket() -> None:
    local = web_options("127.0.0.1:8000")
    assert origin_allowed(local, "127.0.0.1:8000", "http://127.0.0.1:8000")
    assert origin_allowed(local, "localhost:8000", "http://localhost:8000")
    for host, origin in (
        ("127.0.0.1:8000", ""),
        ("127.0.0.1:8000", "null"),
        ("127.0.0.1:8000", "http://evil.example"),
        ("127.0.0.1:8000", "https://127.0.0.1:8000"),
        ("127.0.0.1:8000", "http://127.0.0.1:9000"),
        ("evil.example:8000", "http://evil.example:8000"),  # a name made to point here
        ("", "http://"),
    ):
        assert not origin_allowed(local, host, origin), (host, origin)
    assert not host_allowed(local, "evil.example")
    open_to_all = web_options("0.0.0.0:8443", Path("c.pem"), Path("k.pem"), "x" * 16)
    assert origin_allowed(open_to_all, "station.lab:8443", "https://station.lab:8443")
    assert host_allowed(open_to_all, "[fe80::1]:8443") and host_allowed(open_to_all, "192.168.1.10")
    assert token_allowed(local, "") and not token_allowed(local, "x")


@pytest.mark.parametrize(
    "host",
    [
        "[::1].evil.example",
        "[::1]evil.example",
        "127.0.0.1:8000.evil.example",
        "127.0.0.1:8000@evil.example",
        "127.0.0.1:",
        "127.0.0.1:http",
        "127.0.0.1:123456",
        "127.0.0.1:8000:8000",
        "127.0.0.1 ",
        "localhost.evil.example",
        "user@localhost",
        "localhost\n",
        "",
    ],
)
def test_a_host_that_only_begins_like_ours_is_refused(host: str) -> None:
    for options in (web_options("127.0.0.1:8000"), web_options("[::1]:8000")):
        assert not host_allowed(options, host)
        assert not origin_allowed(options, host, f"http://{host}")


# --- what a page may say


def test_requests_are_read() -> None:
    assert protocol.read_request('{"kind":"order","n":3,"order":"clear-stop"}') == protocol.OrderRequest(3, "clear-stop")
    edit = protocol.Edit(nodes_m={1: (0.0, 1.0, 0.0)}, scale=1.5)
    text = json.dumps({"kind": "try", "n": 1, "edit": {"nodes_m": {"1": [0, 1, 0]}, "scale": 1.5}})
    assert protocol.read_request(text) == protocol.PreviewEdit(1, edit)


@pytest.mark.parametrize("key", ["speed_mps", "depth_m", "diameter_m", "lap_s", "duration_s", "scale"])
@pytest.mark.parametrize("value", [0.0, -1.0, 1e9])
def test_an_edit_with_a_number_that_cannot_be_is_a_request_and_is_answered(key: str, value: float) -> None:
    """An operator who types 0.5 has typed 0 first."""
    request = protocol.read_request(json.dumps({"kind": "try", "n": 1, "edit": {key: value}}))
    assert isinstance(request, protocol.PreviewEdit)
    answer = experiment_editor.attempt(POOL, request.edit)
    assert not answer["ok"] or (key, value) in {("depth_m", 0.0), ("lap_s", 1e9)}
    assert answer["ok"] or answer["problems"]


@pytest.mark.parametrize(
    "text",
    [
        "",
        "[]",
        "{}",
        '{"kind":"nonsense"}',
        '{"kind":"order","n":1,"order":"explode"}',
        '{"kind":"order","n":-1,"order":"stop"}',
        '{"kind":"try","n":1,"edit":{"points_m":[[0,0],[1e9,0]]}}',
        '{"kind":"try","n":1,"edit":{"scale":NaN}}',
        '{"kind":"save","n":1,"edit":{},"name":"../../etc/passwd"}',
        '{"kind":"save","n":1,"edit":{},"name":"ok\\n"}',
        '{"kind":"hello","token":"' + "x" * 300 + '"}',
        '{"kind":"ack","n":1}' + " " * protocol.LONGEST_BYTES,
        "[" * 60_000,
    ],
)
def test_text_that_is_no_request_is_refused(text: str) -> None:
    with pytest.raises(protocol.BadRequest):
        protocol.read_request(text)


@pytest.mark.long
@given(st.binary(max_size=300) | st.text(max_size=300))
def test_no_text_does_harm(text: str | bytes) -> None:
    with contextlib.suppress(protocol.BadRequest):
        protocol.read_request(text)


# --- alarms


def _view(battery_v: float = 12.0, **changes: Any) -> RobotView:
    state: dict[str, Any] = {"mode": Mode.TRACKING, "track": Track.MARKER, "timing": StepTiming(board_age_ms=20.0)}
    state |= {"experiment_hash": POOL.hash, "board": BoardReading(5, battery_v=battery_v), **changes}
    pose = Pose(0.0, 0.0, 0.0, track=Track.MARKER, identity_verified=True)
    return RobotView(RobotState(**state), 0.05, pose, 0.05)


def _texts(*views: RobotView, camera: CameraHealth = CameraHealth.OK, age_s: float = 0.0, recorder: str = "") -> list[str]:
    alarm_list = alarms(POOL, dict(zip((1, 2), views, strict=True)), LocalizerStatus(camera), age_s, recorder)
    return [f"{a.level} {a.line}" for a in alarm_list]


def test_a_well_fleet_raises_no_alarm() -> None:
    assert _texts(_view(), _view()) == []


def test_each_trouble_is_named_and_the_worst_comes_first() -> None:
    texts = _texts(_view(fault="pose late", battery_v=10.7), _view(mode=Mode.FAULT, fault="no pose"), recorder="no space")
    assert texts[0].startswith("critical the log")
    assert texts[1] == "critical robot 2: fault: no pose"
    assert "warning robot 1: pose late" in texts and "warning robot 1: battery 10.7 V" in texts
    assert _texts(_view(), _view(), camera=CameraHealth.FROZEN) == ["critical the camera is frozen"]
    assert _texts(_view(), _view(), age_s=1.0) == ["critical the localizer is silent"]
    assert _texts(RobotView(), _view()) == ["warning robot 1: not heard"]


def test_a_localizer_is_missed_only_where_poses_are() -> None:
    def texts(*views: RobotView) -> list[str]:
        return [a.text for a in alarms(POOL, dict(zip((1, 2), views, strict=True)), None, math.inf, "")]

    assert texts(_view(), _view()) == []
    blind = RobotView(_view().state, 0.05)
    assert "no localizer has been heard" in texts(blind, blind)


def test_a_bad_link_a_wrong_clock_and_an_old_plan_are_alarms_in_flight_too() -> None:
    view = replace(_view(), loss=0.5, clock_offset_s=-0.1, plan_age_s=2.0)
    keys = {(a.key, a.level, a.robot) for a in alarms(POOL, {1: _view(), 2: view}, LocalizerStatus(CameraHealth.OK), 0.0, "")}
    assert keys == {("2:link", "warning", 2), ("2:clock", "notice", 2), ("2:plan", "warning", 2)}


def test_trouble_of_one_of_several_cameras_is_a_warning_in_its_own_words() -> None:
    several, why = load_experiment("two-cameras"), "camera west is out: camera black"
    status = LocalizerStatus(CameraHealth.OK, message=why, out=("west",))
    views = {robot: replace(_view(), state=None) for robot in several.robot_ids}
    camera_alarms = [(a.key, a.level, a.text) for a in alarms(several, views, status, 0.0, "") if not a.robot]
    assert camera_alarms == [("cameras", "warning", why)]


def test_a_station_whose_cycle_hangs_is_an_alarm() -> None:
    alarm_list = alarms(POOL, {1: _view(), 2: _view()}, LocalizerStatus(CameraHealth.OK), 0.0, "", stuck_s=3.0)
    assert [(a.level, a.text) for a in alarm_list] == [("critical", "the station has sent no heartbeat for 3 s: robots hold")]


# --- where the picture lies


@pytest.mark.parametrize("rotation", [(0.0, 0.0, 0.0), (0.05, -0.08, 0.4)])
def test_the_picture_lies_where_the_camera_sees_it(rotation: tuple[float, float, float]) -> None:
    """Against the simulator's own optics, which another hand wrote with OpenCV."""
    camera = POOL.camera.model_copy(update={"rotation_rad": rotation})
    points = np.random.default_rng(1).uniform([-1.7, -1.2, 0.0], [1.7, 1.2, 0.9], (200, 3))
    np.testing.assert_allclose(project(camera, points), optics.project(camera, points), atol=1e-6)


def test_the_mesh_covers_the_basin() -> None:
    points, places = mesh(POOL, POOL.camera)
    walls = np.array(POOL.pool.size_m[:2]) / 2
    assert np.all(points.reshape(-1, 2).max(axis=0) >= walls) and np.all(points.reshape(-1, 2).min(axis=0) <= -walls)
    middle = places.reshape(-1, 2)[np.argmin(np.linalg.norm(points.reshape(-1, 2), axis=1))]
    np.testing.assert_allclose(middle, [0.5, 0.5], atol=0.05)


@given(st.floats(1e-6, 1.0), st.floats(1e-6, 1.0), st.floats(-math.pi / 2 + 0.01, math.pi / 2 - 0.01))
def test_the_ellipse_is_that_of_the_covariance(a: float, b: float, angle: float) -> None:
    major, minor = max(a, b), min(a, b)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    covariance = np.zeros((3, 3))
    covariance[:2, :2] = turn @ np.diag([major**2, minor**2]) @ turn.T
    found_major, found_minor, found_angle = ellipse(covariance)
    back = np.array([[np.cos(found_angle), -np.sin(found_angle)], [np.sin(found_angle), np.cos(found_angle)]])
    np.testing.assert_allclose(back @ np.diag([found_major**2, found_minor**2]) @ back.T, covariance[:2, :2], atol=1e-7)


# --- the editor asks the real planner


def value(tried: dict[str, Any], what: str) -> float:
    """A figure of a plan, the worst of all robots."""
    return next(float(figure["value"]) for figure in tried["figures"] if figure["what"] == what)


def test_an_edit_that_changes_nothing_gives_the_flown_paths() -> None:
    tried = experiment_editor.attempt(POOL, protocol.Edit())
    assert tried["ok"]
    eta = np.frombuffer(tried["paths"][0]["eta"], "<f4").reshape(-1, 4)
    flown = planner.plan(POOL)[1].eta
    step = round(tried["paths"][0]["every_s"] / POOL.controller.period_s)
    np.testing.assert_allclose(eta, flown[:2401:step], atol=1e-5)
    assert value(tried, "between centres") == pytest.approx(0.8, abs=1e-6)
    assert value(tried, "speed") == pytest.approx(0.45 / 2 * 2 * np.pi / 100, rel=1e-6)


def test_an_edited_experiment_no_longer_has_the_title_of_what_it_was() -> None:
    once = experiment_editor.edited(POOL, protocol.Edit(diameter_m=0.6))
    assert once.title == f"{POOL.title}, edited"
    assert POOL.article and not once.article, "no report puts a paper's figures beside those of another path"
    assert experiment_editor.edited(once, protocol.Edit(diameter_m=0.7)).title == once.title, "said once"
    assert experiment_editor.edited(POOL, protocol.Edit()).title == POOL.title


def test_an_edit_that_cannot_be_flown_says_why_and_still_shows_the_path() -> None:
    tried = experiment_editor.attempt(POOL, protocol.Edit(nodes_m={1: (0.1, 0.0, 0.0)}))
    assert not tried["ok"]
    assert "robots 1 and 2: 0.500 m apart" in tried["problems"][0]
    assert value(tried, "between centres") == pytest.approx(0.5, abs=1e-6)
    assert {path["robot"] for path in tried["paths"]} == {1, 2}
    beyond = experiment_editor.attempt(POOL, protocol.Edit(diameter_m=4.0))
    assert any("wall" in problem for problem in beyond["problems"])


def test_an_edit_of_another_kind_of_path_is_refused_by_key() -> None:
    assert "path.points_m" in experiment_editor.attempt(POOL, protocol.Edit(points_m=[(0.0, 0.0), (1.0, 0.0)]))["problems"][0]
    assert "robot 7" in experiment_editor.attempt(POOL, protocol.Edit(nodes_m={7: (0.0, 0.0, 0.0)}))["problems"][0]
    assert experiment_editor.attempt(STRAIGHT, protocol.Edit(scale=-1.0))["ok"] is False


def test_only_a_changed_file_of_an_experiment_is_read_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    file = tmp_path / "experiments" / "mine.toml"
    file.parent.mkdir()

    def loadable(ids: str, stamp_ns: int) -> bool:
        file.write_text("".join(f"[[robots]]\nid = {robot}\n" for robot in ids))
        os.utime(file, ns=(stamp_ns, stamp_ns))
        return "experiments/mine.toml" in experiment_editor.loadable((4, 5))

    assert loadable("45", 10**9) and not loadable("46", 2 * 10**9)
    assert loadable("45", 3 * 10**9) and loadable("46", 3 * 10**9)  # a file that looks the same is not opened


@pytest.mark.parametrize("ids", [("", ""), ("id = 4", 'id = "five"'), ("id = [4]", "id = 5"), ("id = 5", "id = 5")])
def test_a_half_written_experiment_is_none_to_load(
    ids: tuple[str, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each page is told the list when it connects: an error there would keep every page out."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "experiments").mkdir()
    (tmp_path / "experiments" / "half.toml").write_text("".join(f"[[robots]]\n{line}\n" for line in ids))
    assert experiment_editor.loadable((4, 5)) == []


def test_an_edit_is_kept_under_a_new_name_only(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    edit = protocol.Edit(diameter_m=0.5)
    assert experiment_editor.save(POOL, edit, "wider") == {"ok": True, "problems": [], "path": "experiments/wider.toml"}
    again = load_experiment("experiments/wider.toml")
    assert (again.name, again.path.model_dump()["diameter_m"], again.robots) == ("wider", 0.5, POOL.robots)
    assert "already" in experiment_editor.save(POOL, edit, "wider")["problems"][0]
    assert not experiment_editor.save(POOL, protocol.Edit(diameter_m=4.0), "wrong")["ok"]
    assert [p.name for p in (tmp_path / "experiments").iterdir()] == ["wider.toml"]


def test_a_warning_of_the_station_is_an_alarm() -> None:
    views = {robot: RobotView() for robot in (1, 2)}
    texts = [[a.text for a in alarms(POOL, views, None, math.inf, "", lasting)] for lasting in ({}, {"insecure": INSECURE})]
    assert set(texts[1]) - set(texts[0]) == {INSECURE}


def test_robots_are_taken_in_and_out_with_their_neighbours() -> None:
    four = experiment_editor.edited(POOL, protocol.Edit(robots=[1, 2, 5, 7], shape="diamond", spacing_m=0.9))
    assert {robot.id: robot.neighbours for robot in four.robots} == {1: (2,), 2: (1, 5), 5: (2, 7), 7: (5,)}
    apart = [math.dist(a.node_m, b.node_m) for a, b in combinations(four.robots, 2)]
    assert min(apart) == pytest.approx(0.9)
    alone = experiment_editor.edited(four, protocol.Edit(robots=[2], nodes_m={2: (0.1, 0.2, 0.0)}))
    assert [(robot.id, robot.node_m, robot.neighbours) for robot in alone.robots] == [(2, (0.1, 0.2, 0.0), ())]
    assert alone.article == (), "the paper flew other fleets"
    assert alone.formation.shape is None  # nobody stands where the shape would have it


def test_another_path_pool_and_islands_are_judged_and_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    wide = load_experiment("pool", ["camera.position_m=[0,0,-9]"])  # sees the larger pool
    edit = protocol.Edit(
        kind="route", points_m=[(-1.5, -1.0), (1.5, 1.0)], speed_mps=0.1, depth_m=0.4, pool_m=(6.0, 5.0, 1.2),
        islands_m=[(0.0, 0.0, 0.2)], shape="column", spacing_m=0.9, duration_s=60.0,
    )  # fmt: skip
    assert experiment_editor.attempt(wide, edit)["problems"] == []
    assert experiment_editor.save(wide, edit, "around")["ok"]
    text = (tmp_path / "experiments" / "around.toml").read_text()
    assert 'shape = "column"  # Shape for robots without a node_m, in the file\'s order.' in text
    assert "position_m = [0.0, 0.0]  # Centre, x and y." in text
    saved = load_experiment(str(tmp_path / "experiments" / "around.toml"))
    assert saved.hash == experiment_editor.edited(wide, edit).model_copy(update={"name": "around", "title": saved.title}).hash
    in_the_way = experiment_editor.attempt(wide, protocol.Edit(islands_m=[(0.0, 0.225, 0.2)]))
    assert not in_the_way["ok"]


def test_an_edit_to_waypoints_without_points_is_answered() -> None:
    tried = experiment_editor.attempt(POOL, protocol.Edit(kind="waypoints"))
    assert not tried["ok"] and any("points_m" in problem for problem in tried["problems"])


SQUARE = [(-0.6, -0.6), (0.6, -0.6), (0.6, 0.6), (-0.6, 0.6)]


@pytest.mark.parametrize("corner", ["smooth", "round", "stop"])
def test_laps_of_a_square_are_planned_and_drawn_with_the_corners_of_the_edit(corner: Any) -> None:
    edit = protocol.Edit(kind="waypoints", points_m=SQUARE, speed_mps=0.1, depth_m=0.3, laps=2, corner=corner, duration_s=80.0)
    tried = experiment_editor.attempt(POOL, edit)
    assert tried["ok"], tried["problems"]
    eta = np.mean([np.frombuffer(path["eta"], "<f4").reshape(-1, 4) for path in tried["paths"]], axis=0)
    beyond_m = np.abs(eta[:, :2]).max() - 0.6
    assert beyond_m > 0.1 if corner == "smooth" else abs(beyond_m) < 1e-3
    assert {figure["what"] for figure in tried["figures"]} > {"between centres", "hulls to walls and islands", "thrust"}


def test_a_path_that_ends_before_the_run_is_drawn_to_its_end() -> None:
    edit = protocol.Edit(kind="waypoints", points_m=SQUARE, speed_mps=0.1, depth_m=0.3, corner="round", duration_s=90.0)
    tried = experiment_editor.attempt(POOL, edit)
    assert not tried["ok"] and "the path ends after" in tried["problems"][0]
    assert tried["duration_s"] < 40.0 and tried["paths"]


def test_every_label_of_a_gain_names_one_and_every_gain_has_a_label() -> None:
    """The page's table against what each control law lets people change."""
    laws = [load_experiment("pool", [f"controller.law={law}"]).controller for law in ("nmpc", "eso-mpc-article", "pid")]
    knobs = [knob.key for controller in laws for knob in tunable_parameters(controller)]
    source = (Path(protocol.__file__).parent / "page/src/panels/Tuning.tsx").read_text(encoding="utf-8")
    labels = re.findall(r'^  "([\w.]+)": \["', source, re.MULTILINE)
    assert sorted(labels) == sorted({re.sub(r"^controller\.|\.\d+$", "", key) for key in knobs})


def test_another_path_that_can_be_flown_shows_no_figure_beyond_what_is_allowed() -> None:
    """The figures are those of the path that a person has chosen, on which robots give way, not of the path being flown."""
    run = load_experiment("pool")

    def plan(order: CommandKind, text: str) -> PlanSegment:
        trajectories = planner.plan(with_flight(run, text))
        return PlanSegment(trajectories, trajectories[1], end_s=50.0)

    drafted = experiment_editor.drafted(run, CommandKind.PATH, "swap", plan)
    assert drafted["ok"]
    apart = next(figure for figure in drafted["figures"] if figure["what"].startswith("between centres"))
    assert apart["value"] >= apart["limit"]
