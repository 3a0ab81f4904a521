"""Blocks with a halo: what they see, what they own, and what the policy put together from their plans is worth."""

from __future__ import annotations

import multiprocessing
import os
import signal
import subprocess
import sys
from concurrent.futures.process import BrokenProcessPool
from contextlib import nullcontext
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy import sparse

import trackmdp as tm
from tests.helpers import later
from tests.typed import ENVIRONMENT, typed
from trackmdp.app.cli import main
from trackmdp.config.compose import compose
from trackmdp.errors import Preempted, UserError
from trackmdp.sensing.coverage import discs
from trackmdp.signals import ENDING, Signals, handled, stop
from trackmdp.solvers import optimal, regions, workers
from trackmdp.solvers.partition import Block, blocks, default_halo, plan_by_blocks, reach, sub_world
from trackmdp.solvers.regions import region_side
from trackmdp.solvers.solve import run_solver
from trackmdp.solvers.workers import Crew, crew, in_turn
from trackmdp.world.model import World


def line(cells: int) -> World:
    """A line of cells; the target moves one to the right with .5, two with .4."""
    kernel = np.diag(np.full(cells - 1, 0.5), 1) + np.diag(np.full(cells - 2, 0.4), 2)
    return World(kernel, (1, cells), cost=np.arange(1, cells + 1) / 100, t_max=1)


def test_blocks_own_every_cell_once_and_see_their_halo() -> None:
    parts = blocks((10, 10), 4, 2)
    assert len(parts) == 9
    assert parts[1] == Block(own=(range(4), range(4, 8)), seen=(range(6), range(2, 10)))
    owned = np.zeros((10, 10), dtype=int)
    for part in parts:
        owned[np.ix_(*part.own)] += 1
    assert (owned == 1).all()


def test_what_leaves_a_rectangle_has_exited() -> None:
    part = sub_world(line(6), (range(1), range(2, 5)))
    assert part.size == (1, 3)
    np.testing.assert_allclose(part.kernel.toarray(), [[0, 0.5, 0.4], [0, 0, 0.5], [0, 0, 0]])
    np.testing.assert_allclose(part.cost, [0.03, 0.04, 0.05])
    assert part.safe_cost == line(6).safe_cost


def test_a_rectangle_has_the_moves_of_the_whole_grid() -> None:
    world = tm.make_world("random_support", size=[7, 9], support_size=4)
    cells = (np.arange(2, 6)[:, None] * 9 + np.arange(3, 8)).ravel()
    part = sub_world(world, (range(2, 6), range(3, 8)))
    assert np.array_equal(part.kernel.toarray(), world.kernel.toarray()[np.ix_(cells, cells)])


def test_states_with_modes_are_cut_to_a_rectangle() -> None:
    """Cell 5 of 4 x 4 has the states 40 to 47 of eight headings; in rows 1 and 2 of columns 1 to 3 it is cell 0."""
    world = tm.make_world("heading", size=4, memory="displacement")
    cells = np.array([5, 6, 7, 9, 10, 11])
    states = (cells[:, None] * 8 + np.arange(8)).ravel()
    part = sub_world(world, (range(1, 3), range(1, 4)))
    assert (part.size, part.modes, part.memory) == ((2, 3), 8, "displacement")
    assert np.array_equal(part.kernel.toarray(), world.kernel.toarray()[np.ix_(states, states)])
    assert (reach(world), default_halo(world)) == (1, 3)
    assert default_halo(world.but(memory="two_displacements")) == 6


def test_blocks_lose_nothing_where_the_mode_is_revealed() -> None:
    world = tm.make_world("heading", size=7, window=2, safe_cost=5.0, reveals=True)
    whole, parts = tm.solve(world), tm.solve(world, block=4)
    alone = tm.solve(world, block=4, sweeps=0)
    assert whole.certified and parts.certified
    for found in (parts, alone):
        assert found.lower == pytest.approx(whole.lower, rel=1e-6)
    assert alone.upper >= whole.lower - 1e-9


