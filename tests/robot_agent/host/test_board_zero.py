"""A board and its computer that restart together: where the board took its depth zero, and who confirms it."""

import math
import os
from pathlib import Path

import pytest

from robot_agent.host import board_zero, zero_request
from robot_agent.host.board_zero import FILE, MS_WRAPS, BoardZero, read_record
from robot_agent.node import AgentNode, StepTime
from robot_agent.safety.health import RESTART_DEPTH_M
from shoal.bus.bus import Bus
from shoal.bus.memory_transport import MemoryHub, MemoryTransport
from shoal.config.experiment import load_experiment
from shoal.mavlink.agent_link import Telemetry
from shoal.runtime.runtime import Stop
from tests.robot_agent.host.silent_board import Switched

CONFIRM = "confirm that on the robot with `robot-agent confirm-zero`"


def refusals(folder: Path, boot: str, zero_m: float, monkeypatch: pytest.MonkeyPatch, steps: int = 3) -> list[str]:
    """Reasons of one life of a robot's program and its board against arming, after each step. With more than 3 steps a person
    confirms the zero after the first."""
    monkeypatch.setenv("STATE_DIRECTORY", str(folder))
    monkeypatch.setattr(board_zero, "boot_id", lambda: boot)
    monkeypatch.setattr(board_zero, "LOOK_S", 0.0)
    monkeypatch.setattr(zero_request, "LOOK_S", 0.0)
    bus, reasons = Bus(MemoryTransport(MemoryHub())), []
    node = AgentNode(load_experiment("pool"), 1, bus, Switched(zero_m), Stop(install=False))
    for step in range(steps):
        now_ns = (step + 1) * 50_000_000
        node.step(now_ns, StepTime(now_ns))
        inputs = node.agent.inputs
        station = inputs.station.__class__(7, now_ns, 0.03)
        reasons.append(node.agent._health.arming_refusal(inputs, station, now_ns))  # what ARM is answered, without a station
        if step == 0 and steps > 3:
            zero_request.write_request(folder / zero_request.FILE, in_air=False)
    return reasons


