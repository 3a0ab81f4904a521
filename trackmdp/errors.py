"""The one exception that stands for a user's mistake."""

from __future__ import annotations


class UserError(ValueError):
    """A mistake in what the user typed or handed over; the message says what, where and what was expected.

    The command line prints the message as one line and exits with status 2. It is a `ValueError`, never
    `SystemExit`, so that one bad job does not end a whole Hydra sweep.
    """
