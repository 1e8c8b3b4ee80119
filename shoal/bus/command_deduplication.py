"""Each command is applied once, and only by the process that it was meant for. Pure.

A process draws a number when it starts (its session). An order names the number of the process that it is for, so what was
recorded in an earlier life is refused, however fresh it looks, and with any heartbeats played back. Within a life
the sender's session and sequence number tell an order that has been dealt with: the same once more gets the answer it got, and
no second effect; an older one is refused.

STOP and DISARM are the exception: they only take power away, and the same once more changes nothing for the worse. They are
looked at whenever they come, from every sender that may command: late, repeated, or meant for an earlier life.
"""

from collections import OrderedDict
from dataclasses import replace

from shoal.messages.codec import Header
from shoal.messages.messages import Command, CommandKind, Reply

ALWAYS_TAKEN = frozenset({CommandKind.STOP, CommandKind.DISARM})  # they only take power away
SENDERS = 4096  # remembered; each station's life and each terminal's order is one


class CommandDeduplicator:
    """The commands that one process has handled, with its replies."""

    def __init__(self, session: int) -> None:
        self._session = session
        self._answered: OrderedDict[int, tuple[int, Reply]] = OrderedDict()  # by sender's session: last sequence and answer

    def known_reply(self, header: Header, command: Command) -> Reply | None:
        """The reply to a command that must not be handled (again); None if it is new and for this process."""
        if command.order in ALWAYS_TAKEN:
            return None
        if command.recipient != self._session:
            return self._refuse(command, "is not for this life of the process: it has been started again since, or never met")
        sequence, reply = self._answered.get(header.session, (0, None))
        if header.sequence == sequence:
            return reply
        if header.sequence < sequence:
            return self._refuse(command, f"is old: order {header.sequence} after {sequence}")
        return None

    def record(self, header: Header, reply: Reply) -> Reply:
        """Record a command as handled. Returns the reply, which names the process that the next command must be for."""
        reply = replace(reply, session=self._session)
        if header.sequence >= self._answered.get(header.session, (0, None))[0]:  # a late STOP makes no other order new again
            self._answered[header.session] = (header.sequence, reply)
            self._answered.move_to_end(header.session)
        if len(self._answered) > SENDERS:
            self._answered.popitem(last=False)
        return reply

    def _refuse(self, command: Command, why: str) -> Reply:
        return Reply(command.robot, False, f"{command.order.name} {why}", session=self._session)
