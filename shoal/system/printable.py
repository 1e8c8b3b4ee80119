"""Text of others for a terminal and a log: control characters are shown, not obeyed. Pure."""

import re

# C0 and C1 controls (an escape sequence begins with one), marks that turn the direction of writing, and separators of lines
_UNPRINTABLE = re.compile(r"[\x00-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028\u2029\u202a-\u202e\u2066-\u2069\ud800-\udfff]")


def printable(text: str) -> str:
    """The text in one line: whatever a terminal would act on is written as Python escapes it."""
    return _UNPRINTABLE.sub(lambda match: match[0].encode("unicode_escape").decode("ascii"), text)


def printable_lines(text: str) -> str:
    """`printable` of each line, as of a traceback."""
    return "\n".join(map(printable, text.split("\n")))
