"""SHELL: faults around the station: its page, its disk, its network, the machines' clocks."""

import itertools
import json
import os
import shutil
import signal
import tempfile
import time
from contextlib import suppress
from itertools import pairwise
from pathlib import Path
from urllib.request import urlopen

from mcap.reader import make_reader
from websockets.sync.client import connect
from websockets.typing import Origin

from groundstation.logs.repair import recover
from shoal.messages import topics
from shoal.messages.messages import Event, Mode
from sim_bridge.sil.processes import Child
from tests.faults.onlooker import Stuck
from tests.faults.patched import END_THREAD
from tests.faults.rig import Rig
from tests.faults.row import LEFT, Random, Sample, left

GAP = "longest gap between heartbeats"
SMALL_DISK_BYTES = 1 << 30
LINE_BYTES = 4 << 20
NEVER_S = 30.0


def _gap_s(rig: Rig, ns: int) -> float:
    beats = [at for at in list(rig.beats) if at >= ns]
    return max((b - a for a, b in pairwise(beats)), default=10**18) * 1e-9


def page_frozen(rig: Rig, random: Random, for_s: float = 60.0) -> Sample:
    """A browser that takes no more frames, as one behind a closed lid."""
    address = rig.station_options[-1]
    pages = [rig.children.start(f"page-{i}", "tests.faults.watching", [address]) for i in range(3)]
    _looks(rig, pages)
    ns = time.monotonic_ns()
    for page in pages:
        page.process.send_signal(signal.SIGSTOP)
    time.sleep(for_s)
    figures = {GAP: _gap_s(rig, ns), LEFT: left(rig, ns)}
    for page in pages:
        page.process.kill()
        page.process.wait()
        rig.children.all.remove(page)
    return figures


def page_events(rig: Rig, random: Random) -> Sample:
    """Two log lines of 4 MB in a robot's name; then somebody opens the page."""
    address, robot = rig.station_options[-1], int(random.choice(rig.robots))
    ns = time.monotonic_ns()
    for _ in range(2):
        rig.bus.publish(topics.EVENT, Event(2, f"agent-{robot}", "x" * LINE_BYTES), time.time_ns())
    time.sleep(0.5)
    begin_ns = time.monotonic_ns()
    with urlopen(f"http://{address}/", timeout=NEVER_S) as page:
        page.read()
    with connect(f"ws://{address}/live", origin=Origin(f"http://{address}"), max_size=None) as live:
        live.send(json.dumps({"kind": "hello"}))
        live.recv(NEVER_S)
    figures = {"page opens": (time.monotonic_ns() - begin_ns) * 1e-9}
    time.sleep(2.0)
    return {**figures, GAP: _gap_s(rig, ns), LEFT: left(rig, ns)}


def _looks(rig: Rig, pages: list[Child]) -> None:
    rig.wait(lambda: all("frames" in page.log.read_text() for page in pages), "pages watch")


def clock_step(rig: Rig, random: Random) -> Sample:
    """And back: a robot whose clock is off when the fleet is to start is sent to a person first."""
    ns = time.monotonic_ns()
    name = str(random.choice(["groundstation", "localizer", *(f"agent-{r}" for r in rig.robots)]))
    rig.set_clock(name, float(random.choice([-3600.0, 3600.0])) * int(random.integers(1, 48)))
    time.sleep(2.0)
    rig.set_clock(name, 0.0)
    time.sleep(1.0)
    return {LEFT: left(rig, ns)}


# --- the log


def _log(rig: Rig) -> Path:
    return rig.run_dir / "run.mcap"


def _read_back(log: Path, until_unix_ns: int) -> dict[str, float]:
    """The length of the log that is missing at its end, read by the usual reader after `groundstation log repair`."""
    copy = Path(shutil.copy(log, Path(tempfile.mkdtemp(prefix="shoal-log-"))))
    try:
        recover(copy)
        with copy.open("rb") as file:
            last_ns = max(message.log_time for _, _, message in make_reader(file).iter_messages())
        return {"of the log lost": max((until_unix_ns - last_ns) * 1e-9, 0.0), "unreadable logs": 0.0}
    except Exception:  # whatever a reader says of it: it cannot be read
        return {"of the log lost": float("inf"), "unreadable logs": 1.0}
    finally:
        shutil.rmtree(copy.parent)


