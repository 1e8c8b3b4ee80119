"""The mission's stages: phases that give every robot one order until all obey. Pure."""

from collections.abc import Callable
from dataclasses import dataclass

from groundstation.mission.state_machine import Phase
from wire.messages.messages import Mode, Order

ARMED = frozenset({Mode.ARMED, Mode.HOLDING})
LIVE = ARMED | {Mode.TRACKING}


@dataclass(frozen=True)
class Stage:
    """What is asked for, and when a robot has done it."""

    order: Order
    obeyed: Callable[[Mode | None, bool], bool]  # (mode, None if not known; trajectory loaded) -> done


STAGES: dict[Phase, Stage] = {
    Phase.LOADING: Stage(Order.LOAD, lambda mode, loaded: loaded),
    Phase.ARMING: Stage(Order.ARM, lambda mode, loaded: mode in ARMED),
    Phase.STARTING: Stage(Order.START, lambda mode, loaded: mode is Mode.TRACKING),
    Phase.RESUMING: Stage(Order.RESUME, lambda mode, loaded: mode is Mode.TRACKING),
    Phase.RELOADING: Stage(Order.LOAD, lambda mode, loaded: loaded),
    Phase.REARMING: Stage(Order.ARM, lambda mode, loaded: mode in ARMED),
    Phase.RELEASING: Stage(Order.START, lambda mode, loaded: mode is Mode.TRACKING),
    Phase.ENDING: Stage(Order.DISARM, lambda mode, loaded: mode is Mode.DISARMED),
    Phase.CLEARING: Stage(Order.CLEAR_STOP, lambda mode, loaded: mode is not None and mode not in LIVE | {Mode.STOPPED}),
    Phase.ABORTING: Stage(Order.DISARM, lambda mode, loaded: mode is not None and mode not in LIVE),
    Phase.TEST_ARMING: Stage(Order.ARM, lambda mode, loaded: mode is Mode.ARMED),
    Phase.TEST_ENDING: Stage(Order.DISARM, lambda mode, loaded: mode is Mode.DISARMED),
}