def test_plans_of_keys_are_put_together_where_the_mode_is_hidden() -> None:
    """On a line the target goes on with .8, or turns with .1; the last displacement shows where it goes next."""
    kernel = np.zeros((16, 16))
    for cell, mode, chance, after in product(range(8), range(2), (0.8, 0.1), range(2)):
        to = cell + (1, -1)[after]
        if 0 <= to < 8 and (chance == 0.8) == (mode == after):
            kernel[2 * cell + mode, 2 * to + after] = chance
    world = World(kernel, (1, 8), modes=2, cost=0.3, safe_cost=1.0, t_max=0, memory="displacement")
    whole, parts = (tm.solve(world, **by) for by in ({}, {"block": 3}))
    assert parts.table.task.num_keys == world.num_keys
    assert parts.lower == pytest.approx(whole.lower, rel=1e-3)
    assert parts.lower > 1.2 * tm.solve(world.but(memory="cell"), block=3).lower
    assert parts.upper >= whole.lower
    by_itself, apart = tm.solve(world, "qmdp"), tm.solve(world, "qmdp", block=3)
    assert apart.lower == pytest.approx(by_itself.lower, rel=1e-9)


def test_footprints_are_cut_to_a_rectangle() -> None:
    """Of sensors over cells 0 1, over 1 to 4, over 5, and over 3 with .5, the middle two cells are seen by two."""
    covers = np.zeros((4, 6))
    covers[0, :2] = covers[1, 1:5] = covers[2, 5] = 1
    covers[3, 3] = 0.5
    world = World(np.eye(6) / 2, (1, 6), cost=[1, 2, 3, 4], coverage=covers, budget=2)
    part = sub_world(world, (range(1), range(2, 4)))
    assert part.coverage is not None
    np.testing.assert_array_equal(part.coverage.matrix.toarray(), [[1, 1], [0, 0.5]])
    np.testing.assert_array_equal(part.cost, [2, 4])
    assert (part.budget, part.safe_cost) == (2, 10)


@pytest.mark.parametrize(
    "options",
    [
        pytest.param({"budget": 2, "window": 2}, marks=pytest.mark.slow),
        {"spacing": 1, "budget": 1, "window": 3, "t_max": 0},  # wider than the halo of a move
        pytest.param({"spacing": 2}, marks=pytest.mark.slow),
        pytest.param({"spacing": 2, "detection": 0.8, "budget": 2}, marks=pytest.mark.long),
    ],
)
def test_blocks_lose_nothing_with_footprints_and_a_budget(options: dict[str, Any]) -> None:
    spacing = options.pop("spacing", None)
    world = tm.make_world(
        "random_support", size=(8, 7), support_size=4, radius=1, exit_probability=0.02, **options
    )
    if spacing is not None:
        every = np.arange(56)[::spacing]
        covers = discs((8, 7), np.stack(np.divmod(every, 7), axis=1), 1)
        world = world.but(coverage=covers, cost=np.linspace(0.1, 0.3, len(every)))
    whole, parts = tm.solve(world), tm.solve(world, block=3)
    assert whole.lower - parts.lower <= 1e-6 * abs(whole.lower)
    assert parts.upper >= whole.lower - 1e-9
    assert np.diff(parts.table.written.indptr).max() <= (world.budget or world.total_sensors)
    by_itself, apart = tm.solve(world, "qmdp"), tm.solve(world, "qmdp", block=3)
    assert apart.lower == pytest.approx(by_itself.lower, rel=1e-9)


def test_the_reach_is_that_of_the_longest_move() -> None:
    assert reach(line(6)) == 2
    assert default_halo(line(6)) == 6
    kernel = sparse.csr_array(([0.5], ([1], [9])), shape=(16, 16))  # two rows down
    assert reach(World(kernel, 4, cost=0.1, t_max=0)) == 2


@pytest.mark.parametrize(("cost", "t_max"), [(0.16, 1), *later([(0.22, 2)])])
def test_with_the_default_halo_blocks_lose_nothing_and_without_one_they_do(
    cost: float, t_max: int
) -> None:
    world = tm.make_world(
        "random_support", size=14, support_size=5, radius=1, cost=cost, t_max=t_max, safe_cost=8
    )
    whole = tm.solve(world)
    wide = tm.solve(world, block=5)
    assert whole.lower - wide.lower <= 1e-4 * whole.evaluation.expected_length
    with pytest.warns(UserWarning, match="partition.halo=0: below") as said:
        none = tm.solve(world, block=5, halo=0)
    lost = (whole.lower - none.lower) / none.evaluation.expected_length
    assert lost > 0.05
    stated = float(str(said[0].message).split("at most ")[1].split()[0])
    assert lost <= stated + 5e-5


