"""Schema of learning: schedules, algorithms, collectors."""

from __future__ import annotations

from typing import Any

from trackmdp.cluster import ADDRESS
from trackmdp.config.options import (
    BYTES,
    ChoiceConfig,
    Needs,
    NodeConfig,
    Reasons,
    choice,
    count_option,
    nested,
    option,
    refuse,
    share_option,
)

MOST_FRAMES = 10**12
"""Most frames of a run: eleven days at a million frames per second. A larger number is a slip."""

DEVICE = r"auto|cpu|cuda(:\d+)?"
"""Names of devices."""

_PASSES = 6
"""Arrays of hidden units that are held while networks learn of several targets; measured with 20 and 60 of them."""

LEARNING_RATE, ENTROPY = "step size of the optimiser", "weight of the entropy bonus"


class ScheduleConfig(NodeConfig):
    """A number that is `start` up to the fraction `begin` of the run, `end` from `until`, and linear between."""

    start: float = option("value at the start", ge=0, le=1e6)
    end: float = option("value at the end", ge=0, le=1e6)
    begin: float = share_option("where the change begins", unit="fraction of the run")
    until: float = share_option(
        "where the change ends, not before begin", unit="fraction of the run"
    )

    def check(self, key: str, root: Any) -> None:
        """The change does not end before it begins."""
        if self.until < self.begin:
            raise refuse(f"{key}.until", self.until, f"not less than {key}.begin={self.begin}")

    def at(self, progress: float) -> float:
        """The value when the fraction `progress` of the run is over."""
        # `end` first: where begin == until (a jump) the division below would be by zero, and is never
        # reached.
        if progress >= self.until:
            return self.end
        if progress <= self.begin:
            return self.start
        # Example: start 1, end 0.02, begin 0.1, until 0.2: at 0.15 half the way is done, 0.51.
        return self.start + (self.end - self.start) * (progress - self.begin) / (
            self.until - self.begin
        )


class AlgoConfig(ChoiceConfig):
    """Base of the group `algo`: how a policy is learned. The three budgets are the defaults of `collector`.

    The code of a choice is called as ``Learner(task, cfg, iterations=..., seed=..., device=...)``.
    """

    remembers = False
    """Whether it learns policies that remember more than the cell: `task.memory`, modes, `kernel.reveals`."""
    knows_footprints = False
    """Whether sensors may cover several cells."""
    knows_budget = False
    """Whether no more sensors than the budget are on, also while learning."""
    joint = False
    """Whether it learns of several targets together; else of a single one, and plans are merged."""
    plans_at_end = False
    """Whether its last iteration may take longer than all others together."""
    total_frames: int = count_option("env steps the algorithm needs", unit="frames", le=MOST_FRAMES)
    frames_per_batch: int = count_option("env steps per collected batch", unit="frames")
    envs: int = count_option("environments stepped together")


class EveryTaskConfig(AlgoConfig):
    """Base of the algorithms that learn with every memory, revealed mode and footprint."""

    remembers = True
    knows_footprints = True


class NetworkConfig(EveryTaskConfig):
    """Common options of the algorithms with networks that learn from their own sensing."""

    knows_budget = True
    joint = True
    gamma: float = share_option("discount while learning; policies are evaluated undiscounted")
    learning_rate: ScheduleConfig = nested(LEARNING_RATE)
    max_grad_norm: float = option("gradients are clipped to this norm", gt=0)
    hidden: int = count_option("units of the hidden layer of each network", unit="units", le=4096)
    reward_scale: float = option("factor on rewards while learning, in units of cost.reward", gt=0)

    def needs(self, task: Any, root: Any) -> Needs:
        """Two networks and their optimiser; their hidden units for each target of a batch."""
        found, targets = {"algo.hidden": networks(task, self.hidden)}, together(root)
        if targets > 1:
            rows = targets * self.learned_at_once(root)
            found["targets.count"] = _PASSES * rows * self.hidden * BYTES["float32"]
        return found

    def learned_at_once(self, root: Any) -> int:
        """Frames that go through the networks together."""
        return int(root.collector.frames_per_batch)


class ActorCriticConfig(NetworkConfig):
    """Common options of A2C and PPO."""

    gae_lambda: float = share_option("λ of the generalised advantage estimate")
    entropy: ScheduleConfig = nested(ENTROPY)
    critic_coef: float = option("weight of the value loss", ge=0)
    initial_logit: float = option("actor's output bias at the start", unit="logits", ge=-20, le=20)