def disk_full(rig: Rig, random: Random) -> Sample:
    filler = rig.run_dir / "filler"
    if shutil.disk_usage(rig.run_dir).total > SMALL_DISK_BYTES:
        raise Stuck(f"{rig.run_dir} is on a disk too large to be filled up: only root can mount a small one")
    ns, now_unix_ns = time.monotonic_ns(), time.time_ns()
    with filler.open("wb", buffering=0) as file:
        for step in (1 << 20, 4096):  # reserved, not written: writing would keep the machine busy for a second
            with suppress(OSError):
                for at in itertools.count(os.fstat(file.fileno()).st_size, step):
                    os.posix_fallocate(file.fileno(), at, step)
    alert_s = rig.alert_s(ns, "log stopped")
    time.sleep(1.0)
    figures = {"alert": alert_s, GAP: _gap_s(rig, ns), LEFT: left(rig, ns)}
    filler.unlink()
    figures |= _read_back(_log(rig), now_unix_ns)
    rig.signal("groundstation", signal.SIGKILL)
    _another_station(rig)
    return figures


def log_killed(rig: Rig, random: Random) -> Sample:
    now_unix_ns = time.time_ns()
    rig.signal("groundstation", signal.SIGKILL)
    rig.process("groundstation").process.wait()
    figures = _read_back(_log(rig), now_unix_ns)
    _another_station(rig)
    return figures


def _another_station(rig: Rig) -> None:
    rig.restart("groundstation")
    rig.wait(lambda: all(rig.mode(r) is not Mode.TRACKING for r in rig.robots), "robots off their path")


# --- a flood


def flood(rig: Rig, random: Random) -> Sample:
    seed = str(int(random.integers(1 << 30)))
    before = {r: rig.states[r][-1].state.timing.missed_deadlines for r in rig.robots}
    ns = time.monotonic_ns()
    flooder = rig.children.start("flood", "tests.faults.flooding", [rig.address, seed, str(rig.robots[-1])])
    time.sleep(10.0)
    flooder.process.kill()
    flooder.process.wait()
    rig.children.all.remove(flooder)
    steps = sum(len(list(rig.since(r, ns))) for r in rig.robots)
    missed = sum(rig.states[r][-1].state.timing.missed_deadlines - before[r] for r in rig.robots)
    return {
        "share of deadlines missed": missed / max(steps, 1),
        LEFT: left(rig, ns),
        "processes ended": float(len(rig.children.ended())),
    }


# --- a thread that ends


def thread_dead(rig: Rig, random: Random) -> Sample:
    """Of the localizer or the simulator, which then end themselves; of the station's recorder, where the flight goes on and
    the operator is told that the log has stopped."""
    name = str(random.choice(["recorder", "camera", "previews", "gatherer"]))
    if name in ("recorder", "gatherer"):
        ns = rig.signal("groundstation", END_THREAD[name])
        times_s = {"told that the log has stopped": rig.alert_s(ns, "log stopped"), LEFT: left(rig, ns)}
        rig.signal("groundstation", signal.SIGKILL)
        _another_station(rig)
        return times_s
    process = "sim-bridge" if name == "camera" else "localizer"
    ns = rig.break_("thread camera") if name == "camera" else rig.signal(process, END_THREAD[name])
    child = rig.process(process)
    rig.wait(lambda: child.exit_code is not None, f"{process} ended")
    times_s = {"process ended": (time.monotonic_ns() - ns) * 1e-9}
    is_explained = child.exit_code == 1 and f"thread {name} ended" in child.log.read_text()
    if name != "camera":
        times_s["neutral"] = rig.neutral_s(ns)
    rig.restart(process)
    return {**times_s, "ended without a reason": float(not is_explained)}
