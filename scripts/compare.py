"""The same as `trackmdp compare`."""

import sys

from trackmdp.app.cli import main

if __name__ == "__main__":
    sys.exit(main(["compare", *sys.argv[1:]]))
