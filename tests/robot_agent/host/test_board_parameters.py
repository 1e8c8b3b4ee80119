"""A robot does not arm before its board's parameters are known, from the first burst on and after each silence."""

from robot_agent.node import AgentNode, StepTime
from shoal.bus.bus import Bus
from shoal.bus.memory_transport import MemoryHub, MemoryTransport
from shoal.runtime.runtime import Stop
from sim_bridge.thruster_board.sensor_zero import BoardStart
from tests.robot_agent.host.restarted_board import POOL, STEP_NS, STILL, RestartedBoard

SECOND = 1_000_000_000 // STEP_NS  # steps


class Listening:
    """A robot's program beside a board in air that has been on for a while. Time is that of the steps."""

    def __init__(self) -> None:
        self.board = RestartedBoard(BoardStart(), STILL)
        for _ in range(SECOND + 1):  # it has just sent a HEARTBEAT: the next comes in a second
            self.board.read()
        self.node = AgentNode(POOL, 1, Bus(MemoryTransport(MemoryHub())), self.board, Stop(install=False))
        self._now_ns = 0

    def step(self) -> None:
        self._now_ns += STEP_NS
        self.node.step(self._now_ns, StepTime(self._now_ns))

    def be_silent(self, seconds: float) -> None:
        self._now_ns += round(seconds * 1e9)

    @property
    def refusal(self) -> str:
        inputs, now_ns = self.node.agent.inputs, self._now_ns
        return self.node.agent._health.arming_refusal(  # the agent says it only to a command
            inputs, inputs.station.__class__(7, now_ns, 0.03), now_ns
        )


def test_a_board_that_has_not_said_what_it_is_does_not_arm() -> None:
    """Its bursts and its battery are heard before its HEARTBEAT, after which it is asked for its parameters."""
    robot, before = Listening(), 0
    while not robot.node.mavlink.telemetry.heartbeats:
        robot.step()
        before += 1
        assert "parameters are not known yet: none so far" in robot.refusal
    assert before > SECOND // 2 and robot.node.mavlink.telemetry.battery_reports > 0
    for _ in range(4 * SECOND):
        robot.step()
    assert "parameters" not in robot.refusal


def test_a_board_that_was_silent_is_asked_again() -> None:
    """Another one may have been plugged in meanwhile, that has been on for longer; or somebody has set a parameter."""
    robot = Listening()
    for _ in range(5 * SECOND):
        robot.step()
    assert "parameters" not in robot.refusal
    robot.be_silent(2.0)
    robot.board.board.rules.change("SLEW_US_S", 30000.0)
    robot.step()
    assert "parameters are not known yet" in robot.refusal
    for _ in range(4 * SECOND):
        robot.step()
    assert "SLEW_US_S is 30000 (experiment: 8000)" in robot.refusal