@choice("algo", "a2c", makes="trackmdp.algos.on_policy:A2C")
class A2cConfig(ActorCriticConfig):
    """Advantage actor-critic, one Bernoulli per sensor, one joint advantage."""


@choice("algo", "ppo", makes="trackmdp.algos.on_policy:PPO")
class PpoConfig(ActorCriticConfig):
    """Proximal policy optimisation, one Bernoulli per sensor, one joint advantage."""

    clip_epsilon: float = option("how far the probability ratio may leave 1", gt=0, lt=1)
    epochs: int = count_option("passes over each collected batch", le=100)
    minibatches: int = count_option("parts each batch is cut into")

    def check(self, key: str, root: Any) -> None:
        """The parts of a batch are of one size."""
        frames = root.collector.frames_per_batch
        # Minibatches of unequal size would weigh their frames unequally in the mean loss.
        if frames % self.minibatches:
            expected = f"a divisor of collector.frames_per_batch={frames}"
            raise refuse(f"{key}.minibatches", self.minibatches, expected)


class PrioritizedConfig(NodeConfig):
    """Prioritised replay: transitions are drawn in proportion to |TD error|^alpha."""

    enabled: bool = option("prioritised instead of uniform replay")
    alpha: float = share_option("how much priorities matter")
    beta: float = share_option("how much the draw is corrected for")

    def ignored(self, root: Any) -> Reasons:
        """Uniform replay has no priorities."""
        return (
            {}
            if self.enabled
            else dict.fromkeys(("alpha", "beta"), "with algo.prioritized.enabled=false")
        )


@choice("algo", "dqn", makes="trackmdp.algos.dqn:DQN")
class DqnConfig(NetworkConfig):
    """Double DQN with a Q that adds up over the sensors."""

    epsilon: ScheduleConfig = nested(
        "probability that a sensor of no use is on at random while collecting; one of use is off the more seldom, the "
        "more prices it is worth"
    )
    n_step: int = count_option("rewards summed before bootstrapping", unit="steps", le=64)
    buffer_size: int = count_option("transitions kept for replay", unit="frames")
    batch_size: int = count_option("transitions per update", unit="frames")
    updates: int = count_option("updates per collected batch", le=10**6)
    target_tau: float = option("share of the target network replaced at each update", gt=0, le=1)
    prioritized: PrioritizedConfig

    def check(self, key: str, root: Any) -> None:
        """The replay buffer has room for a collected batch and for one of updates."""
        frames = root.collector.frames_per_batch
        if self.buffer_size < max(frames, self.batch_size):
            expected = f"at least collector.frames_per_batch={frames} and {key}.batch_size={self.batch_size}"
            raise refuse(f"{key}.buffer_size", self.buffer_size, expected)

    def needs(self, task: Any, root: Any) -> Needs:
        """The replay buffer with two states a transition; the networks."""
        # State and next state, the action's K bits as bools, two float32 and one flag (reward, discount,
        # terminated), an index.
        states = 2 * state_bytes(task, root)
        transition = states + task.num_sensors + 2 * BYTES["float32"] + 1 + BYTES["int64"]
        priority = BYTES["float64"] if self.prioritized.enabled else 0
        return super().needs(task, root) | {
            "algo.buffer_size": self.buffer_size * (transition + priority)
        }

    def learned_at_once(self, root: Any) -> int:
        """Frames that go through the networks together."""
        return self.batch_size


