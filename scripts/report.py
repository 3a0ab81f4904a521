"""The same as `trackmdp report`."""

import sys

from trackmdp.app.cli import main

if __name__ == "__main__":
    sys.exit(main(["report", *sys.argv[1:]]))
