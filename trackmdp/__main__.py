"""`python -m trackmdp train` is `trackmdp train`."""

from __future__ import annotations

import signal
import sys


def command_line() -> int:
    """Run `trackmdp.app.cli.main`; before and after it, Ctrl-C ends the process without a traceback."""
    # Another handler stays: behind `nohup` the signal is ignored.
    default = signal.getsignal(signal.SIGINT) is signal.default_int_handler
    if default:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    from trackmdp.app import cli
    from trackmdp.errors import INTERRUPTED

    try:
        if default:
            signal.signal(signal.SIGINT, signal.default_int_handler)
        return cli.main()
    except KeyboardInterrupt:  # beside the command itself, which reports it
        return INTERRUPTED
    finally:
        if default:
            signal.signal(signal.SIGINT, signal.SIG_DFL)


if __name__ == "__main__":
    sys.exit(command_line())
