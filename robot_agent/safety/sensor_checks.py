"""Checks of the board's sensors against themselves, against gravity and against the camera. Pure.

A gyroscope that measures nothing, or too little, lets the heading oscillate without an alarm. A pressure sensor that repeats
itself lets the robot sink to the floor: the controller holds what it reports. So the turn by the gyroscope is compared with
the turn by the poses, and a value that is exactly the same for seconds is no measurement where there was noise before.
Gyroscope and accelerometer are one part: where gravity is not found below, the part is broken or mounted otherwise, and its
gyroscope measures the turn about another axis; or the robot lies on its side, and its thrust acts otherwise than planned.
"""

import math
from bisect import bisect_right
from collections.abc import Sequence

from shoal.frames import wrap
from shoal.mavlink.agent_link import STANDARD_GRAVITY_MPS2

NS = 1_000_000_000
KEPT = 64  # samples of the gyroscope: 1.3 s at 50 Hz, longer than poses are late
LONGEST_S = 0.5  # between two samples, or two poses; after a longer gap the comparison begins anew
LEAP_RADPS = 2.0  # from one sample to the next: 0.5 N m turn 0.12 kg m^2 by 0.2 rad/s faster in 50 ms; after it, too
LEAP_RAD = 0.5  # from one pose to the next: that is the camera's marker or track, no gyroscope
FORGETS_S = 10.0  # time constant: a lasting error of the rate shows as 10 s of it, a bias of 0.01 rad/s as 0.1 rad
APART_RAD = 0.35  # 0.035 rad/s for long, or a turn by 0.35 rad at once; poses are good to 0.01 rad
APART_S = 0.5  # that it has to last: ten poses; of headings that flip, every other one is right
NOISE_M = 1e-4  # the least noise of a pressure sensor; the shipped simulator's is 2 mm
NOISE_RADPS = 1e-4  # of a gyroscope, whose steps are 0.27 mrad/s; an MPU-6050 has 0.9
NOISE_MPS2 = 1e-3  # of an accelerometer, which the link rounds to 0.01; an MPU-6050 has 0.03
MOST_ERROR_MPS2 = 4.0  # of gravity: a robot that leans by 24 degrees; offset and scale of an MPU-6050 make 1
LEVEL_MPS2 = (0.0, 0.0, -STANDARD_GRAVITY_MPS2)  # of a robot at rest
GRAVITY_S = 1.0  # time constant; waves, and pushes by other robots, are shorter or below 1 m/s^2
NOISY = 0.2  # share of the samples that show noise: a reading that leaps once is none
NOISE_S = 2.0  # time constant of that share
STUCK_S = 3.0  # 60 samples at 20 Hz, exactly the same


class GyroscopeCheck:
    """Comparison of the turn by the gyroscope with the turn by the poses."""

    def __init__(self) -> None:
        self.apart_rad = 0.0  # difference of the two turns, once it has lasted APART_S; else 0
        self._at_ns: list[int] = []  # instants of the gyroscope's samples, in order
        self._turned_rad: list[float] = []  # the turn by the gyroscope up to each sample
        self._rate_radps = 0.0  # the last sample
        self._pose_ns: int | None = None  # instant of the last pose
        self._offset_rad = 0.0  # heading of the camera minus that of the gyroscope, at the last pose
        self._usual_rad = 0.0  # the same, filtered with FORGETS_S
        self._since_ns: int | None = None  # the first pose since which the turns have been apart

    def note_rate(self, rate_radps: float, at_ns: int) -> None:
        """Integrate a sample of the gyroscope. One that was given before is ignored."""
        if self._at_ns and at_ns <= self._at_ns[-1]:
            return
        elapsed_s = (at_ns - self._at_ns[-1]) / NS if self._at_ns else math.inf
        if elapsed_s > LONGEST_S or abs(rate_radps - self._rate_radps) > LEAP_RADPS:
            self._at_ns, self._turned_rad, self._pose_ns = [], [], None
        turned_rad = self._turned_rad[-1] + 0.5 * (self._rate_radps + rate_radps) * elapsed_s if self._at_ns else 0.0
        self._at_ns, self._turned_rad = [*self._at_ns[-KEPT:], at_ns], [*self._turned_rad[-KEPT:], turned_rad]
        self._rate_radps = rate_radps

    def note_heading(self, heading_rad: float, at_ns: int) -> None:
        """Compare the heading of a pose with the turn by the gyroscope up to its exposure `at_ns`. One that was given before,
        or is older than the samples kept, is ignored."""
        if not self._at_ns or at_ns < self._at_ns[0] or (self._pose_ns is not None and at_ns <= self._pose_ns):
            return
        offset_rad = wrap(heading_rad - self._turned(at_ns))
        elapsed_s = (at_ns - self._pose_ns) / NS if self._pose_ns is not None else math.inf
        leaps = elapsed_s > LONGEST_S or abs(wrap(offset_rad - self._offset_rad)) > LEAP_RAD
        self._offset_rad, self._pose_ns = offset_rad, at_ns
        if leaps:
            self._usual_rad, self._since_ns, self.apart_rad = offset_rad, None, 0.0
            return
        self._usual_rad += wrap(offset_rad - self._usual_rad) * -math.expm1(-elapsed_s / FORGETS_S)
        apart_rad = abs(wrap(offset_rad - self._usual_rad))
        if apart_rad <= APART_RAD:
            self._since_ns = None
        elif self._since_ns is None:
            self._since_ns = at_ns
        lasts = self._since_ns is not None and at_ns - self._since_ns >= APART_S * NS
        self.apart_rad = apart_rad if lasts else 0.0

    def _turned(self, at_ns: int) -> float:
        """Turn by the gyroscope up to an instant, from the sample before it on with the mean rate up to the next."""
        k = bisect_right(self._at_ns, at_ns) - 1
        since_s = (at_ns - self._at_ns[k]) / NS
        if k + 1 == len(self._at_ns):
            return self._turned_rad[k] + self._rate_radps * min(since_s, LONGEST_S)
        share = since_s * NS / (self._at_ns[k + 1] - self._at_ns[k])
        return self._turned_rad[k] + share * (self._turned_rad[k + 1] - self._turned_rad[k])


