"""Learning by blocks: each block is a run of its own, in a folder of its own, and the whole grid values the policies.

A block collects and learns in its own cells and its halo, where leaving them is the exit (`solvers/partition`).
Its targets start in all of these cells alike, so that every block gets its share of the frames. Finished blocks are
not learned again on resume, and a block that was interrupted goes on from its own checkpoint.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from rich.console import Console

from trackmdp.algos.estimates.alike import cell_classes
from trackmdp.config import TrainConfig, load_run_config
from trackmdp.config.compose import compose
from trackmdp.config.learning import AlgoConfig, file_of_classes
from trackmdp.durable import own_folder, write_bytes, write_json
from trackmdp.errors import UserError
from trackmdp.policies.policy import Policy
from trackmdp.seeding import derive, preserved_global_rng
from trackmdp.signals import HEARD, handled, stop
from trackmdp.solvers.partition import (
    Block,
    default_halo,
    narrow_halo,
    plan_by_blocks,
    sensing_blocks,
)
from trackmdp.solvers.workers import crew
from trackmdp.training.callbacks import Callback, Learning, Position
from trackmdp.training.display import make_console
from trackmdp.training.evaluator import Score
from trackmdp.training.folders import SUMMARY, finished, read_summary
from trackmdp.training.group_run import evaluator_of
from trackmdp.training.inputs import identity, problem_of, with_own_classes, words_of, write_inputs
from trackmdp.training.lock import locked
from trackmdp.training.run import complete, load_run
from trackmdp.training.trainer import Trainer
from trackmdp.world.group import Subject, one_target
from trackmdp.world.model import World
from trackmdp.world.problem import modelled
from trackmdp.world.problem_file import PROBLEM, problem_bytes


def make_trainer(
    problem: Subject,
    config: TrainConfig,
    folder: Path | None,
    console: Console,
    *,
    callbacks: Sequence[Callback] = (),
    nets: Mapping[str, Any] | None = None,
) -> Learning:
    """The trainer of the whole grid, or of its blocks where `partition.block` is set; arguments as for `Trainer`.

    Raises:
        UserError: callbacks or networks are given for blocks, or as `Trainer` raises it.
    """
    if config.partition.block is None:
        return Trainer(
            problem, config, folder=folder, callbacks=callbacks, console=console, nets=nets
        )
    if callbacks or nets:
        what = "callbacks" if callbacks else "actor, critic"
        raise UserError(
            f"{what}: expected none with partition.block, whose blocks may learn in other processes"
        )
    return BlockTrainer(problem, config, folder, console)


class BlockTrainer(Learning):
    """A training run by blocks, begun anew or resumed.

    Learners are given the tasks of their blocks alone. Each block's run is written to `blocks/NUMBER` in the folder.

    Attributes:
        position: after `run`, the frames of all blocks and their rewards.
    """

    def policy(self) -> Policy:
        """The policy put together from all blocks, once `run` has ended."""
        return self._policy

    def run(self) -> Score:
        """Learn all blocks to the end; returns the score of their policy on the whole grid.

        Raises:
            UserError, Preempted, RunError: as `Trainer.run` of a block.
        """
        world = modelled(one_target(self.problem, "partition.block"), "partition.block")
        cfg, began = self.config.partition, time.monotonic()
        halo, side = default_halo(world) if cfg.halo is None else cfg.halo, cfg.block
        assert side is not None
        parts = sensing_blocks(world, side, halo)
        with ExitStack() as opened:
            place = self.folder or Path(opened.enter_context(TemporaryDirectory()))
            resumed = self.folder is not None and _resumed(self.config, world, place)
            # A block handles signals while it learns; here they end the work between two blocks, and all workers.
            opened.enter_context(handled(stop, *HEARD))
            # Before anything is written: where there is no such cluster, no run has begun.
            run = opened.enter_context(crew(min(cfg.workers, len(parts)), cfg.cluster))
            if self.folder is not None:
                (place / SUMMARY).unlink(missing_ok=True)  # as in `Trainer`
                write_inputs(self.config, world, place, resumed=resumed)
                write_json(place / "plan.json", {"blocks": len(parts)})  # for `watch`
            own_folder(place / "blocks")
            config = with_own_classes(self.config, place) if resumed else self.config
            learner = _BlockLearner(config, place.absolute() / "blocks", parts)
            table = plan_by_blocks(world, learner, side, halo, run)
            ends = [read_summary(learner.place(number)) for number in range(len(parts))]
        earned = sum(end["frames"] * end["while_collecting"]["reward_per_frame"] for end in ends)
        frames = sum(end["frames"] for end in ends)
        self._policy = Policy.from_table(table)
        self.evaluator = evaluator_of(world, self.config.seed)
        self.position = Position(0, frames, time.monotonic() - began, earned)
        score = self.evaluator.score(self._policy)
        if warning := narrow_halo(world, cfg, self.evaluator.upper, score.evaluation):
            self.console.print(f"warning: {warning}")
        return score


def _resumed(config: TrainConfig, problem: Subject, folder: Path) -> bool:
    """Whether the folder holds this run already.

    Raises:
        UserError: it holds another one; its results stay as they were.
    """
    if not (folder / "config.yaml").is_file():
        return False
    saved = load_run_config(folder)
    before = identity(saved, folder, problem_of(saved, folder))
    if before != identity(config, folder, problem):
        raise UserError(
            f"{folder}: holds a run with another config or problem, which cannot change on resume"
        )
    return True


@dataclass(frozen=True)
class _BlockLearner:
    """Learns the policy of a block; picklable, to be sent to workers.

    Attributes:
        config: of the whole run.
        folder: where each block has a folder; on a cluster, one that all workers share.
        parts: all blocks.
    """

    config: TrainConfig
    folder: Path
    parts: list[Block]

    def __call__(self, number: int, world: World) -> Policy:
        folder, console = self.place(number), make_console(self.config.quiet)
        own_folder(folder)
        # The lock of the whole run does not cover it: a block's run may be resumed by itself.
        with locked(folder):
            config = self._config(number, world, folder)
            before = finished(config, folder) is not None
            if not before:
                with preserved_global_rng():
                    complete(Trainer(world, config, folder=folder))
        run = load_run(folder)
        how = "finished before" if before else f"{run.summary['wall_seconds']:.1f} s"
        console.print(
            f"block {number + 1} of {len(self.parts)}: AIHTR {run.evaluation.aihtr:,.2f} in it, {how}"
        )
        return run.policy

    def place(self, number: int) -> Path:
        """The folder of a block."""
        return self.folder / f"{number:05d}"

    def _config(self, number: int, world: World, folder: Path) -> TrainConfig:
        """The config of a block's own run, with the world of the block as its problem."""
        cfg, seen = self.config, sum(len(part.seen[0]) * len(part.seen[1]) for part in self.parts)
        # The frames of the run are shared out by the cells that blocks see, halos included.
        share = -(-cfg.collector.total_frames * world.num_cells // seen)
        given = compose("train", words_of(world, folder))
        return replace(
            cfg,
            seed=derive(cfg.seed, "block", number),
            grid=given.grid,
            kernel=given.kernel,
            cost=given.cost,
            sensor=given.sensor,
            algo=self._algo(number, world, folder),
            collector=replace(
                cfg.collector, total_frames=max(share, cfg.collector.frames_per_batch)
            ),
            optimal=replace(cfg.optimal, enabled=False),
            partition=given.partition,
            resume="auto",
            quiet=True,
        )

    def _algo(self, number: int, world: World, folder: Path) -> AlgoConfig:
        """The algorithm, with the block's part of the classes of cells where a file gives those of the whole grid."""
        algo, size = self.config.algo, self.config.grid.sides
        classes = cell_classes(file_of_classes(algo), size)
        if classes is None:
            return algo
        rows, columns = self.parts[number].seen
        part = classes.reshape(size)[rows.start : rows.stop, columns.start : columns.stop]
        write_bytes(folder / PROBLEM, problem_bytes(world, part.ravel()))
        return replace(algo, share_cells=str(folder / PROBLEM))  # type: ignore[call-arg]
