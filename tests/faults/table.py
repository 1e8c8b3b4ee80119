"""The table of faults: what is measured of each, and what it must not exceed."""

from tests.faults import rows_alone, rows_cameras, rows_network, rows_robot, rows_sight, rows_station, rows_strangers
from tests.faults.row import LEFT, RESUMED, SECONDS, STEP_S, TIMES, FaultRow, Measure
from tests.flights.broken_thrusters import LACKING_N

STATION_LOST = {
    "hold": SECONDS(1.0 + STEP_S),
    "neutral": SECONDS(3.0 + STEP_S),
    "disarmed": SECONDS(10.0 + STEP_S),
    RESUMED: TIMES(),
}

ROWS: tuple[FaultRow, ...] = (
    FaultRow(
        "localizer-killed", "SIGKILL",
        {"hold after the last pose": SECONDS(0.2), "neutral": SECONDS(0.5), "alert": SECONDS(0.3)},
        rows_sight.localizer_killed,
    ),
    FaultRow(
        "localizer-hung", "SIGSTOP, and SIGCONT when all are neutral",
        {"hold after the last pose": SECONDS(0.2), "neutral": SECONDS(0.5), "alert": SECONDS(0.3), RESUMED: TIMES()},
        rows_sight.localizer_hung,
    ),
    FaultRow(
        "camera-frozen", "the same picture with new stamps",
        {"hold": SECONDS(0.45), "neutral": SECONDS(0.75), "alert": SECONDS(0.55), RESUMED: TIMES()}, rows_sight.camera_frozen,
    ),
    FaultRow(
        "lamp-switched", "half or twice the light for 6 s",
        {"hold": SECONDS(1.0), "blind told": SECONDS(1.0), rows_sight.TRACKS: TIMES()},
        rows_sight.lamp_switched, times=5,
    ),
    FaultRow(
        "camera-bumped", "the picture moves by 60 to 118 pixels, for 6 s",
        {"hold": SECONDS(1.0), rows_sight.TRACKS: TIMES()},
        rows_sight.camera_bumped, times=5,
    ),
    FaultRow(
        "camera-bumped-of-two",
        "by 23 to 113 pixels, while the other sees all robots",
        {"camera out": SECONDS(0.5), LEFT: TIMES(), rows_cameras.OFF_TRUTH: Measure(0.01, "m")},
        rows_cameras.camera_bumped_of_two, times=10, rig="",
    ),
    FaultRow(
        "camera-bumped-alone", "while it alone sees a robot",
        {"camera out": SECONDS(0.5), "hold": SECONDS(1.0), rows_cameras.OFF_TRUTH: Measure(0.01, "m")},
        rows_cameras.camera_bumped_alone, times=10, rig="",
    ),
    FaultRow(
        "camera-bubbles", "10 to 50 streams for 6 s",
        {LEFT: TIMES(), rows_cameras.OFF_TRUTH: Measure(0.005, "m")}, rows_cameras.camera_bubbles, times=10, rig="",
    ),
    FaultRow(
        "agent-killed", "SIGKILL, restarted",
        {"neutral": SECONDS(0.35), "restarted and not disarmed": TIMES()}, rows_robot.agent_killed,
    ),
    FaultRow(
        "agent-ended", "SIGTERM, restarted",
        {"neutral": SECONDS(0.1), "disarmed": SECONDS(0.1), RESUMED: TIMES()}, rows_robot.agent_ended, times=20, rig="seen",
    ),
    FaultRow(
        "agent-hung", "SIGSTOP, SIGCONT up to 1.6 s later",
        {"neutral": SECONDS(0.35), RESUMED: TIMES()}, rows_robot.agent_hung,
    ),
    FaultRow(
        "solver-stuck", "a solver that never returns",
        {"neutral": SECONDS(0.35)}, rows_robot.solver_stuck, rig="patched",
    ),
    FaultRow(
        "solver-slow", "a solver that takes 30 ms",
        {"neutral": SECONDS(0.35), "alert": SECONDS(0.5)}, rows_robot.solver_slow, rig="patched",
    ),
    FaultRow(
        "solver-unsolved", "no program has a solution",
        {"neutral": SECONDS(0.2 + STEP_S), "shifted plans": TIMES(3)}, rows_robot.solver_unsolved, rig="patched",
    ),
    FaultRow(
        "station-killed", "SIGKILL, with the router",
        {"neutral": SECONDS(3.0), RESUMED: TIMES()}, rows_network.station_killed, times=50,
    ),
    FaultRow(
        "station-alone-killed", "SIGKILL; the router goes on",
        STATION_LOST,
        rows_network.station_alone_killed, times=50, rig="router",
    ),
    FaultRow(
        "station-alone-hung", "SIGSTOP, and SIGCONT when all are disarmed",
        STATION_LOST,
        rows_network.station_alone_hung, times=50, rig="router",
    ),
    FaultRow(
        "partition", "robot 1 cut off, both ways or one way, 1 to 5 s",
        {"neutral": SECONDS(0.5), "neutral, still hearing": SECONDS(3.0), "neighbour's plan expired": SECONDS(0.6),
         RESUMED: TIMES()}, rows_network.partition,
    ),
    FaultRow(
        "partition-short", "robot 1 cut off, 0.2 s",
        {"worse than holding": TIMES()}, rows_network.partition_short,
    ),
    FaultRow(
        "start-late", "robot 2 gets no START for 1.2 s",
        {"timetables apart": SECONDS(0.05)}, rows_network.start_late, times=5, rig="seen-patched",
    ),
    FaultRow(
        "switch-partial", "robot 2 of three gets no SWITCH",
        {"all hold": SECONDS(4.0), "references out of shape": Measure(0.05, "m"),
         "states on an old plan after RESUME": TIMES()},
        rows_network.switch_partial, times=5, rig="detour",
    ),
    FaultRow(
        "link-cut", "nothing passes, both ways",
        {"neutral": SECONDS(0.3), RESUMED: TIMES()}, rows_robot.link_cut,
    ),
    FaultRow(
        "link-garbage", "bit flips, false starts, frames doubled, late, forged, for 2 s",
        {"board in step again": SECONDS(0.25), "agent in step again": SECONDS(0.25)}, rows_robot.link_garbage,
    ),
    FaultRow(
        "board-disobeys",
        f"two outputs are confused; timed while their pulses should be more than {rows_robot.SAME_US} us apart",
        {"neutral": SECONDS(0.9), "alert": SECONDS(0.8), RESUMED: TIMES()}, rows_robot.board_disobeys, times=20,
    ),
    FaultRow(
        "thruster-broken",
        f"dead, stuck, reversed, weak; in still water, off_path_m = 0.1; the flag is timed while {LACKING_N} N are lacking",
        {"flagged": SECONDS(2.0), "neutral after the flag": SECONDS(2 * STEP_S), "estimate off the truth": Measure(0.05, "m"),
         "off its path": Measure(0.15, "m")}, rows_robot.thruster_broken, times=40, rig="still",
    ),
    FaultRow(
        "depth-wrong",
        "it reads 10 m, 0.5 m more, 0.2 m less, or the same for 10 s",
        {"fault": SECONDS(0.5 + STEP_S), "neutral": SECONDS(0.5 + 2 * STEP_S), "true depth off": Measure(0.05, "m"),
         "true depth off, stuck": Measure(0.15, "m"), RESUMED: TIMES()}, rows_robot.depth_wrong, times=10,
        rig="seen",
    ),
    FaultRow(
        "marker-gone", "put back at neutral",
        {"hold": SECONDS(0.45), "neutral": SECONDS(0.75), RESUMED: TIMES()}, rows_sight.marker_gone, times=20,
    ),
    FaultRow(
        "battery-empty", "3.5 V less within 0.6 s",
        {"neutral": SECONDS(3.0), "armed on an empty battery": TIMES()}, rows_robot.battery_empty, times=20,
    ),
    FaultRow(
        "emergency-stop", "2 robots",
        {"all boards neutral": SECONDS(0.15, quantile=0.99), "started while stopped": TIMES()}, rows_network.emergency_stop,
    ),
    FaultRow(
        "emergency-stop-20", "20 robots, 5 steps a second",
        {"all boards neutral": SECONDS(0.15, quantile=0.99), "started while stopped": TIMES()}, rows_network.emergency_stop,
        rig="fleet",
    ),
    FaultRow(
        "emergency-stop-lossy", "the same, 30 % of the boards' traffic lost",
        {"all boards neutral": SECONDS(0.5, quantile=0.99), "started while stopped": TIMES()},
        rows_network.emergency_stop_lossy, rig="fleet",
    ),
    FaultRow(
        "page-frozen", "three pages, SIGSTOP",
        {"longest gap between heartbeats": SECONDS(0.3), LEFT: TIMES()}, rows_station.page_frozen,
        times=3, rig="page",
    ),
    FaultRow(
        "page-events", "two log lines of 4 MB, then a page is opened",
        {"page opens": SECONDS(1.0), "longest gap between heartbeats": SECONDS(0.3), LEFT: TIMES()},
        rows_station.page_events, times=5, rig="page",
    ),
    FaultRow(
        "clock-step", "a clock steps by 1 to 47 hours, and back",
        {LEFT: TIMES()}, rows_station.clock_step, rig="patched",
    ),
    FaultRow(
        "disk-full", "the log's file system is filled up",
        {"alert": SECONDS(2.0), "of the log lost": SECONDS(1.0), "longest gap between heartbeats": SECONDS(0.3),
         "unreadable logs": TIMES(), LEFT: TIMES()},
        rows_station.disk_full, times=20, rig="disk",
    ),
    FaultRow(
        "log-killed", "SIGKILL",
        {"of the log lost": SECONDS(1.0), "unreadable logs": TIMES()}, rows_station.log_killed, times=50, rig="disk",
    ),
    FaultRow(
        "flood", "10,000 malformed or oversized messages a second in robot 2's name",
        {"share of deadlines missed": Measure(0.001, ""), LEFT: TIMES(), "processes ended": TIMES()},
        rows_station.flood, times=10,
    ),
    FaultRow(
        "thread-dead", "a thread of localizer, simulator or recorder, by an exception",
        {"process ended": SECONDS(1.0), "ended without a reason": TIMES(), "neutral": SECONDS(1.5),
         "told that the log has stopped": SECONDS(2.0), LEFT: TIMES()},
        rows_station.thread_dead, times=8, rig="patched",
    ),
    FaultRow(
        "identity-swap", "two robots cross, brush, pursue; markers unreadable",
        {"undetected swaps": TIMES()}, rows_alone.identity_swap, times=1000, rig="",
    ),
    FaultRow(
        "lossy-network",
        "10 % each of the boards' traffic lost, doubled, late by up to 50 ms",
        {"RMS error over that without": Measure(1.5, "")}, rows_alone.lossy_network, times=5, rig="",
    ),
    FaultRow(
        "not-finite",
        "NaN, infinity in poses, plans, sensors, obstacles, past the decoders",
        {"bad pulses, or beliefs": TIMES()}, rows_alone.not_finite, times=1000, rig="",
    ),
    FaultRow(
        "stranger",
        "no certificate, another authority's, expired, revoked, another robot's, a viewer's",
        {"let in, heard or obeyed": TIMES()}, rows_alone.stranger, times=5, rig="",
    ),
    FaultRow(
        "strangers-knock",
        "no certificate: 12 or 200 connections a second, 900 half open, 50 handshakes a second",
        {"stop answered, this machine": SECONDS(1.0), "stop answered": SECONDS(2.0), "agent joins": SECONDS(2.0)},
        rows_strangers.strangers_knock, times=12, rig="",
    ),
    FaultRow(
        "members-flood",
        "up to 1000 sessions of a revoked or viewer's certificate, or 200 handshakes",
        {"stop answered, this machine": SECONDS(1.0), "stop answered": SECONDS(2.0), "agent joins": SECONDS(2.0)},
        rows_strangers.members_flood, times=12, rig="",
    ),
    FaultRow(
        "old-traffic", "recorded orders, live and after restarts",
        {"obeyed": TIMES()}, rows_alone.old_traffic, times=5, rig="",
    ),
    FaultRow(
        "bad-configuration", "an impossible value of any key, in a real process",
        {"refused after": SECONDS(2.0), "started, or not explained": TIMES()}, rows_alone.bad_configuration, rig="",
    ),
)  # fmt: skip
