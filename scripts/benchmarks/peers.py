"""Other projects' training scripts beside our learners, in the same world and on the same core."""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy import sparse

import trackmdp as tm
from benchmarks.clock import Usage, measured, on_one_core
from benchmarks.words import Row, world_of
from trackmdp.errors import UserError

GOAL = 0.02
"""Regret per step that the learners are timed to."""


OURS = Path(__file__).parents[1] / "peers/ours.py"


@dataclass(frozen=True)
class Learned:
    """One training run.

    Attributes:
        learner: its name.
        seed: of the run.
        curve: CPU seconds since the process began, env steps and regret per step of each policy on the way. Learning
            begins with the first.
        usage: of the process.
    """

    learner: str
    seed: int
    curve: Sequence[tuple[float, int, float]]
    usage: Usage

    def reached(self, *, settled: bool) -> tuple[float, int] | tuple[None, None]:
        """Seconds and env steps at which the regret was `GOAL` or less: first, or `settled` to the end; or None."""
        within = [regret <= GOAL for _, _, regret in self.curve]
        # "Settled": no later policy is worse than the goal. A curve that touches the goal once by luck has not learned.
        places = [p for p, found in enumerate(within) if (all(within[p:]) if settled else found)]
        return self.curve[places[0]][:2] if places else (None, None)


def rows(
    words: Mapping[str, str],
    seeds: tuple[int, ...] = (0, 1, 2),
    algos: tuple[str, ...] = ("model_based", "hindsight", "ppo", "a2c"),
    peers: str = "scripts/peers",
    peers_seconds: float = 180.0,
) -> Iterator[Row]:
    """One row for each seed and learner; our learners and the peers take turns on one core, with one thread.

    The clock of a learner is the CPU time of its process, imports and compilation included; `learning_seconds` are
    without these. Every policy on the way is valued exactly, by the same code. Our learners, `algos`, have their
    default budgets, a peer learns for `peers_seconds`; `times_first` compares `settled_seconds` with the first of
    `algos`.

    A peer is a script `<name>_peer.py` in the folder `peers`; `scripts/peers/track.py` describes its arguments and its
    record. It runs under `.venv-<name>/bin/python` of that folder where there is one, else under this interpreter.

    Raises:
        UserError: `peers` is no folder with such scripts.
    """
    scripts = sorted(Path(peers).glob("*_peer.py"))
    if not scripts:
        raise UserError(f"peers={peers}: expected a folder with scripts called <name>_peer.py")
    world = world_of(words)
    solved = tm.solve(world)
    length = solved.evaluation.expected_length  # no policy changes it
    learners = [(f"trackmdp {algo}", OURS, ("--algo", algo)) for algo in algos]
    for script in scripts:
        name = f"{script.stem.removesuffix('_peer')} ppo"
        learners.append((name, script, ("--seconds", str(peers_seconds))))
    with on_one_core(), tempfile.TemporaryDirectory() as folder:
        instance, record = Path(folder, "instance.npz"), Path(folder, "record.npz")
        # A peer runs without this package, and gets the world as plain arrays.
        arrays = {
            key: getattr(world, key) for key in ("size", "cost", "safe_cost", "reward", "t_max")
        }
        np.savez_compressed(instance, kernel=world.kernel.toarray(), **arrays)
        # Seed by seed, all learners in turn: a machine that slows down in between slows all of them.
        for seed in seeds:
            first = None
            for name, script, own in learners:
                typed = (str(instance), str(record), "--seed", str(seed), *own)
                usage = measured(*typed, script=str(script), python=_python(script))
                values = _values(world, record)
                curve = [
                    (at, steps, (solved.upper - aihtr) / length) for at, steps, aihtr in values
                ]
                run = Learned(name, seed, curve, usage)
                first = first or run
                yield _row(run, first)


def _python(script: Path) -> str:
    own = script.parent / f".venv-{script.stem.removesuffix('_peer')}/bin/python"
    return str(own.absolute()) if own.exists() else sys.executable


def _values(world: tm.World, record: Path) -> Iterator[tuple[float, int, float]]:
    """Seconds, env steps and exact AIHTR of the policies of a record."""
    # `[M (t_max + 1), M]`: for each located cell and number of misses n the sensors that are on, 8 to a byte.
    shape = (world.num_cells * (world.t_max + 1), world.num_cells)
    # A pickle in a peer's record would be code, run in this process.
    with np.load(record, allow_pickle=False) as stored:
        columns = (stored["seconds"].tolist(), stored["steps"].tolist(), stored["sets"])
    for at, steps, bits in zip(*columns, strict=True):
        sets = np.unpackbits(bits, count=shape[0] * shape[1]).astype(bool).reshape(shape)
        policy = tm.Policy(world.task, sparse.csr_array(sets))
        yield at, steps, tm.evaluate(world, policy).aihtr


def _row(run: Learned, first: Learned) -> Row:
    base = first.reached(settled=True)[0]
    reached, frames = run.reached(settled=False)
    settled, steps = run.reached(settled=True)
    return {
        "learner": run.learner,
        "seed": run.seed,
        "goal": GOAL,
        "first_seconds": reached,
        "first_steps": frames,
        "settled_seconds": settled,
        "settled_steps": steps,
        "learning_seconds": settled - run.curve[0][0] if settled else None,
        "times_first": settled / base if base and settled else None,
        "last_regret": run.curve[-1][2],
        "cpu_seconds": run.usage.cpu_seconds,
        "peak_mib": run.usage.peak_mib,
        "curve": {
            "seconds": [row[0] for row in run.curve],
            "regret": [row[2] for row in run.curve],
        },
    }
