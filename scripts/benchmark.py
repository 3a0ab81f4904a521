"""Measure this machine: `python scripts/benchmark.py part=NAME [key=value ...]`.

A part is a module of `scripts/benchmarks`; its function `rows` yields the rows of its table, and the keyword arguments
of `rows` are the options of the part. Without `part` the parts are listed. Words such as `grid.size=20`,
`kernel=drift`, `kernel.persistence=0.7` or `cost.sensor=0.2` describe the world, as in `trackmdp solve`; `threads=N`
sets the torch threads, `out=FILE` also writes the machine and the rows as JSON, after every row.
"""

from __future__ import annotations

import os
import sys

# Before TorchRL and NumPy are imported, which read them: no line for every buffer, and sums that do not depend on the
# number of cores.
os.environ.setdefault("RL_LOGGING_LEVEL", "WARNING")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from benchmarks.words import main

if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
