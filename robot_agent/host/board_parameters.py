"""Comparison of a thruster board's parameters with those that the experiment asks for. Sans-IO.

A board with another thrust curve, other limits or another age of commands flies otherwise than the controller computes. So the
robot's program reads all parameters of a board that is heard, and refuses to arm until they are those of the experiment. Trims
belong to the board at hand, and HIL mode to a flight on the desk: such differences are listed and do not matter.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass

from shoal.config.experiment import Experiment
from shoal.config.simulation import HIL, TRIMS
from shoal.mavlink.agent_link import AgentLink
from shoal.mavlink.parameter_list import ParameterList

AGAIN_S = 0.5  # between two requests while nothing comes; a list brings a value with each burst
LISTED = 4  # differences in a reason not to arm


@dataclass(frozen=True)
class ParameterDifference:
    """A parameter that the board and the experiment have with different values; None if one of them does not have it."""

    name: str
    board: float | None
    experiment: float | None

    @property
    def matters(self) -> bool:
        """True if a robot must not arm with it. A parameter that only a newer firmware has changes no flight."""
        is_newer = self.experiment is None and not self.name.startswith("CRV")
        return not (is_newer or self.name in TRIMS or self.name in HIL)

    def __str__(self) -> str:
        values = ("none" if value is None else f"{value:.7g}" for value in (self.board, self.experiment))
        return "{} is {} (experiment: {})".format(self.name, *values)


def wanted_parameters(experiment: Experiment) -> dict[str, float]:
    """The parameters that the experiment asks of each board."""
    return experiment.sim.board.parameters(experiment.vehicle)


def compare(board: Mapping[str, float], experiment: Mapping[str, float]) -> list[ParameterDifference]:
    """All differences, those first that matter. Values count as equal if single precision cannot tell them apart."""
    names = dict.fromkeys([*experiment, *board])
    pairs = [ParameterDifference(name, board.get(name), experiment.get(name)) for name in names]
    differences = [pair for pair in pairs if not _is_same(pair.board, pair.experiment)]
    return sorted(differences, key=lambda pair: not pair.matters)


def _is_same(a: float | None, b: float | None) -> bool:
    return a is not None and b is not None and math.isclose(a, b, rel_tol=1e-6, abs_tol=1e-6)


class BoardParameters:
    """The comparison with one board, while its parameters come and change."""

    def __init__(self, wanted: Mapping[str, float]) -> None:
        self._wanted = wanted
        self._compared: tuple[ParameterList, int] | None = None  # what was compared last
        self._changed_s = -math.inf  # when the last value came, or the last request went out
        self.objection = _not_known(ParameterList())  # the reason not to arm; nothing is known before the board has spoken

    def step(self, link: AgentLink, now_s: float) -> bytes:
        """Compare the values that the board has sent so far. Returns the request for all values if some miss and none has
        come for AGAIN_S, else nothing."""
        if not link.telemetry.is_thruster_board:
            return b""
        reported = link.parameters
        if self._compared is None or self._compared[0] is not reported or self._compared[1] != reported.value_count:
            self._changed_s = now_s if reported.value_count else -math.inf
            self._compared, self.objection = (reported, reported.value_count), self._judge(reported)
        if reported.is_complete or now_s - self._changed_s < AGAIN_S:
            return b""
        self._changed_s = now_s
        return link.ask_parameters()

    def _judge(self, reported: ParameterList) -> str:
        """The objection to the parameters that a board reports, or ""."""
        if not reported.is_complete:
            return _not_known(reported)
        differences = [str(difference) for difference in compare(reported.values, self._wanted) if difference.matters]
        if not differences:
            return ""
        more = f" and {len(differences) - LISTED} more" if len(differences) > LISTED else ""
        return (
            f"the thruster board's parameters are not the experiment's: {', '.join(differences[:LISTED])}{more} "
            "(robot-agent check lists all, robot-agent params set changes one)"
        )


def _not_known(reported: ParameterList) -> str:
    """The reason not to arm while a list is not complete."""
    of = f"{len(reported.values)} of {reported.count}" if reported.count else "none"
    return f"the thruster board's parameters are not known yet: {of} so far"
