"""The command ``torchptz``. Every command is a library function; this file only talks.

Exit codes: 0 everything succeeded; 1 a part failed, the rest is there; 2 nothing succeeded, or the
command was called wrongly; 130 interrupted.
"""

from torchptz.cli.commands import main

__all__ = ["main"]
