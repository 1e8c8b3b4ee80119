"""A robot's computer at an Arduino Mega in simavr, in the Mega's time."""

from shoal.mavlink.agent_link import IGNORED, AgentLink
from shoal.mavlink.signing import Key
from tests.firmware.mega import Mega

STEP_NS = 5_000_000


class Pilot:
    """A robot's computer at a Mega, in its time."""

    def __init__(self, mega: Mega, key: Key | None = None) -> None:
        self.mega, self.link, self.now_ns = mega, AgentLink(1, key, lambda: 100_000), 0
        self.bursts: set[int] = set()

    def run(self, seconds: float, *thrusters_us: int, ankle_us: int = IGNORED) -> None:
        """Let time pass, with overrides at 20 Hz if there are pulses."""
        steps, rest_ns = divmod(round(seconds * 1e9), STEP_NS)
        for count in range(steps):
            if thrusters_us and count % 10 == 0:
                self.send(self.link.pulses([*thrusters_us, *[ankle_us] * 4]))
            self.step()
        if rest_ns:
            self.step(rest_ns)

    def step(self, step_ns: int = STEP_NS) -> None:
        self.now_ns += step_ns
        self.take(self.mega.step(self.now_ns))

    def take(self, data: bytes) -> None:
        """Bytes of the board."""
        self.link.receive(data, self.now_ns)
        self.bursts.add(self.link.telemetry.board_ms)

    def send(self, frame: bytes) -> None:
        self.mega.receive(frame, self.now_ns)

    def arm(self) -> None:
        self.run(0.15, *[1500] * 4)
        self.send(self.link.arm(True))
        self.run(0.15, *[1500] * 4)
        assert self.link.telemetry.armed
