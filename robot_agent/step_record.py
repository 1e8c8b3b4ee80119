"""Record of a control step's inputs, complete enough to repeat the step. Pure.

The node makes the record first and steps on it, so that no input can reach a step without being recorded:

    messages of the bus, telemetry -> `record_step` -> StepInputs -> `inputs_of` -> Agent.step
                                                  the log   -> `inputs_of` -> Agent.step      (sim_bridge/replay/rerun.py)
"""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from robot_agent.inputs import Inputs, StampedObstacles, StampedPlan, StampedPose, StationView
from shoal.bus.bus import Received
from shoal.messages.codec import Header
from shoal.messages.messages import (
    BoardReading,
    Command,
    CommandTaken,
    Obstacles,
    Plan,
    Pose,
    Reply,
    StationHeartbeat,
    StepInputs,
)
from shoal.runtime.runtime import Clock


def record_step(
    step: int,
    late_steps: int,
    clock: Clock,
    pose: Received[Pose] | None,
    heartbeat: Received[StationHeartbeat] | None,
    board: BoardReading,
    plans: Mapping[int, Received[Plan]],
    obstacles: Received[Obstacles] | None,
) -> StepInputs:
    """Record of a step. Plans and obstacles are named by session and sequence only: the log has them, and they are large."""
    robots = sorted(plans)
    return StepInputs(
        step=step,
        late_steps=late_steps,
        **_pose_fields(clock, pose),
        **_station(clock, heartbeat),
        board=board,
        plan_robots=tuple(robots),
        plan_sessions=tuple(plans[robot].header.session for robot in robots),
        plan_sequences=tuple(plans[robot].header.sequence for robot in robots),
        plan_instants_ns=tuple(clock.instant_ns(plans[robot]) for robot in robots),
        obstacles_session=obstacles.header.session if obstacles is not None else 0,
        obstacles_sequence=obstacles.header.sequence if obstacles is not None else 0,
        obstacles_instant_ns=clock.instant_ns(obstacles) if obstacles is not None else 0,
    )


def record_command(
    before_step: int, number: int, clock: Clock, header: Header, command: Command, heartbeat: Received[StationHeartbeat] | None
) -> CommandTaken:
    """Record of a command, without its reply."""
    judged_by = _station(clock, heartbeat)
    return CommandTaken(before_step, number, header.session, header.sequence, header.stamp_ns, command=command, **judged_by)


def inputs_of(record: StepInputs, plans: Mapping[int, Plan], obstacles: Obstacles | None, now_ns: int) -> Inputs:
    """Inputs of the agent at `now_ns`, from a record. `plans` and `obstacles` are the messages that the record names, as far
    as they are known."""
    instants = zip(record.plan_robots, record.plan_instants_ns, strict=True)
    return Inputs(
        pose=StampedPose(record.pose, record.pose_instant_ns) if record.pose is not None else None,
        board=record.board or BoardReading(),
        station=station_view(record, now_ns),
        emergency_stop=record.heartbeat is not None and record.heartbeat.emergency_stop,
        plans={robot: StampedPlan(plans[robot], instant_ns) for robot, instant_ns in instants if robot in plans},
        obstacles=StampedObstacles(obstacles, record.obstacles_instant_ns) if obstacles is not None else None,
        late_steps=record.late_steps,
    )


def station_view(record: StepInputs | CommandTaken, now_ns: int) -> StationView:
    """The station as judged at `now_ns`."""
    if not record.station_session:
        return StationView()
    age_ns = now_ns - record.station_instant_ns
    view = StationView(record.station_session, record.station_stamp_ns + age_ns, age_ns * 1e-9)
    beat = record.heartbeat
    return view if beat is None else replace(view, lag_s=beat.lag_s, slowing=beat.slowing, out=beat.out)


def with_reply(record: CommandTaken, reply: Reply) -> CommandTaken:
    """Record of a command with its reply."""
    return CommandTaken(**{**vars(record), "reply": reply})


def _pose_fields(clock: Clock, pose: Received[Pose] | None) -> dict[str, Any]:
    """Fields of the record for a pose."""
    if pose is None:
        return {}
    return {
        "pose": pose.message,
        "pose_instant_ns": clock.instant_ns(pose),
        "pose_told_age_ns": pose.header.age_ns,
    }


def _station(clock: Clock, heartbeat: Received[StationHeartbeat] | None) -> dict[str, Any]:
    """Fields of the record for the station's heartbeat."""
    if heartbeat is None:
        return {"heartbeat": None}
    return {
        "heartbeat": heartbeat.message,
        "station_session": heartbeat.header.session,
        "station_stamp_ns": heartbeat.header.stamp_ns,
        "station_instant_ns": clock.instant_ns(heartbeat),
    }