class GravityCheck:
    """Comparison of the specific force with gravity, and detection of one that repeats itself on all axes."""

    def __init__(self) -> None:
        self._at_ns = 0
        self._error_mps2 = (0.0, 0.0, 0.0)  # specific force less that of a robot at rest, low-pass filtered with GRAVITY_S
        self._axes = [StuckSensorCheck(NOISE_MPS2) for _ in range(3)]

    def note_sample(self, force_mps2: Sequence[float], at_ns: int) -> None:
        """Filter the error of gravity with a sample of the specific force (3,), body axes. One that was given before is
        ignored."""
        if at_ns <= self._at_ns:
            return
        gain = -math.expm1(-min((at_ns - self._at_ns) / NS, LONGEST_S) / GRAVITY_S)
        self._at_ns = at_ns
        for axis, value in zip(self._axes, force_mps2, strict=True):
            axis.note_sample(value, at_ns)
        errors = [force - level for force, level in zip(force_mps2, LEVEL_MPS2, strict=True)]
        size_mps2 = math.hypot(*errors)
        # Clipped to twice the limit, so that one sample that leaps does not pass the limit once it is filtered.
        clip = min(1.0, 2.0 * MOST_ERROR_MPS2 / size_mps2) if size_mps2 > 0.0 else 1.0
        x, y, z = (old + gain * (clip * new - old) for old, new in zip(self._error_mps2, errors, strict=True))
        self._error_mps2 = x, y, z

    @property
    def doubt(self) -> str:
        """The reason to doubt the accelerometer; empty if there is none."""
        error_mps2, same_s = math.hypot(*self._error_mps2), min(axis.same_s for axis in self._axes)
        if same_s > 0.0:
            return f"exactly the same for {same_s:.1f} s"
        if error_mps2 > MOST_ERROR_MPS2:
            return f"off gravity by {error_mps2:.0f} m/s² or more: it is wrong or turned, or the robot leans"
        return ""


class StuckSensorCheck:
    """Detection of a reading that repeats itself exactly where it had noise before. A reading without noise is not judged."""

    def __init__(self, least_noise: float) -> None:
        self._least_noise = least_noise
        self.same_s = 0.0  # for how long it has repeated itself, from STUCK_S on; else 0
        self._at_ns = self._since_ns = 0  # of the last sample, and of the first one that is equal to it
        self._last = self._change = math.nan  # the last sample, and its change from the one before
        self._noise = self._noise_before = 0.0  # share of the samples that show noise: of late, and before they were equal

    def note_sample(self, value: float, at_ns: int) -> None:
        """Take in a sample. One that was given before is ignored."""
        if at_ns <= self._at_ns:
            return
        elapsed_s, change = (at_ns - self._at_ns) / NS, value - self._last
        self._at_ns, self._last = at_ns, value
        is_noise = abs(change - self._change) > self._least_noise
        self._noise += (is_noise - self._noise) * -math.expm1(-min(elapsed_s, LONGEST_S) / NOISE_S)
        self._change = change
        if change != 0.0 or elapsed_s > LONGEST_S:
            self._since_ns, self._noise_before = at_ns, self._noise
        same_s = (at_ns - self._since_ns) / NS
        self.same_s = same_s if same_s >= STUCK_S and self._noise_before > NOISY else 0.0