def test_blocks_are_certified_where_the_whole_grid_is() -> None:
    """The clocked bound is .56 a step above the best policy there is: the rest is proved by the whole grid's search."""
    world = tm.make_world("random_walk", size=10, cost=0.4, safe_cost=8)
    whole, parts = tm.solve(world), tm.solve(world, block=5)
    assert whole.certified
    assert parts.certified
    assert parts.lower == pytest.approx(whole.lower, abs=1e-6 * abs(whole.lower))
    assert not tm.solve(world, block=5, sweeps=0).certified  # the blocks alone


def test_blocks_and_regions_without_a_sensor_have_nothing_to_plan(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    cost = np.full((8, 8), np.nan)
    cost[:, 6:] = 0.1
    world = tm.make_world("random_walk", size=8, cost=cost, t_max=0, safe_cost=2.0)
    whole, parts = tm.solve(world), tm.solve(world, block=3)
    with monkeypatch.context() as patch:
        patch.setattr(optimal, "region_side", lambda *_: 2)
        regional = optimal.solve(world)
    for found in (parts, regional):
        assert found.certified
        assert found.lower == pytest.approx(whole.lower, abs=1e-9)
    fence = np.full((28, 28), np.nan)
    fence[0] = 0.1
    # Memory is estimated on the middle of the grid, where there is none.
    assert region_side(tm.make_world("random_walk", size=28, cost=fence, t_max=0)) is None


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:partition.halo=0")
def test_sweeps_over_the_whole_grid_mend_what_blocks_cannot() -> None:
    world = tm.make_world(
        "random_support", size=12, support_size=5, radius=1, cost=0.22, t_max=1, safe_cost=8
    )
    whole, alone = tm.solve(world), tm.solve(world, block=4, halo=0, sweeps=0)
    once, mended = (tm.solve(world, block=4, halo=0, sweeps=sweeps) for sweeps in (1, 10))
    assert alone.lower < once.lower <= mended.lower <= whole.upper + 1e-9
    assert whole.lower - mended.lower <= 5e-4 * whole.evaluation.expected_length
    # no cell's value is lower for it
    assert (mended.evaluation.value - alone.evaluation.value).min() > -1e-9
    # a round that gains nothing is the last one
    rounds: list[int] = []
    again = regions.settled(
        world,
        mended.table,
        4,
        10,
        lambda work, jobs: [rounds.append(len(jobs)), in_turn(work, jobs)][1],
    )
    assert rounds == [9]
    assert again is mended.table


def test_other_solvers_plans_are_left_as_they_are() -> None:
    world = tm.make_world("random_support", size=8, support_size=5, cost=0.22)
    kept = [tm.solve(world, "qmdp", block=4, sweeps=sweeps).lower for sweeps in (0, 5)]
    assert kept[0] == kept[1]


def test_the_policy_of_blocks_is_bounded_on_the_whole_grid() -> None:
    world = tm.make_world("random_support", size=12, support_size=5, cost=0.16, safe_cost=16)
    found, whole = tm.solve(world, block=6), tm.solve(world)
    assert found.certified
    assert found.lower == pytest.approx(whole.lower, abs=1e-9)
    assert np.array_equal(found.table.sets.indices, whole.table.sets.indices)  # type: ignore[union-attr]


def test_two_workers_find_the_same_bytes_as_one() -> None:
    cfg = compose("solve", {"partition.block": 4, "grid.size": 8})
    world = tm.make_world("random_support", size=8, support_size=5, cost=0.22)
    alone = run_solver(world, cfg.solver, None, cfg.partition).table.sets
    cfg.partition.workers = 2
    together = run_solver(world, cfg.solver, None, cfg.partition).table.sets
    assert alone is not None
    assert together is not None
    assert alone.indices.tobytes() == together.indices.tobytes()
    assert alone.indptr.tobytes() == together.indptr.tobytes()


def test_no_more_workers_are_started_than_there_are_blocks(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[int] = []

    def noted(workers: int, cluster: str | None) -> nullcontext[Crew]:
        asked.append(workers)
        return nullcontext(in_turn)

    monkeypatch.setattr("trackmdp.solvers.solve.crew", noted)
    tm.solve(tm.make_world("random_walk", size=5), block=3, workers=1000)
    assert asked == [4]
    with pytest.raises(
        UserError, match=r"partition.workers=1000000: expected an integer from 1 to 1024"
    ):
        tm.solve(tm.make_world("random_walk", size=5), block=3, workers=1_000_000)


@pytest.mark.parametrize("workers", later([2, 1, 4]))
def test_a_ray_cluster_of_any_size_finds_the_same_bytes(workers: int) -> None:
    pytest.importorskip("ray")
    cfg = compose("solve", {"partition.block": 4, "grid.size": 9})
    world = tm.make_world("random_support", size=9, support_size=5, cost=0.22)
    alone = run_solver(world, cfg.solver, None, cfg.partition).table.sets
    cfg.partition.workers, cfg.partition.cluster = workers, "local"
    spread = run_solver(world, cfg.solver, None, cfg.partition).table.sets
    assert alone is not None
    assert spread is not None
    assert alone.indices.tobytes() == spread.indices.tobytes()
    assert alone.indptr.tobytes() == spread.indptr.tobytes()


@dataclass(frozen=True)
class Counts:
    """Leaves a line each time a number is begun; the first process that gets 2 is killed."""

    folder: Path

    def __call__(self, number: int) -> int:
        with (self.folder / str(number)).open("a") as stream:
            stream.write("begun\n")
        if number == 2 and (self.folder / "2").read_text().count("begun") == 1:
            os.kill(os.getpid(), signal.SIGKILL)
        return number


@pytest.mark.slow
def test_a_killed_worker_of_a_cluster_costs_its_own_job_alone(tmp_path: Path) -> None:
    pytest.importorskip("ray")
    with crew(2, "local") as run:
        assert run(Counts(tmp_path), range(6)) == [*range(6)]
    begun = {number: (tmp_path / str(number)).read_text().count("begun") for number in range(6)}
    assert begun == {0: 1, 1: 1, 2: 2, 3: 1, 4: 1, 5: 1}


@dataclass(frozen=True)
class Dies:
    """Squares a number; the first process that gets 2 is killed, as for lack of memory, and any that gets 3."""

    folder: Path
    always: bool = False

    def __call__(self, number: int) -> int:
        mark = self.folder / "killed"
        if number == 2 and (self.always or not mark.exists()):
            mark.touch()
            os.kill(os.getpid(), signal.SIGKILL)
        if number == 9:
            raise UserError("nine")
        return number * number


@pytest.mark.parametrize("cluster", later([None, "local"]))
def test_what_a_killed_worker_had_is_done_again(tmp_path: Path, cluster: str | None) -> None:
    if cluster:
        pytest.importorskip("ray")
    with crew(2, cluster) as run:
        assert run(Dies(tmp_path), range(5)) == [0, 1, 4, 9, 16]
        assert (tmp_path / "killed").exists()
        with pytest.raises(UserError, match="nine"):
            run(Dies(tmp_path), [9])
        # an error of a job leaves the others' workers as they were
        assert run(Dies(tmp_path), [3]) == [9]


@dataclass(frozen=True)
class Saves:
    """As a learner does, hears the signal, saves and ends; the first job tells `parent`, who began it."""

    folder: Path
    parent: int
    kind: signal.Signals

    def __call__(self, number: int) -> None:
        with Signals() as signals:
            (self.folder / f"{number} begun").touch()
            if number == 0:
                os.kill(self.parent, self.kind)
            while not signals.heard():
                pass
            (self.folder / f"{number} saved").touch()
            raise Preempted(signals.received)


@pytest.mark.parametrize(
    ("cluster", "kind"),
    later([(None, signal.SIGTERM), (None, signal.SIGUSR1), ("local", signal.SIGTERM)]),
)
def test_a_signal_ends_all_workers_and_none_begins_another_job(
    tmp_path: Path, cluster: str | None, kind: signal.Signals
) -> None:
    if cluster:
        pytest.importorskip("ray")

    def end(number: int, frame: object) -> None:
        raise Preempted(number)

    with handled(end, kind), pytest.raises(Preempted) as told, crew(2, cluster) as run:
        run(Saves(tmp_path, os.getpid(), kind), range(6))
    assert told.value.signal == kind
    # the other worker may have been told before it began
    left = {file.name for file in tmp_path.iterdir()}
    assert left in ({"0 begun", "0 saved"}, {"0 begun", "0 saved", "1 begun", "1 saved"})


@pytest.mark.parametrize("kind", [signal.SIGINT, *ENDING])
def test_what_comes_while_workers_start_is_heard_afterwards(kind: signal.Signals) -> None:
    reached = []
    with handled(stop, kind), pytest.raises(Preempted) as told, workers.starting():
        signal.raise_signal(kind)
        blocked = signal.pthread_sigmask(signal.SIG_BLOCK, [])
        reached.append(blocked)
    assert told.value.signal == kind
    assert reached == [
        {signal.SIGINT, signal.SIGUSR1, signal.SIGHUP}
    ]  # which a worker inherits; by SIGTERM it is ended
    assert not signal.pthread_sigmask(signal.SIG_BLOCK, [])


@pytest.mark.skipif(not Path("/proc").is_dir(), reason="needs /proc")
def test_pythons_tracker_of_semaphores_does_not_die_of_the_groups_signals() -> None:
    """Its start, the first of all, unblocks Ctrl-C: the workers after it must not inherit that."""
    code = """
import signal
from multiprocessing.resource_tracker import _resource_tracker as tracker
from pathlib import Path
from trackmdp.solvers.workers import starting
with starting():
    tracker.ensure_running()
    print(signal.SIGINT in signal.pthread_sigmask(signal.SIG_BLOCK, []))
status = dict(line.split(":") for line in Path(f"/proc/{tracker._pid}/status").read_text().splitlines())
print(bool(int(status["SigBlk"], 16) >> (signal.SIGUSR1 - 1) & 1))
"""
    done = typed(start=("-c", code))
    assert done.stdout.split() == ["True", "True"]


def test_a_signal_is_heard_also_where_a_worker_dies_of_it_first() -> None:
    with handled(stop, signal.SIGTERM), pytest.raises(Preempted), workers.starting():
        signal.raise_signal(signal.SIGTERM)
        raise BrokenProcessPool


@pytest.mark.slow
def test_a_worker_may_die_while_jobs_are_handed_out(tmp_path: Path) -> None:
    def job(number: int) -> int:
        # the pool ends all of its workers once one has died
        while number == 4 and multiprocessing.active_children() and not gone:
            pass
        gone.extend([True] if number == 4 else [])
        return number

    gone: list[bool] = []
    with crew(2) as run:
        assert run(Dies(tmp_path), workers.Made(6, job)) == [0, 1, 4, 9, 16, 25]
    assert gone and (tmp_path / "killed").exists()


@pytest.mark.slow
def test_a_job_that_kills_every_worker_ends_in_one_line(tmp_path: Path) -> None:
    with crew(2) as run, pytest.raises(UserError, match="workers died 3 times"):
        run(Dies(tmp_path, always=True), [2])


@pytest.mark.slow
def test_a_script_that_workers_run_anew_ends_in_one_line(tmp_path: Path) -> None:
    script = tmp_path / "script.py"
    lines = (
        "import trackmdp as tm",
        'world = tm.make_world("random_walk", size=5)',
        "tm.solve(world, block=3, workers=2)",
    )
    script.write_text("\n".join(lines))
    done = subprocess.run(
        [sys.executable, script], env=ENVIRONMENT, capture_output=True, text=True, check=False
    )
    assert done.returncode == 1
    assert done.stderr.count("Traceback") == 1
    assert done.stderr.splitlines()[-1] == (
        "trackmdp.errors.UserError: partition.workers=2: each worker runs your script anew, expected its calls below "
        'if __name__ == "__main__":'
    )


def test_ctrl_c_in_one_block_ends_the_solve(monkeypatch: pytest.MonkeyPatch) -> None:
    def search(_: object) -> None:
        searched.append(1)
        raise KeyboardInterrupt

    searched = list[int]()
    monkeypatch.setattr("trackmdp.solvers.optimal._Run.search", search)
    with pytest.raises(KeyboardInterrupt):
        tm.solve(tm.make_world("random_walk", size=10, cost=0.4), block=5)
    assert len(searched) == 1


def test_a_policy_of_another_grid_cannot_be_put_together() -> None:
    def whole(number: int, world: World) -> tm.Policy:
        return tm.Policy.all_on(tm.make_world(size=8))

    with pytest.raises(
        UserError, match="policy: made for 8 x 8 cells, t_max 1; expected 7 x 7 cells, t_max 1"
    ):
        plan_by_blocks(tm.make_world(size=8), whole, 4)


def test_a_policy_that_draws_cannot_be_put_together() -> None:
    def half(number: int, world: World) -> tm.Policy:
        return tm.Policy(world, probability=0.5)

    with pytest.raises(UserError, match="does not draw"):
        plan_by_blocks(tm.make_world(size=8), half, 4)


def test_blocks_on_the_command_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["solve", "grid.size=8", f"hydra.run.dir={tmp_path / 'a'}"]
    assert main([*words, "partition.block=4", "partition.halo=1"]) == 0
    assert "warning: partition.halo=1: below 3, so blocks" in " ".join(
        capsys.readouterr().out.split()
    )
    assert main([*words, "partition.halo=1"]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert "partition.halo=1: without effect without partition.block" in error
