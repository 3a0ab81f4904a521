"""The log of a run: records episodes of the policies it is given, and never stops the run."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

from trackmdp.config import McapConfig
from trackmdp.config.tree import config_text
from trackmdp.episodes.batch import Episodes
from trackmdp.episodes.layouts import write_layout
from trackmdp.episodes.recover import taken_over
from trackmdp.episodes.simulate import simulate
from trackmdp.episodes.writer import EpisodeWriter
from trackmdp.policies.policy import Policy, PolicyLike
from trackmdp.training.callbacks import Callback, Training
from trackmdp.training.evaluator import Score
from trackmdp.untrusted import reason
from trackmdp.world.group import Subject


class EpisodeLog:
    """`episodes.mcap` in a run's folder.

    When the disk is full, or an episode or the file fails in another way, one line reports it and logging is over; the
    run goes on, and the steps written stay under the `.part` name.

    Args:
        folder: the run's folder.
        world: the world, or recorded tracks, along the held-out ones of which episodes are logged.
        seed: seed of the run, from which each episode's own derives.
        config: text of the run's `config.yaml`.
        layout: write a viewer's layout next to the log.
        policies: resume the log of an earlier process after so many of its policies, and drop the later ones; None
            to begin a new log beside it.
        tell: called with one line where logging is over, or goes on in another file.
    """

    def __init__(
        self,
        folder: Path,
        world: Subject,
        *,
        seed: int,
        config: str,
        layout: bool,
        tell: Callable[[str], None],
        policies: int | None = None,
    ) -> None:
        self._world, self._seed, self._tell = world, seed, tell
        self._writer: EpisodeWriter | None = None
        with self._over_at_failure():
            self.file, self.episodes = folder / "episodes.mcap", 0
            if policies is not None:
                self._take_over(policies)
            if self._writer is None:
                self.file = free_name(self.file)
                facts = {"seed": str(seed)}
                self._writer = EpisodeWriter.of(self.file, world, facts=facts, config=config)
            if layout:
                write_layout(folder / "episodes.layout.json", world)

    @property
    def part(self) -> Path:
        """Where the episodes are until the file is whole."""
        return self.file.with_name(f"{self.file.name}.part")

    def _take_over(self, policies: int) -> None:
        """Resume the log of an earlier process, which was killed (`.part`) or ended in order."""
        part = self.part
        if not policies:  # killed before its first checkpoint: the run begins anew, and all of it is recorded again
            part.unlink(missing_ok=True)
            return
        earlier = self.file.with_name(f"{self.file.name}.earlier")
        written = part if part.exists() else self.file
        # Moved aside, since the log that goes on takes its name; put back below if not all of the policies can be
        # read. It lies there already where a process was killed amid this, whose `.part` is a copy of its beginning.
        if not earlier.exists():
            if not written.exists():
                return
            written.replace(earlier)
        taken = taken_over(earlier, self.file, policies)
        if taken is None:
            earlier.replace(written)
            self._tell(f"{written}: not whole; a new log is begun beside it")
            return
        self._writer, self.episodes = taken, taken.episodes
        earlier.unlink()

    def record(
        self, policy: PolicyLike, facts: Mapping[str, str], episodes: int, *names: str | int
    ) -> None:
        """Simulate and log `episodes` episodes; their seeds are those called (`"episode"`, `names`, 0, 1, ...)."""
        if self._writer is not None:
            with self._over_at_failure():
                made = simulate(self._world, policy, episodes, seed=self._seed, names=names)
                self.add(made, facts)

    def add(self, episodes: Episodes, facts: Mapping[str, str]) -> None:
        """Log simulated episodes; `facts` describes their policy in the log, such as its `label`."""
        if self._writer is not None:
            with self._over_at_failure():
                policy = self._writer.add_policy(facts, episodes.policy)
                for episode in episodes.complete():
                    self._writer.add(replace(episode, number=self.episodes, policy=policy))
                    self.episodes += 1
                self._writer.flush()

    def sync(self) -> None:
        """Put all recorded episodes on the disk."""
        if self._writer is not None:
            with self._over_at_failure():
                self._writer.sync()

    def close(self) -> bool:
        """Finish the file, unless logging is over already; returns whether the file is whole."""
        whole = False
        if self._writer is not None:
            with self._over_at_failure():
                self._writer.finish()
                self._writer, whole = None, True
        return whole

    def abandon(self) -> None:
        """End logging; the steps written stay under the `.part` name."""
        if self._writer is not None:
            self._writer.abandon()
            self._writer = None

    @contextmanager
    def _over_at_failure(self) -> Iterator[None]:
        """If the file fails, report it, and end logging."""
        try:
            yield
        # Any failure: hours of training are worth more than the log of them, and the line gives the reason.
        except Exception as error:
            self._tell(f"{self.part}: {reason(error)}; no more episodes are logged")
            self.abandon()


class EpisodeLogger(Callback):
    """`episodes.mcap`: episodes of the policy at the first evaluation, at every k-th one, and at the last.

    Args:
        cfg: how many episodes of which evaluations.
        folder: of the run.
    """

    name = "episodes"

    def __init__(self, cfg: McapConfig, folder: Path) -> None:
        self._cfg, self._folder = cfg, folder
        self._policies, self._lost, self._counted = 0, "", False

    def on_start(self, trainer: Training) -> None:
        """Open the log; episodes after the last checkpoint of an earlier process are cut off."""
        # Held-out tracks are for the end.
        problem = trainer.problem.selection

        def tell(line: str) -> None:
            self._lost = line
            trainer.console.print(line, markup=False)

        self._log = EpisodeLog(
            self._folder,
            problem,
            seed=trainer.config.seed,
            config=config_text(trainer.config, trainer.folder),
            layout=self._cfg.layout,
            # A resumed run that went on without the log meanwhile has no count of it: what it left is no beginning.
            policies=None if trainer.start.iteration and not self._policies else self._policies,
            tell=tell,
        )

    def on_evaluation(self, trainer: Training, policy: Policy, score: Score) -> None:  # noqa: ARG002
        """Record episodes of this policy where they are due."""
        iteration = trainer.position.iteration
        every = trainer.config.evaluation.every * self._cfg.evaluations
        if iteration == 1 or trainer.due(every):
            facts = {"label": f"iteration {iteration}"}
            self._log.record(policy, facts, self._cfg.episodes, iteration)
            # Also where logging is over: a checkpoint must not depend on how full the disk was.
            self._policies += 1

    def on_checkpoint(self, trainer: Training, file: Path) -> None:  # noqa: ARG002
        """From now on a resumed run counts on the file."""
        self._counted = True

    def on_end(self, trainer: Training) -> None:
        """Finish the file, and report lost parts of it; if the run itself failed, its own line gives the reason."""
        # A run that failed before its first checkpoint begins anew, and removes an unfinished log alone.
        if trainer.error is None or self._counted or trainer.start.iteration:
            self._log.close()
        else:
            self._log.abandon()
        if self._lost and trainer.error is None:
            sys.stderr.write(f"trackmdp train: {self._lost}\n")

    def state_dict(self) -> dict[str, Any]:
        """How many policies were handed to the log; their episodes are on the disk from then on."""
        self._log.sync()
        return {"policies": self._policies}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Resume the log after the policies it held when the state was taken."""
        self._policies = state["policies"]


def free_name(file: Path) -> Path:
    """`file`, or with a number where a log, finished or not, has that name: a log cannot be appended to."""
    number, free = 1, file
    while free.exists() or free.with_name(f"{free.name}.part").exists():
        number += 1
        free = file.with_name(f"{file.stem}-{number}{file.suffix}")
    return free
