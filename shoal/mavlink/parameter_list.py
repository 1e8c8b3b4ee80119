"""Parameters as a thruster board tells them, one by one in any order, and the requests for those missing. Sans-IO."""

import math
from typing import Any

from pymavlink.dialects.v20 import common as dialect

ASKED_AT_ONCE = 8  # that are missing: answers go out at once, and must not crowd out telemetry


class ParameterList:
    """The values that a board has reported, by name."""

    def __init__(self) -> None:
        self.values: dict[str, float] = {}
        self.value_count = 0  # values that came, the same again too
        self.count: int | None = None  # of all; None before the first of the list
        self._by_index: dict[int, str] = {}

    def note_value(self, message: Any) -> None:
        """Take in a PARAM_VALUE. One that is no number is ignored."""
        if not math.isfinite(message.param_value):
            return
        if message.param_index < message.param_count:  # many a firmware answers a name without its place in the list: 65535
            self.count = message.param_count
            self._by_index[message.param_index] = message.param_id
        self.values[message.param_id] = message.param_value
        self.value_count += 1

    @property
    def is_complete(self) -> bool:
        """True if every parameter has come."""
        return self.count is not None and len(self._by_index) == self.count

    def requests(self, robot: int, component: int) -> list[Any]:
        """The messages that ask for all, or for those that are still missing of a list that has begun to come."""
        if self.count is None:
            return [dialect.MAVLink_param_request_list_message(robot, component)]
        missing = [index for index in range(self.count) if index not in self._by_index]
        ask = dialect.MAVLink_param_request_read_message
        return [ask(robot, component, b"", index) for index in missing[:ASKED_AT_ONCE]]
