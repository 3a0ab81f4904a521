"""The same as `trackmdp verify`."""

import sys

from trackmdp.app.cli import main

if __name__ == "__main__":
    sys.exit(main(["verify", *sys.argv[1:]]))
