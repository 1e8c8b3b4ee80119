"""Gains changed in flight, in two steps: TUNE checks and prepares a set, ADOPT names the instant from which it counts.

So a fleet changes together or not at all: no robot flies with a set that another one refused. Gains change between two control
steps, never within one. Pure: time is an argument.
"""

from dataclasses import dataclass

from robot_agent.control.controller import Controller
from shoal.config.controller import ControllerConfig
from shoal.errors import ConfigError
from shoal.messages.live_gains import of_message, tuning
from shoal.messages.messages import Command, CommandKind

Prepared = ControllerConfig | str  # a set that can be flown, or why it cannot; empty: nothing is against it


@dataclass(frozen=True, eq=False)
class Adoption:
    """A set of gains and its beginning: both the instant on our clock and the place along the trajectory must be reached."""

    id: str
    tuned: ControllerConfig
    at_ns: int
    trajectory_s: float


class LiveTuning:
    """The controller's present gains, and the set that is prepared."""

    def __init__(self, controller: Controller, config: ControllerConfig) -> None:
        self.id = tuning(config).id
        self._controller, self._config = controller, config
        self._ready: tuple[str, ControllerConfig] | None = None
        self._adoption: Adoption | None = None

    def prepare(self, command: Command) -> Prepared:
        """Check the set of a TUNE, or return the reason why it cannot be flown; nothing for another command. It changes
        nothing, so it may run beside a step."""
        if command.order is not CommandKind.TUNE:
            return ""
        if command.tuning is None:
            return "carries no gains"
        try:
            return of_message(self._config, command.tuning)
        except ConfigError as error:
            return str(error)

    def objection(self, command: Command, prepared: Prepared) -> str:
        """Return the reason to refuse a TUNE or ADOPT; empty if there is none."""
        if command.order is CommandKind.TUNE and isinstance(prepared, str):
            return prepared
        if command.order is CommandKind.ADOPT and command.tuning_id != self.id:
            ready = self._ready[0] if self._ready is not None else "none"
            if command.tuning_id != ready:
                return f"tuning {command.tuning_id} is not ready (flown: {self.id}, ready: {ready})"
        return ""

    def apply(self, command: Command, prepared: Prepared, given_ns: int) -> None:
        """Keep the `prepared` set of a TUNE, or note the adoption that an ADOPT, given at `given_ns` on our clock, orders.

        There is no objection to the command.
        """
        if command.order is CommandKind.TUNE and command.tuning is not None and isinstance(prepared, ControllerConfig):
            self._ready = command.tuning.id, prepared
        elif command.order is CommandKind.ADOPT and command.tuning_id == self.id:
            self._adoption = None  # this set is flown already: another one that waits is given up
        elif command.order is CommandKind.ADOPT and self._ready is not None:
            ready_id, ready_config = self._ready
            at_ns = given_ns + round(command.start_in_s * 1e9)
            self._adoption = Adoption(ready_id, ready_config, at_ns, command.trajectory_s)

    def leave_run(self) -> None:
        """Forget a set that waits for a later lap: the run is over."""
        if self._adoption is not None and self._adoption.trajectory_s > 0.0:
            self._adoption = None

    def step(self, now_ns: int, reached_s: float) -> None:
        """Change to the adopted set if its time has come. Call it before each control step."""
        wanted = self._adoption
        if wanted is not None and now_ns >= wanted.at_ns and reached_s >= wanted.trajectory_s:
            self._controller.adopt_gains(wanted.tuned)
            self.id, self._adoption = wanted.id, None
            if self._ready is not None and self._ready[0] == wanted.id:  # else a later one has been prepared since
                self._ready = None
