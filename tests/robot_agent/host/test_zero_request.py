"""A person confirms a board's depth zero: through the robot's program, or over the link while none runs."""

import os
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from typer.testing import CliRunner

from robot_agent.__main__ import cli
from robot_agent.host import board_zero, zero_request
from robot_agent.host.board_zero import boot_id, boot_time_s
from robot_agent.host.zero_request import ZeroRequests, write_request
from robot_agent.node import AgentNode, StepTime
from shoal.bus.bus import Bus
from shoal.bus.memory_transport import MemoryHub, MemoryTransport
from shoal.errors import ConfigError
from shoal.mavlink.agent_link import AgentLink, Telemetry
from shoal.runtime.runtime import Stop
from tests.robot_agent.autopilot import Autopilot
from tests.robot_agent.host.restarted_board import POOL, STEP_NS, RestartedBoard
from tests.robot_agent.host.silent_board import Switched


@pytest.fixture
def agent_toml(tmp_path: Path) -> Path:
    path = tmp_path / "agent.toml"
    path.write_text('robot = 1\nexperiment = "pool"\nstation = "tcp/127.0.0.1:9"\nlink = "udp:127.0.0.1:9"\n')
    return path


@pytest.fixture
def stepping(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[AgentNode]:
    """A robot's program, which is stepped in a thread, with a folder for its state."""
    (tmp_path / "state").mkdir()
    monkeypatch.setenv("STATE_DIRECTORY", str(tmp_path / "state"))
    monkeypatch.setattr(zero_request, "LOOK_S", 0.02)
    node = AgentNode(POOL, 1, Bus(MemoryTransport(MemoryHub())), RestartedBoard(), Stop(install=False))
    ended = threading.Event()

    def steps() -> None:
        now_ns = 0
        while not ended.wait(0.01):
            now_ns += STEP_NS
            node.step(now_ns, StepTime(now_ns))

    for count in range(1, 21):  # until the board has measured the pressure, and said so
        node.step(count * STEP_NS, StepTime(count * STEP_NS))
    thread = threading.Thread(target=steps, daemon=True)
    thread.start()
    yield node
    ended.set()
    thread.join()


def refusal(node: AgentNode) -> str:
    inputs = node.agent.inputs
    now_ns = inputs.board.arrival_ns
    return node.agent._health.arming_refusal(  # the agent says it only in its state, once a step
        inputs, inputs.station.__class__(7, now_ns, 0.03), now_ns
    )


def confirm(config: Path, state: Path, *options: str) -> str:
    done = CliRunner().invoke(cli, ["confirm-zero", "--config", str(config), "--state", str(state), *options])
    assert done.exit_code == 0, done.output
    return done.output


@pytest.mark.parametrize(("options", "depth_m"), [((), 0.5), (("--in-air",), 0.0)])
def test_the_robots_program_does_not_arm_in_question_and_passes_the_confirmation_on(
    stepping: AgentNode, agent_toml: Path, tmp_path: Path, options: tuple[str, ...], depth_m: float
) -> None:
    assert "in question" in refusal(stepping)
    confirm(agent_toml, tmp_path / "state", *options)
    for _ in range(40):
        if "in question" not in refusal(stepping):
            break
        threading.Event().wait(0.1)
    assert "in question" not in refusal(stepping)
    assert stepping.agent.inputs.board.depth_m == pytest.approx(depth_m, abs=0.05)
    assert stepping.mavlink.telemetry.restarted
    assert not (tmp_path / "state" / zero_request.FILE).exists()


def refused(config: Path, state: Path) -> str:
    done = CliRunner().invoke(cli, ["confirm-zero", "--config", str(config), "--state", str(state)])
    assert isinstance(done.exception, ConfigError), done.output
    assert not (state / zero_request.FILE).exists()
    return str(done.exception)


def test_the_reason_of_a_refusal_is_told(stepping: AgentNode, agent_toml: Path, tmp_path: Path) -> None:
    """And not that another program has the board's port, as the command would find itself."""
    assert isinstance(stepping.link, RestartedBoard)
    stepping.link.board.zero.surface_hpa = None  # as of a board that was never switched on in air
    assert "no depth zero is kept: take it in air" in refused(agent_toml, tmp_path / "state")
    assert "in question" in refusal(stepping)


def test_of_two_people_at_once_one_is_told_to_wait(agent_toml: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """No program runs. The end of the first one's wait is no answer to the second one."""
    monkeypatch.setattr(zero_request, "WITHIN_S", 0.5)
    state = tmp_path / "state"
    state.mkdir()
    first: list[str] = []
    asking = threading.Thread(target=lambda: first.append(refused(agent_toml, state)))
    asking.start()
    while not (state / zero_request.FILE).exists():
        threading.Event().wait(0.01)
    second = CliRunner().invoke(cli, ["confirm-zero", "--config", str(agent_toml), "--state", str(state), "--in-air"])
    assert "another confirm-zero is under way" in str(second.exception)
    asking.join()
    assert "udp:127.0.0.1:9" in first[0]  # nobody answers there either


@pytest.mark.parametrize("has_power", [False, True])
def test_no_request_goes_to_an_autopilot_nor_to_a_robot_with_power(tmp_path: Path, has_power: bool) -> None:
    link, there = AgentLink(1), Autopilot()
    there.send(link.heartbeat())
    link.receive(there.read(), 0)
    write_request(tmp_path / zero_request.FILE, in_air=True)
    time.sleep(0.01)  # its time is rounded
    assert ZeroRequests(tmp_path).step(link, has_power) == b""
    answer = (tmp_path / zero_request.FILE).read_text(encoding="ascii")
    assert answer.startswith("refused the robot has power" if has_power else "refused autopilot 3")


@pytest.mark.parametrize(
    "left",
    [
        "air",
        "air another-boot {now:.3f}",
        "air {boot} {old:.3f}",
        "air {boot} {later:.3f}",
        "air {boot} nan",
        "water {boot} {now:.3f}",
    ],
)
def test_a_request_that_a_killed_command_has_left_reaches_no_board(stepping: AgentNode, tmp_path: Path, left: str) -> None:
    """The file's time is ahead of the wall clock's, as after a start without a network."""
    path, now_s = tmp_path / "state" / zero_request.FILE, boot_time_s()
    path.write_text(left.format(boot=boot_id(), now=now_s, old=now_s - 60.0, later=now_s + 60.0), encoding="ascii")
    os.utime(path, (time.time() + 3600.0, time.time() + 3600.0))
    threading.Event().wait(0.3)
    assert "in question" in refusal(stepping) and path.exists()
    path.write_text(f"air {boot_id()} {boot_time_s():.3f}", encoding="ascii")
    for _ in range(40):
        if not path.exists():
            break
        threading.Event().wait(0.1)
    assert not path.exists()


def test_without_a_program_the_command_tells_the_board_itself(
    agent_toml: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    wires = RestartedBoard()
    while wires.board.zero.status & 0x200 and wires.now_ns < 20 * STEP_NS:
        wires.read()
    assert wires.board.zero.is_in_question
    monkeypatch.setattr(zero_request, "WITHIN_S", 1.0)
    monkeypatch.setattr(zero_request, "LOOK_S", 0.02)
    monkeypatch.setattr(zero_request, "open_board_link", lambda config: (wires, None))
    (tmp_path / "state").mkdir()  # of a service that does not run
    confirm(agent_toml, tmp_path / "state")
    assert not wires.board.zero.is_in_question
    assert list((tmp_path / "state").iterdir()) == []


def test_a_zero_confirmed_without_a_program_is_in_doubt_again_once_the_board_restarts_under_water(
    agent_toml: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A board that reports no restarts, 0.3 m deep, with a right zero, and a file of before that says otherwise."""
    board_zero.write_record(tmp_path, board_zero.ZeroRecord("earlier", 100.0, 50.0, 0.8, 0.8), durable=False)
    monkeypatch.setattr(zero_request, "open_board_link", lambda config: (Switched(zero_m=0.0), None))
    monkeypatch.setattr(zero_request, "WITHIN_S", 1.0)
    confirm(agent_toml, tmp_path)
    record = board_zero.read_record(tmp_path)
    assert record is not None
    assert record.zero_m == 0.0 and record.depth_m == pytest.approx(0.3, abs=0.01)
    on_ms = round((boot_time_s() - record.board_on_s) * 1e3)
    same = board_zero.BoardZero(tmp_path).note(Telemetry(board_ms=on_ms, depth_m=0.3))
    assert same is None  # the zero that was confirmed
    restarted = board_zero.BoardZero(tmp_path, now_s=lambda: boot_time_s() + 60.0).note(Telemetry(board_ms=5000))
    assert restarted == pytest.approx(0.3, abs=0.01)


def test_a_zero_is_not_kept_with_a_depth_that_the_board_has_not_reported(
    agent_toml: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its pressure sensor is dead."""
    before = board_zero.ZeroRecord("earlier", 100.0, 50.0, 0.8, 0.8)
    board_zero.write_record(tmp_path, before, durable=False)
    board = Switched(zero_m=0.0)
    monkeypatch.setattr(type(board), "read", lambda self: self._link.heartbeat(False, True) + self._answers)
    monkeypatch.setattr(zero_request, "open_board_link", lambda config: (board, None))
    monkeypatch.setattr(zero_request, "WITHIN_S", 0.3)
    monkeypatch.setattr(zero_request, "LOOK_S", 0.02)
    done = CliRunner().invoke(cli, ["confirm-zero", "--config", str(agent_toml), "--state", str(tmp_path)])
    assert done.exit_code == 1 and "reports no depth" in f"{done.output}{done.exception}"
    assert board_zero.read_record(tmp_path) == before


def test_a_board_that_cannot_take_its_zero_anew_is_not_said_to_have_done_so(
    agent_toml: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It was switched on 0.25 m deep, so in air it reports -0.25 m: armed, the robot would fly that much too deep."""
    before = board_zero.ZeroRecord("earlier", 100.0, 50.0, 0.25, 0.25)
    board_zero.write_record(tmp_path, before, durable=False)
    monkeypatch.setattr(zero_request, "open_board_link", lambda config: (Switched(zero_m=0.25), None))
    monkeypatch.setattr(zero_request, "WITHIN_S", 1.0)
    done = CliRunner().invoke(cli, ["confirm-zero", "--config", str(agent_toml), "--state", str(tmp_path), "--in-air"])
    assert "restart it in air" in str(done.exception), done.output
    assert board_zero.read_record(tmp_path) == before

    link, board, now_s = AgentLink(1), Switched(zero_m=0.25), 0.0
    requests = ZeroRequests(tmp_path, lambda: now_s)
    link.set_zero(0.25)
    write_request(tmp_path / zero_request.FILE, in_air=True)
    for _ in range(4):  # the robot's program has the link
        time.sleep(0.01)  # the request's time is rounded
        now_s += zero_request.LOOK_S
        board.send(requests.step(link))
        link.receive(board.read(), round(now_s * 1e9))
    assert "restart it in air" in (tmp_path / zero_request.FILE).read_text(encoding="ascii")
    assert link.telemetry.power_on_depth_m >= 0.25