class CollectorConfig(ChoiceConfig):
    """Base of the group `collector`: where the frames come from. One frame is one env step of one environment."""

    total_frames: int = count_option("env steps of the whole run", unit="frames", le=MOST_FRAMES)
    frames_per_batch: int = count_option(
        "env steps per collected batch, a multiple of the number of environments", unit="frames"
    )
    envs: int = count_option("environments stepped together, in each worker")
    device: str = option(
        "device the environments live on", expects="cpu, cuda, cuda:N or auto", pattern=DEVICE
    )

    @property
    def stepped(self) -> int:
        """Environments stepped together, in all workers."""
        return self.envs

    def check(self, key: str, root: Any) -> None:
        """A batch is a whole number of steps of all environments, and a run at least one batch."""
        # Where the collector has the value of the algorithm, the algorithm's option is the one to change.
        batch, frames = (
            f"{'algo' if getattr(root.algo, name) == getattr(self, name) else key}.{name}"
            for name in ("frames_per_batch", "total_frames")
        )
        # A batch is `[B, time]`, B environments for equally many steps: TorchRL would round it up, and the
        # frames collected would not be those of the config.
        if self.frames_per_batch % self.stepped:
            factors = f"{key}.envs" + (f" x {key}.workers" if self.stepped > self.envs else "")
            expected = f"a multiple of {self.stepped} ({factors})"
            raise refuse(batch, self.frames_per_batch, expected)
        if self.total_frames < self.frames_per_batch:
            expected = f"at least {batch}={self.frames_per_batch}"
            raise refuse(frames, self.total_frames, expected)

    def needs(self, task: Any, root: Any) -> Needs:
        """Two batches: one is collected while the other is handed over."""
        number = BYTES["float32"]
        state = state_bytes(task, root)
        frame = 2 * (state + 3) + task.num_sensors + number * (task.num_sensors + 2)
        return {"collector.frames_per_batch": 2 * self.frames_per_batch * frame}


@choice("collector", "single", makes="trackmdp.training.collect:single")
class SingleConfig(CollectorConfig):
    """In the process that learns."""


class WorkersConfig(CollectorConfig):
    """Common options of the collectors with worker processes."""

    workers: int = count_option("worker processes", le=256)
    threads: int = count_option("torch threads of each worker process", unit="threads", le=256)

    @property
    def stepped(self) -> int:
        """Environments stepped together, in all workers."""
        return self.envs * self.workers


@choice("collector", "multi_sync", makes="trackmdp.training.collect:multi_sync")
class MultiSyncConfig(WorkersConfig):
    """In worker processes; every batch waits for all of them. A resumed run starts new episodes."""


@choice("collector", "multi_async", makes="trackmdp.training.collect:multi_async")
class MultiAsyncConfig(WorkersConfig):
    """In worker processes; a batch comes from the first one that is ready. A resumed run starts new episodes."""


@choice("collector", "ray", makes="trackmdp.training.on_ray:ray")
class RayWorkersConfig(WorkersConfig):
    """In workers of a Ray cluster: for one run with environments that need more cores than a machine has.

    On one machine multi_sync does the same for less. For many runs at once take hydra/launcher=ray, for planning one
    large grid partition.cluster.
    """

    address: str | None = option(
        "cluster to join; null = start one on this machine",
        expects="auto, or host:port",
        pattern=ADDRESS,
    )
    cpus_per_worker: float = option("cores of each worker", unit="cores", gt=0)
    gpus_per_worker: float = option("GPUs of each worker", unit="GPUs", ge=0)


def file_of_classes(algo: AlgoConfig) -> str | None:
    """The file that `share_cells` names; None where it is one of its words, or the algorithm has no such option."""
    given: str | None = getattr(algo, "share_cells", None)
    return None if given in ("all", "none") else given


def together(root: Any) -> int:
    """Targets that a run learns of together."""
    return int(root.targets.count) if root.algo.joint else 1


def state_bytes(task: Any, root: Any) -> int:
    """Bytes of one observation: located cell, misses, the key where there is one, the actions since the detection.

    Of several targets cell and misses are those of each, and whether it is in the grid is observed too.
    """
    targets = together(root)
    each = (2 + task.keyed) * BYTES["int64"] + (targets > 1)
    return targets * each + task.num_choices * task.num_sensors


def renewed_table(task: Any) -> int:
    """Bytes of the table by which a policy that is renewed while learning acts: a bit for each key, n and sensor."""
    return task.num_keys * task.num_choices * -(-task.num_sensors // 8)


def networks(task: Any, hidden: int | None) -> int:
    """Bytes of two networks of one hidden layer (256 units where `hidden` is left open), with Adam's two moments."""
    # located cell, n and both at once by number; the history by sensor, as are the outputs
    inputs = task.num_cells * (task.num_choices + 3) + task.num_choices * (task.num_sensors + 1) + 1
    if task.keyed:  # the key, and its shared parts, with n
        inputs += (task.num_keys + 2 * task.num_keys // task.num_cells) * (task.num_choices + 1)
    weights = (256 if hidden is None else hidden) * (inputs + task.num_sensors)
    return 2 * weights * 4 * BYTES["float32"]  # weight, gradient, two moments
