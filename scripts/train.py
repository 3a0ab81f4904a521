"""The same as `trackmdp train`."""

import sys

from trackmdp.app.cli import main

if __name__ == "__main__":
    sys.exit(main(["train", *sys.argv[1:]]))
