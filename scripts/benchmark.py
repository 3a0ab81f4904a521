"""The same as `trackmdp benchmark`."""

import sys

from trackmdp.app.cli import main

if __name__ == "__main__":
    sys.exit(main(["benchmark", *sys.argv[1:]]))
