"""Self-test of the thrusters in the water: a short push of each in turn, compared with the board's echo. Pure.

The echo is what the board sent to the speed controllers. So the test finds a board that does not obey, wrong limits, and
crossed channels. A person sees whether a propeller turns, and which way; in flight it shows in the estimated disturbance.
"""

from collections.abc import Sequence

import numpy as np

from shoal.config.vehicle import Vehicle

PUSH_N = 0.15  # 5 % of what a thruster can: seen and heard, and the robot moves a centimetre
PUSH_S, REST_S = 0.5, 0.25
SETTLED_S = 0.25  # after a pulse begins: the echo is a burst old, and boards limit the rate
TOLERANCE_US = 5
NS = 1_000_000_000


class ThrusterSelftest:
    """One test, from the instant at which the board is armed."""

    def __init__(self, vehicle: Vehicle, neutral_us: Sequence[int]) -> None:
        self.result = "running"
        self._neutral_us, self._thrusters = tuple(neutral_us), vehicle.thruster_count
        self._push_us = push_pulse_us(vehicle, PUSH_N)
        self._begin_ns: int | None = None
        self._confirmed: set[int] = set()
        self._echo_us: dict[int, int] = {}

    def step(self, armed: bool, echo_us: Sequence[int], now_ns: int) -> tuple[int, ...]:
        """Return the pulses for now; neutral when the test is over."""
        if self._begin_ns is None and armed:
            self._begin_ns = now_ns
        if self._begin_ns is None or self.result != "running":
            return self._neutral_us
        turn, since_s = divmod((now_ns - self._begin_ns) / NS, PUSH_S + REST_S)
        thruster = int(turn)
        if thruster >= self._thrusters:
            self.result = self._verdict()
            return self._neutral_us
        if since_s >= PUSH_S:
            return self._neutral_us
        pulses_us = one_pushed(self._neutral_us, thruster, self._push_us)
        if since_s >= SETTLED_S and len(echo_us) >= self._thrusters:
            wild = self._wild(pulses_us, echo_us)
            if wild:  # it may run at full thrust: the sooner the board is disarmed the better
                self.result = wild
                return self._neutral_us
            self._echo_us[thruster] = echo_us[thruster]
            if all(abs(echo_us[k] - pulses_us[k]) <= TOLERANCE_US for k in range(self._thrusters)):
                self._confirmed.add(thruster)
        return pulses_us

    def _wild(self, asked_us: Sequence[int], echo_us: Sequence[int]) -> str:
        """Text about thrusters that turn though they should not, or faster than asked, or in reverse; empty if none does."""
        texts = []
        for k in range(self._thrusters):
            pulse, neutral, echo = asked_us[k], self._neutral_us[k], echo_us[k]
            least, most = min(pulse, neutral) - TOLERANCE_US, max(pulse, neutral) + TOLERANCE_US
            if not least <= echo <= most:
                texts.append(f"thruster {k + 1} was asked for {pulse} us, the board says {echo}")
        return "; ".join(texts)

    def _verdict(self) -> str:
        """The result of the test in words: "passed", or the thrusters whose echo was not the asked pulse."""
        wrong = [
            f"thruster {k + 1} was asked for {self._push_us} us, the board says {self._echo_us.get(k, 'nothing')}"
            for k in range(self._thrusters)
            if k not in self._confirmed
        ]
        return "; ".join(wrong) or "passed"


def push_pulse_us(vehicle: Vehicle, thrust_n: float) -> int:
    """Pulse width (us) of a thrust by the vehicle's nominal curve."""
    return round(float(vehicle.thruster.pulse_us(np.array(thrust_n))))


def one_pushed(neutral_us: Sequence[int], thruster: int, push_us: int) -> tuple[int, ...]:
    """Neutral pulses with one thruster (from 0) at `push_us`."""
    return (*neutral_us[:thruster], push_us, *neutral_us[thruster + 1 :])
