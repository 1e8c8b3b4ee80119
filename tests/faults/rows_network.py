"""Faults between robots and their station: the station lost, the network cut; and a person's emergency stop."""

import signal
import time

from tests.faults.rig import Rig
from tests.faults.row import HELD, OFF, RESUMED, Random, Sample, resumed
from wire.messages import Mode, Order


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
    found = _station_lost(rig, rig.signal("groundstation", signal.SIGKILL))
    rig.restart("groundstation")
    return {**found, RESUMED: resumed(rig, rig.robots, 2.0)}


def station_alone_hung(rig: Rig, random: Random) -> Sample:
    found = _station_lost(rig, rig.signal("groundstation", signal.SIGSTOP))
    rig.signal("groundstation", signal.SIGCONT)
    return {**found, RESUMED: resumed(rig, rig.robots, 2.0)}


def partition(rig: Rig, random: Random) -> Sample:
    """Robot 1 is cut off: both ways, or only what it hears, or only what it says."""
    one, other = rig.robots[:2]
    way = ("both", "down", "up")[int(random.integers(3))]
    seconds = float(random.choice([1.0, 2.0, 5.0]))
    ns = time.monotonic_ns()
    rig.net.up, rig.net.down = way == "down", way == "up"
    neutral_s = rig.neutral_s(ns, [one], within_s=6.0)
    found = {"neutral": neutral_s} if way != "up" else {"neutral, still hearing": neutral_s}
    if way != "down":
        rig.wait(lambda: any(one not in h.state.heard for h in rig.since(other, ns)), "plan expired")
        found["neighbour's plan expired"] = (next(h.ns for h in rig.since(other, ns) if one not in h.state.heard) - ns) * 1e-9
    time.sleep(max(seconds - (time.monotonic_ns() - ns) * 1e-9, 0.0))
    rig.net.up = rig.net.down = True
    return {**found, RESUMED: resumed(rig, (one,), 2.0)}


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
    rig.order(Order.STOP)
    neutral_s = rig.neutral_s(ns)
    refused = not rig.order(Order.START).accepted
    return {"all boards neutral": neutral_s, "started while stopped": float(not refused)}


def emergency_stop_lossy(rig: Rig, random: Random) -> Sample:
    rig.break_(*(f"link {robot} noisy 0.3" for robot in rig.robots))
    time.sleep(0.3)
    found = emergency_stop(rig, random)
    rig.break_()
    return found
