"""SHELL: the terminal of a program that does its work also where nobody reads what it prints."""

import os
import sys

from rich.console import Console


class Terminal(Console):
    """A console on stdout. When its reader has gone (`| head`), the program goes on without printing."""

    def on_broken_pipe(self) -> None:
        """Print nothing more; the program's end, which flushes stdout, finds nobody missing."""
        self.quiet = True
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, sys.stdout.fileno())
        os.close(nowhere)