def test_a_board_and_its_computer_that_restart_under_water_do_not_arm_until_a_person_confirms(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In water at 0.3 m: the board says so, and after both have restarted that it is at the surface."""
    assert not any(CONFIRM in why for why in refusals(tmp_path, "first", 0.0, monkeypatch))
    again = refusals(tmp_path, "second", 0.3, monkeypatch)
    assert all("restarted at 0.30 m" in why and CONFIRM in why for why in again), again
    record = read_record(tmp_path)
    assert record is not None
    assert record.zero_m == pytest.approx(0.3, abs=0.01)
    assert record.depth_m == pytest.approx(0.3, abs=0.01), "counted from the surface"
    confirmed = refusals(tmp_path, "second", 0.3, monkeypatch, steps=7)
    assert CONFIRM in confirmed[0], "a restart of the program alone confirms nothing"
    assert not any(CONFIRM in why for why in confirmed[4:])
    assert not (tmp_path / zero_request.FILE).exists()
    assert not any(CONFIRM in why for why in refusals(tmp_path, "third", 0.3, monkeypatch)), "nor does it come back"


def test_a_robot_that_loses_its_power_just_after_it_has_dived_does_not_arm(tmp_path: Path) -> None:
    """A wave had moved it at the surface a moment before: no file says any more that it was there."""
    now_s = 0.0
    program = BoardZero(tmp_path, "first", lambda: now_s)
    for depth_m in [-0.02] * 20 + [0.035, -0.02, 0.2, 0.4, 0.6]:
        now_s += 1.0
        program.note(Telemetry(board_ms=round(now_s * 1e3), depth_m=depth_m))
    zero_m = BoardZero(tmp_path, "second", lambda: 20.0).note(Telemetry(board_ms=5000, depth_m=0.0))
    assert zero_m is not None and zero_m > RESTART_DEPTH_M


def life(folder: Path, boot: str, at_s: float, on_for_s: float, depth_m: float) -> float | None:
    telemetry = Telemetry(board_ms=round(1e3 * on_for_s) % MS_WRAPS, depth_m=depth_m)
    return BoardZero(folder, boot, lambda: at_s).note(telemetry)


@pytest.mark.parametrize(
    ("boot", "at_s", "on_for_s", "zero_m"),
    [
        ("one", 1000.0, 900.0, None),  # the same life: switched on at 100 s
        ("one", 5000.0, 4930.0, None),  # its clock is wrong by 1 %
        ("one", 1000.0, 30.0, 0.8),  # the board alone, while no program ran
        ("two", 40.0, 38.0, 0.8),  # both
        ("two", 40.0, 900.0, None),  # the computer alone
        ("one", 1000.0 + MS_WRAPS * 1e-3, 900.0 + MS_WRAPS * 1e-3, None),  # 49.7 days
        ("one", 1000.0, 887.01, None),  # 13 s: a burst's wait and 800 s of drift
        ("one", 1000.0, 886.9, 0.8),
        ("one", 1000.0, 912.99, None),
        ("one", 1000.0, 913.1, 0.8),
        ("two", 40.0, 45.5, None),
        ("two", 40.0, 45.3, 0.8),
    ],
)
def test_the_zero_is_in_doubt_where_the_board_alone_or_both_were_switched_on_again(
    boot: str, at_s: float, on_for_s: float, zero_m: float | None, tmp_path: Path
) -> None:
    assert life(tmp_path, "one", 200.0, 100.0, 0.8) is None
    assert life(tmp_path, boot, at_s, on_for_s, 0.0) == zero_m


def test_a_robot_that_was_in_air_and_a_folder_without_a_file_raise_no_doubt(tmp_path: Path) -> None:
    assert life(tmp_path, "one", 200.0, 100.0, 0.01) is None
    zero_m = life(tmp_path, "two", 40.0, 38.0, 0.0)
    assert zero_m is None or abs(zero_m) < RESTART_DEPTH_M
    assert BoardZero(None).note(Telemetry(board_ms=5)) is None
    assert life(tmp_path / "gone", "one", 40.0, 38.0, math.pi) is None


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"boot": "one", "at_s": 1e999}', '{"boot": 1, "at_s": "x"}', None])
def test_with_a_file_that_cannot_be_read_a_robot_does_not_arm_until_a_person_confirms(
    text: str | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The loss of power has cut it: the robot may be in the water."""
    file = tmp_path / FILE
    if text is None:
        file.mkdir()  # as good as a disk that fails
    else:
        file.write_text(text)
    doubt = "depth zero is in question"
    for boot in ("second", "third"):  # a program that is started again has nothing confirmed
        assert all(doubt in why for why in refusals(tmp_path, boot, 0.3, monkeypatch))
    if text is None:
        file.rmdir()
        file.write_text("")
    confirmed = refusals(tmp_path, "third", 0.3, monkeypatch, steps=7)
    assert doubt in confirmed[0] and not any(doubt in why for why in confirmed[4:])
    record = read_record(tmp_path)
    assert record is not None and record.zero_m == 0.0
    assert not any(doubt in why for why in refusals(tmp_path, "third", 0.3, monkeypatch))


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can give a file to another user")
def test_the_service_can_read_what_root_writes_into_its_folder(tmp_path: Path) -> None:
    """A cautious user's umask goes with sudo."""
    os.chown(tmp_path, 12345, 12346)
    before = os.umask(0o077)
    try:
        zero_request.write_request(tmp_path / zero_request.FILE, in_air=False)
        board_zero.write_record(tmp_path, board_zero.ZeroRecord("one", 1.0, 0.5, 0.0, 0.3), durable=False)
    finally:
        os.umask(before)
    for name in (zero_request.FILE, FILE):
        file = (tmp_path / name).stat()
        assert (file.st_uid, file.st_gid, file.st_mode & 0o777) == (12345, 12346, 0o600)


def test_the_file_follows_the_depth_in_steps_and_not_too_often(tmp_path: Path) -> None:
    now = [1000.0]
    zero = BoardZero(tmp_path, "one", lambda: now[0])

    def kept_m(at_s: float, depth_m: float, restarted: bool = False) -> float | None:
        now[0] = 1000.0 + at_s
        zero.note(Telemetry(board_ms=round(1e3 * (500.0 + at_s)), depth_m=depth_m, restarted=restarted))
        record = read_record(tmp_path)
        return record.depth_m if record is not None else None

    assert kept_m(0.0, 1.0, restarted=True) is None, "a board that says how its life began"
    assert kept_m(0.0, 1.0) == 1.0
    assert [kept_m(at_s, 2.0) for at_s in (5.0, 8.9, 10.0)] == [1.0, 1.0, 2.0]
    assert [kept_m(at_s, depth_m) for at_s, depth_m in ((30.0, 2.04), (40.0, 1.96), (50.0, 2.06))] == [2.0, 2.0, 2.06]
    (tmp_path / FILE).unlink()
    assert kept_m(70.0, 3.0) == 3.0
    assert [kept_m(at_s, 4.0) for at_s in (81.0, 81.5)] == [4.0, 4.0]
    assert [kept_m(at_s, 9.0) for at_s in (91.9, 92.9)] == [9.0, 9.0]


def test_the_board_is_looked_at_once_a_second_and_not_before_it_has_said_a_word(tmp_path: Path) -> None:
    now = [1000.0]
    zero = BoardZero(tmp_path, "one", lambda: now[0])
    assert zero.note(Telemetry(board_ms=-1, depth_m=1.0)) is None and read_record(tmp_path) is None
    for at_s, depth_m, kept_m in ((0.0, 1.0, 1.0), (0.99, 2.0, 1.0), (10.0, 3.0, 3.0), (10.9, 4.0, 3.0)):
        now[0] = 1000.0 + at_s
        zero.note(Telemetry(board_ms=round(5e5 + 1e3 * at_s), depth_m=depth_m))
        record = read_record(tmp_path)
        assert record is not None and record.depth_m == kept_m


def test_a_folder_that_cannot_be_written_is_told_once(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    now = [1000.0]
    zero = BoardZero(tmp_path / "gone", "one", lambda: now[0])
    for turn in range(5):
        now[0] += 20.0
        zero.note(Telemetry(board_ms=20_000 * (turn + 1), depth_m=float(turn)))
    assert [record.message.partition(":")[0] for record in caplog.records] == ["the robot's depth cannot be kept"]


def test_a_zero_that_is_taken_over_is_said_where_it_matters(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    for depth_m, is_logged in ((0.049, False), (0.051, True)):
        caplog.clear()
        assert life(tmp_path, "one", 200.0, 100.0, depth_m) is None
        assert life(tmp_path, "two", 40.0, 38.0, 0.0) == depth_m
        assert ("the robot's last known depth" in caplog.text) is is_logged
        (tmp_path / FILE).unlink()
