"""The same as `trackmdp frontier`."""

import sys

from trackmdp.app.cli import main

if __name__ == "__main__":
    sys.exit(main(["frontier", *sys.argv[1:]]))
