"""Alarms for the operator, worst first. Pure: made anew from the newest messages, so an alarm goes with its cause.

What is amiss with a robot is decided in groundstation/telemetry.py, for preflight too. Levels: `critical` robots stop or
must be stopped; `warning` the run is at risk; `notice` worth a look.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from types import MappingProxyType

from groundstation.telemetry import Fleet, findings
from shoal.config.experiment import Experiment
from shoal.messages import topics
from shoal.messages.messages import CameraHealth, LocalizerStatus

LEVELS = ("critical", "warning", "notice")


@dataclass(frozen=True)
class Alarm:
    """One line. `key` names the cause, so that a page can tell a new one from one that lasts."""

    level: str
    key: str
    text: str
    robot: int = 0  # whose it is; 0: of the whole system

    @property
    def line(self) -> str:
        """The line as people read it."""
        return f"robot {self.robot}: {self.text}" if self.robot else self.text


def alarms(
    experiment: Experiment,
    fleet: Fleet,
    localizer: LocalizerStatus | None,
    localizer_age_s: float,
    recorder_error: str,
    lasting: Mapping[str, str] = MappingProxyType({}),
    stuck_s: float = 0.0,
    simulated: bool = False,
) -> list[Alarm]:
    """All that is amiss, critical first. `stuck_s`: for how long the station's cycle has not run, if that is too long.
    `simulated`: time waits for every process, so that a slow one is not late. `lasting`: warnings, by key, that the station
    itself gives."""
    alarm_list = [*_system(experiment, fleet, localizer, localizer_age_s, recorder_error)]
    if stuck_s > 0.0 and simulated:
        alarm_list.append(Alarm("notice", "stands", f"simulated time stands since {stuck_s:.0f} s: the machine is busy"))
    elif stuck_s > 0.0:
        alarm_list.append(Alarm("critical", "stuck", f"the station has sent no heartbeat for {stuck_s:.0f} s: robots hold"))
    alarm_list += [Alarm("warning", key, text) for key, text in lasting.items()]
    for robot in experiment.robot_ids:
        alarm_list += [
            Alarm(finding.level, f"{robot}:{finding.key}", finding.text, robot)
            for finding in findings(experiment, robot, fleet[robot])
            if not (simulated and finding.key == "late")
        ]
    return sorted(alarm_list, key=lambda alarm: LEVELS.index(alarm.level))


def _system(
    experiment: Experiment, fleet: Fleet, localizer: LocalizerStatus | None, age_s: float, recorder_error: str
) -> Iterator[Alarm]:
    """Alarms of the parts that all robots need: recorder, localizer, cameras."""
    if recorder_error:
        yield Alarm("critical", "recorder", f"the log is not whole: {recorder_error}")
    if localizer is None:
        limit_s = topics.POSE.max_age_in(experiment.safety)
        if not any(robot.pose_age_s <= limit_s for robot in fleet.values()):  # poses may come without one
            yield Alarm("warning", "localizer", "no localizer has been heard")
    elif age_s > topics.LOCALIZER.max_age_s:
        yield Alarm("critical", "localizer", "the localizer is silent")
    elif localizer.camera is not CameraHealth.OK:
        why = f": {localizer.message}" if localizer.message else ""
        yield Alarm("critical", "camera", f"the camera is {localizer.camera.name.lower().replace('_', ' ')}{why}")
    elif experiment.cameras and localizer.message:  # which of them is out or in doubt, while the others go on
        yield Alarm("warning", "cameras", localizer.message)
