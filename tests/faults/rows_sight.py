"""Faults of what tells robots where they are: the localizer, the camera, a marker."""

import signal
import time

from shoal.messages.messages import Mode
from tests.faults.rig import Rig
from tests.faults.row import HELD, RESUMED, Random, Sample, resumed

LEARNS_S = 6.0  # what the localizer takes to learn the water anew, and more
TRACKS = "states that track again unasked"


def _without_poses(rig: Rig, random: Random, ns: int) -> dict[str, float]:
    """The states of all robots after poses end at `ns`."""
    hold_s = max(rig.mode_s(r, HELD, ns) for r in rig.robots)
    last_ns = max((at for at in list(rig.poses_ns) if at < ns + hold_s * 1e9), default=ns)
    return {"hold after the last pose": hold_s + (ns - last_ns) * 1e-9, "neutral": rig.neutral_s(ns), "alert": rig.alert_s(ns)}


def localizer_killed(rig: Rig, random: Random) -> Sample:
    times_s = _without_poses(rig, random, rig.signal("localizer", signal.SIGKILL))
    rig.restart("localizer")
    return times_s


def localizer_hung(rig: Rig, random: Random) -> Sample:
    times_s = _without_poses(rig, random, rig.signal("localizer", signal.SIGSTOP))
    rig.signal("localizer", signal.SIGCONT)
    return {**times_s, RESUMED: resumed(rig, rig.robots, 1.0)}


def camera_frozen(rig: Rig, random: Random) -> Sample:
    ns = rig.break_("camera frozen")
    hold_s = max(rig.mode_s(r, HELD, ns) for r in rig.robots)
    times_s = {"hold": hold_s, "neutral": rig.neutral_s(ns), "alert": rig.alert_s(ns, "camera frozen")}
    rig.break_()
    return {**times_s, RESUMED: resumed(rig, rig.robots, 1.0)}


def _upset(rig: Rig, fault: str, blind: bool) -> Sample:
    """The whole picture changes at once; then it is as it was."""
    ns = rig.break_(fault)
    times_s = {"hold": max(rig.mode_s(r, HELD, ns) for r in rig.robots)}
    if blind:
        rig.wait(lambda: all(_blind_ns(rig, r, ns) for r in rig.robots), "all say that they are blind")
        times_s["blind told"] = max(_blind_ns(rig, r, ns) - ns for r in rig.robots) * 1e-9
    time.sleep(LEARNS_S)
    rig.break_()
    moves = sum(h.state.mode is Mode.TRACKING for r in rig.robots for h in rig.since(r, ns + round(times_s["hold"] * 1e9)))
    return {**times_s, TRACKS: float(moves)}


def _blind_ns(rig: Rig, robot: int, ns: int) -> int:
    """The instant after `ns` at which a robot first reported that obstacles are unknown; 0 if none has."""
    return next((h.ns for h in rig.since(robot, ns) if h.state.blind), 0)


def lamp_switched(rig: Rig, random: Random) -> Sample:
    return _upset(rig, f"camera lamp {random.choice([0.5, 2.0])}", blind=True)


def camera_bumped(rig: Rig, random: Random) -> Sample:
    """Too little of an even floor changes for anybody to be blind; but nobody is where he was."""
    return _upset(rig, f"camera bump {2 * int(random.integers(30, 60))}", blind=False)


def marker_gone(rig: Rig, random: Random) -> Sample:
    """The plate comes off altogether, and is put back."""
    robot = int(random.choice(rig.robots))
    ns = rig.break_(f"marker {robot} lost")
    times_s = {"hold": rig.mode_s(robot, HELD, ns), "neutral": rig.neutral_s(ns, [robot])}
    rig.break_()
    return {**times_s, RESUMED: resumed(rig, (robot,), 1.0)}
