"""Lease of control: one page at a time may command. Pure: time is an argument.

A browser that has stopped taking frames loses control after SILENT_S, so that a closed laptop never keeps others out. The
emergency stop needs no lease.
"""

SILENT_S = 5.0


class ControlLease:
    """Control of the fleet; watchers are numbered from 1."""

    def __init__(self) -> None:
        self.holder = 0  # nobody
        self._heard_s = 0.0

    def ask(self, client: int, now_s: float, over: bool = False) -> bool:
        """Ask for control; True if `client` has it now. It is given when it is free, or with `over` in any case."""
        if over or self.free(now_s) or self.holder == client:
            self.holder, self._heard_s = client, now_s
        return self.holder == client

    def heard(self, client: int, now_s: float) -> None:
        """A sign of life."""
        if client == self.holder:
            self._heard_s = now_s

    def free(self, now_s: float) -> bool:
        """True if no page has control, or its holder went silent."""
        if self.holder and now_s - self._heard_s > SILENT_S:
            self.holder = 0
        return self.holder == 0

    def leave(self, client: int) -> None:
        """Give it back, or be gone."""
        if client == self.holder:
            self.holder = 0
