"""Text for a terminal, a log or a table: control characters that could steer a terminal are shown as escapes.

Names, reasons and log lines come from other programs and from files. An escape sequence in one of them could clear the screen,
set the terminal's title or have it type; a bidirectional mark could make a line read as another one.
"""

_KEPT = "\t\n"
_BIDIRECTIONAL = (0x061C, 0x200E, 0x200F, *range(0x202A, 0x202F), *range(0x2066, 0x206A))
_LINE_ENDS = (0x2028, 0x2029)
_CONTROL = (*range(0x20), *range(0x7F, 0xA0))  # C0, DEL and C1
_ESCAPES = {
    code: f"\\x{code:02x}" if code < 0x100 else f"\\u{code:04x}"
    for code in (*_CONTROL, *_BIDIRECTIONAL, *_LINE_ENDS)
    if chr(code) not in _KEPT
}


def printable(text: str) -> str:
    """The text with every control character but tab and newline escaped: \\x1b, \\u202e."""
    return text.translate(_ESCAPES)
