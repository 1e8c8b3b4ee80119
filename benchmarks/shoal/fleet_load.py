"""Traffic of a fleet of twenty in a control period, as bytes: robots, station, localizer, and the camera's video."""

from collections.abc import Iterator

import numpy as np

from shoal.messages import topics
from shoal.messages.codec import encode
from shoal.messages.messages import (
    BoardReading,
    Control,
    Estimate,
    LocalizerStatus,
    Plan,
    Pose,
    RobotState,
    StationHeartbeat,
    StepInputs,
    Track,
    Truth,
    Video,
)
from shoal.messages.topics import Topic

ROBOTS, HORIZON = 20, 50
FILM_BYTES = 26_000  # of a picture: 1280 x 960 as H.264 at 4 Mbit/s
VARIANTS = 40  # of each message, so that compression finds no repetition within a flush
SECOND = 1_000_000_000

Load = list[list[tuple[Topic, int | None, bytes]]]  # per variant: what one control period brings


def load(seed: int = 1) -> Load:
    """All messages of a control period, `VARIANTS` times over."""
    chance = np.random.default_rng(seed)
    return [list(_period(chance)) for _ in range(VARIANTS)]


def _period(chance: np.random.Generator) -> Iterator[tuple[Topic, int | None, bytes]]:
    robots = range(1, ROBOTS + 1)
    heartbeat = StationHeartbeat("0" * 64, False, "RUNNING")
    for robot in robots:
        others = tuple(r for r in robots if r != robot)
        eta = np.cumsum(chance.normal(0.0, 0.01, (HORIZON + 1, 4)), axis=0)
        x_m, y_m, yaw_rad = chance.normal(0.0, 1.0, 3).tolist()
        pose = Pose(x_m, y_m, yaw_rad, 1e-6 * np.eye(3), Track.MARKER, True, 0.9, 0.3)
        four, three = chance.normal(0.0, 1.0, 4), chance.normal(0.0, 1.0, 3)
        state = RobotState(
            experiment_hash="0" * 64,
            trajectory_id="0" * 12,
            pulse_us=(1500,) * 8,
            heard=others,
            estimate=Estimate(eta=four, nu=four, disturbance=four),
            control=Control(
                eta_reference=four,
                eta_command=four,
                wrench=three,
                wrench_step=three,
                wrench_wanted=three,
                wrench_delivered=three,
            ),
            board=BoardReading(echo_us=(1500,) * 8),
        )
        inputs = StepInputs(
            int(chance.integers(2**31)), pose, SECOND, 5_000_000, heartbeat, 2**62, SECOND, SECOND, BoardReading(depth_m=0.3),
            others, tuple(2**62 + r for r in others), tuple(int(k) for k in chance.integers(2**31, size=len(others))),
            tuple(int(k) for k in chance.integers(2**62, size=len(others))),
        )  # fmt: skip
        for topic, message in (
            (topics.POSE, pose), (topics.PLAN, Plan(0.05, eta, eta + 0.01)), (topics.STATE, state), (topics.INPUTS, inputs)
        ):  # fmt: skip
            yield topic, robot, encode(message)
    rows = chance.normal(0.0, 1.0, (ROBOTS, 4))
    yield topics.TRUTH, None, encode(Truth(tuple(robots), rows, rows, rows[:, :3], rows))
    yield topics.HEARTBEAT, None, encode(heartbeat)
    yield topics.LOCALIZER, None, encode(LocalizerStatus(frame_ms=4.0))
    yield topics.VIDEO, None, encode(Video(chance.bytes(FILM_BYTES)))
