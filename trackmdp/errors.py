"""The one exception that stands for a user's mistake, and the exit statuses."""

from __future__ import annotations

__all__ = ["BUG", "INTERRUPTED", "USER_MISTAKE", "UserError"]

USER_MISTAKE, BUG, INTERRUPTED = 2, 1, 130
"""Exit statuses of a command."""


class UserError(ValueError):
    """A mistake in what the user typed or handed over; the message says what, where and what was expected.

    The command line prints the message as one line and exits with status 2. It is a `ValueError`, never
    `SystemExit`, so that one bad job does not end a whole Hydra sweep.
    """
