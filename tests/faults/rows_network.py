"""Faults between robots and their station: the station lost, the network cut; and a person's emergency stop."""

import signal
import time
from itertools import combinations

import numpy as np

from shoal.messages.messages import CommandKind, Mode
from tests.faults.onlooker import Heard, Stuck
from tests.faults.patched import DEAF_ROBOT, START_LATE, SWITCH_LOST
from tests.faults.rig import Rig
from tests.faults.row import HELD, OFF, RESUMED, Random, Sample, resumed

LATE_BY_S = 0.5  # at least this long after the others a robot must have begun, or its START was not late


def station_killed(rig: Rig, random: Random) -> Sample:
    ns = rig.signal("groundstation", signal.SIGKILL)
    neutral_s = rig.neutral_s(ns)
    rig.restart("groundstation")
    return {"neutral": neutral_s, RESUMED: resumed(rig, rig.robots, 2.0)}


def _station_lost(rig: Rig, ns: int) -> dict[str, float]:
    last_ns = max((at for at in list(rig.beats) if at <= ns + 50_000_000), default=ns)
    late_s = (ns - last_ns) * 1e-9
    return {
        "hold": max(rig.mode_s(r, HELD, ns) for r in rig.robots) + late_s,
        "neutral": rig.neutral_s(ns, within_s=6.0) + late_s,
        "disarmed": max(rig.mode_s(r, {Mode.DISARMED}, ns) for r in rig.robots) + late_s,
    }


def station_alone_killed(rig: Rig, random: Random) -> Sample:
    times_s = _station_lost(rig, rig.signal("groundstation", signal.SIGKILL))
    rig.restart("groundstation")
    return {**times_s, RESUMED: resumed(rig, rig.robots, 2.0)}


def station_alone_hung(rig: Rig, random: Random) -> Sample:
    times_s = _station_lost(rig, rig.signal("groundstation", signal.SIGSTOP))
    rig.signal("groundstation", signal.SIGCONT)
    return {**times_s, RESUMED: resumed(rig, rig.robots, 2.0)}


def partition(rig: Rig, random: Random) -> Sample:
    """Robot 1 is cut off: both ways, or only what it hears, or only what it says."""
    one, other = rig.robots[:2]
    way = ("both", "down", "up")[int(random.integers(3))]
    seconds = float(random.choice([1.0, 2.0, 5.0]))
    ns = time.monotonic_ns()
    rig.net.up, rig.net.down = way == "down", way == "up"
    neutral_s = rig.neutral_s(ns, [one], within_s=6.0)
    times_s = {"neutral": neutral_s} if way != "up" else {"neutral, still hearing": neutral_s}
    if way != "down":
        rig.wait(lambda: any(one not in h.state.heard for h in rig.since(other, ns)), "plan expired")
        expiry_ns = next(h.ns for h in rig.since(other, ns) if one not in h.state.heard)
        times_s["neighbour's plan expired"] = (expiry_ns - ns) * 1e-9
    time.sleep(max(seconds - (time.monotonic_ns() - ns) * 1e-9, 0.0))
    rig.net.up = rig.net.down = True
    return {**times_s, RESUMED: resumed(rig, (one,), 2.0)}


def partition_short(rig: Rig, random: Random) -> Sample:
    """0.2 s, as a Wi-Fi roams: nothing worse than holding may come of it, and no thrust on old news."""
    ns = time.monotonic_ns()
    rig.net.up = rig.net.down = False
    time.sleep(0.2)
    rig.net.up = rig.net.down = True
    time.sleep(1.0)
    return {"worse than holding": float(any(h.state.mode in OFF for h in rig.since(rig.robots[0], ns)))}


def emergency_stop(rig: Rig, random: Random) -> Sample:
    ns = time.monotonic_ns()
    rig.order(CommandKind.STOP)
    neutral_s = rig.neutral_s(ns)
    refused = not rig.order(CommandKind.START).accepted
    return {"all boards neutral": neutral_s, "started while stopped": float(not refused)}


