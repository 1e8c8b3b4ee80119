"""One complete control step, closed loop: the nonlinear MPC, and the article's linear one with our solver and with peers'.

Peers solve the very same quadratic programs (do-mpc: the same task as a nonlinear program, beside which stands ours), each in
an environment of its own.
"""

from collections.abc import Iterator
from dataclasses import asdict

from benchmarks.harness import Row, run_peer
from benchmarks.robot_agent.control_loop import Case, fly

BENCHMARK = "control_step"
STEPS, PEER_STEPS = 3000, 300
CASES = [
    Case(setting, neighbours, beside)
    for setting in ("article's", "default")  # the linear program, and the nonlinear one
    for neighbours, beside in ((0, False), (2, False), (5, False), (2, True))
]
PEER_CASES = [case for case in CASES if case.neighbours == 2 and not case.beside]
OURS = ["numpy", "scipy", "osqp", "numba", "protobuf", "pydantic", "tomli_w", "typer", "rich"]
PEERS = {
    "control_cvxpy": ["cvxpy"],
    "control_qpsolvers": ["qpsolvers[osqp]"],
    "control_qpoases": ["casadi"],
    "control_dompc": ["do-mpc", "casadi"],
}


def run() -> Iterator[Row]:
    """Ours in every case, peers with two neighbours."""
    for case in CASES:
        yield from fly(case, STEPS).rows(BENCHMARK, str(case), "ours")
        if case.setting != "default" and case in PEER_CASES:
            for peer, needs in PEERS.items():
                yield from run_peer(peer, [*OURS, *needs], {"case": asdict(case), "steps": PEER_STEPS})
