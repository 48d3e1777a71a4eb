"""The one exception a user is meant to read."""

from __future__ import annotations


class UserError(ValueError):
    """Bad input from outside: one sentence that names the value, where it came from and the mend.

    The command line prints the message alone and exits with status 2; library callers catch it as a ValueError.
    """