def emergency_stop_lossy(rig: Rig, random: Random) -> Sample:
    rig.break_(*(f"link {robot} noisy 0.3" for robot in rig.robots))
    time.sleep(0.3)
    times_s = emergency_stop(rig, random)
    rig.break_()
    return times_s


def start_late(rig: Rig, random: Random) -> Sample:
    """The difference between a robot's timetable and the others', in the first second of its flight."""
    late, others = DEAF_ROBOT, [r for r in rig.robots if r != DEAF_ROBOT]
    rig.land()
    ns = rig.signal("groundstation", START_LATE)
    try:
        rig.fly()
    finally:
        rig.signal("groundstation", signal.SIGHUP)
    time.sleep(1.0)
    began = {r: next(h.ns for h in rig.since(r, ns) if _flies(h)) for r in rig.robots}
    from_ns = max(began.values())
    ahead_s = {r: float(np.median([h.state.trajectory_s - (h.ns - ns) * 1e-9 for h in rig.since(r, from_ns) if _flies(h)]))
               for r in rig.robots}  # fmt: skip
    late_s = (began[late] - min(began[r] for r in others)) * 1e-9
    if late_s < LATE_BY_S:
        raise Stuck(f"robot {late} flew {late_s:.2f} s after the others: its START was not late")
    return {"timetables apart": max(abs(ahead_s[late] - ahead_s[r]) for r in others)}


def _flies(report: Heard) -> bool:
    return _tracks(report) and report.state.trajectory_s > 0.0


def switch_partial(rig: Rig, random: Random) -> Sample:
    """Robot 2 never hears of the moment at which all go over to another path."""
    rig.signal("groundstation", SWITCH_LOST)
    ns = time.monotonic_ns()
    reply = rig.order(CommandKind.GO, [(float(random.uniform(-2.5, -1.5)), float(random.uniform(0.5, 1.5)))])
    if not reply.accepted:
        raise Stuck(f"GO: {reply.reason}")
    rig.wait(lambda: rig.mission == "PAUSED" and all(rig.mode(r) is Mode.HOLDING for r in rig.robots), "all hold", 15.0)
    hold_ns = max(next(h.ns for h in rig.since(r, ns) if h.state.mode is Mode.HOLDING) for r in rig.robots) - ns
    off_m = max(_off_shape_m(rig, a, b, ns) for a, b in combinations(rig.robots, 2))
    rig.signal("groundstation", signal.SIGHUP)
    time.sleep(1.0)
    old = {h.state.trajectory_id for r in rig.robots for h in rig.since(r, ns)}
    resumed_ns = time.monotonic_ns()
    reply = rig.order(CommandKind.RESUME)
    if not reply.accepted:
        raise Stuck(f"RESUME: {reply.reason}")
    rig.wait(lambda: rig.mission == "RUNNING" and rig.flying, "all fly again", 30.0)
    time.sleep(1.0)
    again = [h for r in rig.robots for h in rig.since(r, resumed_ns) if _tracks(h) and h.state.trajectory_id in old]
    rig.land()
    return {
        "all hold": hold_ns * 1e-9,
        "references out of shape": off_m,
        "states on an old plan after RESUME": float(len(again)),
    }


def _off_shape_m(rig: Rig, one: int, other: int, ns: int) -> float:
    """By how much the distance of two robots' references is another than before, at most, while both track."""
    ours, theirs = ({h.ns: h.state.control for h in rig.since(robot, ns) if _tracks(h)} for robot in (one, other))
    apart_m = []
    for at_ns, control in ours.items():
        beside = theirs[min(theirs, key=lambda ns: abs(ns - at_ns))] if theirs else None
        if control is not None and beside is not None:
            apart_m.append(float(np.linalg.norm(control.eta_reference[:2] - beside.eta_reference[:2])))
    return max(abs(m - apart_m[0]) for m in apart_m)


def _tracks(report: Heard) -> bool:
    return report.state.mode is Mode.TRACKING
