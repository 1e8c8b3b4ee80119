"""What an operator must know now, worst first. Pure: made anew from the newest of everything, so an alarm goes with its cause.

Levels: `critical` robots stop or must be stopped; `warning` the run is at risk; `notice` worth a look.
"""

from collections.abc import Iterator
from dataclasses import dataclass

from groundstation.fleet import Fleet
from wire import topics
from wire.access import INSECURE
from wire.experiment import Experiment
from wire.messages import CameraHealth, LocalizerStatus, Mode, Solve, Track

LEVELS = ("critical", "warning", "notice")
LOSSY = 0.2  # share of a board's messages: above it echoes and batteries are old
LATE_SHARE = 0.5  # of the control period: the budget of a step


@dataclass(frozen=True)
class Alarm:
    """One line. `key` names the cause, so that a page can tell a new one from one that lasts."""

    level: str
    key: str
    text: str


def alarms(
    experiment: Experiment,
    fleet: Fleet,
    localizer: LocalizerStatus | None,
    localizer_age_s: float,
    recorder_error: str,
    insecure: bool = False,
) -> list[Alarm]:
    """All that is amiss, critical first."""
    found = [*_system(fleet, localizer, localizer_age_s, recorder_error)]
    if insecure:
        found.append(Alarm("warning", "insecure", INSECURE))
    for robot in experiment.robot_ids:
        found += _robot(experiment, fleet, robot)
    return sorted(found, key=lambda alarm: LEVELS.index(alarm.level))


def _system(fleet: Fleet, localizer: LocalizerStatus | None, age_s: float, recorder_error: str) -> Iterator[Alarm]:
    if recorder_error:
        yield Alarm("critical", "recorder", f"the log is not being written: {recorder_error}")
    if localizer is None:
        if not any(robot.pose_age_s <= topics.POSE.max_age_s for robot in fleet.values()):  # poses may come without one
            yield Alarm("warning", "localizer", "no localizer has been heard")
    elif age_s > topics.LOCALIZER.max_age_s:
        yield Alarm("critical", "localizer", "the localizer is silent")
    elif localizer.camera is not CameraHealth.OK:
        why = f": {localizer.message}" if localizer.message else ""
        yield Alarm("critical", "camera", f"the camera is {localizer.camera.name.lower().replace('_', ' ')}{why}")


def _robot(experiment: Experiment, fleet: Fleet, robot: int) -> Iterator[Alarm]:
    seen = fleet[robot]
    state = seen.state

    def alarm(level: str, cause: str, text: str) -> Alarm:
        return Alarm(level, f"{robot}:{cause}", f"robot {robot}: {text}")

    if state is None or not seen.heard:
        yield alarm("critical" if state is not None else "warning", "silent", "silent" if state else "not heard yet")
        return
    if state.mode is Mode.FAULT or (state.mode is Mode.STOPPED):
        yield alarm("critical", "mode", f"{state.mode.name.lower()}{f': {state.fault}' if state.fault else ''}")
    elif state.fault:
        yield alarm("warning", "fault", state.fault)
    battery = experiment.vehicle.battery
    if state.battery_v < battery.no_arm_v:
        yield alarm("critical", "battery", f"battery {state.battery_v:.1f} V, below {battery.no_arm_v:g} V")
    elif state.battery_v < battery.warn_v:
        yield alarm("warning", "battery", f"battery {state.battery_v:.1f} V")
    if state.track <= Track.COAST:
        yield alarm("warning", "pose", f"pose {state.track.name.lower()}, {state.pose_age_ms * 1e-3:.1f} s old")
    elif seen.pose is not None and experiment.localizer.markers and not seen.pose.identity_verified:
        yield alarm("warning", "identity", "identity not verified")
    if state.board_age_ms * 1e-3 > topics.STATE.max_age_s:
        yield alarm("critical", "board", f"thruster board silent for {min(state.board_age_ms * 1e-3, 999.0):.1f} s")
    elif state.board_loss > LOSSY:
        yield alarm("warning", "loss", f"{state.board_loss:.0%} of the board's messages are lost")
    if state.solve is Solve.FAILED:
        yield alarm("critical", "solve", "the solver failed: neutral")
    elif state.solve is Solve.SHIFTED:
        yield alarm("notice", "solve", "an old plan is flown on")
    if state.step_us * 1e-6 > LATE_SHARE * experiment.controller.period_s:
        yield alarm("notice", "late", f"control step takes {state.step_us * 1e-3:.0f} ms")
    if state.slack_m > 0.01:
        yield alarm("warning", "close", f"its plan enters another robot's space by {state.slack_m * 1e3:.0f} mm")
