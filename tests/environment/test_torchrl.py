"""`TrackEnv` among TorchRL's own parts: what it shows and hides."""

from __future__ import annotations

import copy
import inspect
import io
import pickle
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictSequential
from torchrl.envs import EnvBase, ParallelEnv, SerialEnv, TransformedEnv
from torchrl.envs.transforms import (
    CatFrames,
    CatTensors,
    Compose,
    DTypeCastTransform,
    ExcludeTransform,
    FlattenObservation,
    InitTracker,
    ObservationNorm,
    RenameTransform,
    RewardScaling,
    RewardSum,
    StepCounter,
    Transform,
    VecNormV2,
)
from torchrl.envs.utils import check_env_specs
from torchrl.modules import GRUModule

from tests.helpers import limited, small_world
from tests.tracks import by_hand, recorded
from trackmdp.environment.env import TrackEnv
from trackmdp.environment.observation import ObservationVector
from trackmdp.errors import UserError
from trackmdp.world.group import Group
from trackmdp.world.model import World

OBSERVED = {"last_cell", "steps_since_detection", "action_history"}


@pytest.mark.parametrize("max_steps", [None, 5])
@pytest.mark.parametrize("tracks", [False, True])
def test_the_true_cell_is_in_no_spec_and_no_tensordict(max_steps: int | None, tracks: bool) -> None:
    problem = recorded(by_hand([0, 1, 2], [3, 4])) if tracks else small_world()
    env = TrackEnv(limited(problem, max_steps), 4)
    observed = OBSERVED | ({"step_count"} if max_steps else set())
    assert set(env.observation_spec.keys(True, True)) == observed
    assert not set(env.state_spec.keys(True, True))
    flags = {"done", "terminated", "truncated"}
    shown = {*observed, "action", *flags, *(("next", key) for key in {*observed, "reward", *flags})}
    assert set(env.rollout(3, break_when_any_done=False).keys(True, True)) == shown


def test_what_is_observed_after_a_miss_is_the_same_wherever_the_target_is() -> None:
    """Nine rows, the target of each in a cell of its own; no sensor is on, and none of them exits."""
    world = replace(small_world(), t_max=3, max_steps=9)
    env = TrackEnv(world, 9)
    env.reset()
    there = env.snapshot()
    there["rows"] |= {"place": torch.arange(9), "last_cell": torch.full((9,), 4)}
    rows = env.restore(there)
    for _ in range(3):
        frame = env.step(rows.set("action", torch.zeros(9, 9, dtype=torch.bool)))["next"]
        inside = frame[~frame["terminated"].squeeze(-1)]
        assert len(env.target.unique()) > 2
        assert (inside == inside[:1].expand(len(inside))).all()
        rows = frame.select(*env.observation_spec)


def test_a_step_before_the_first_reset_is_one_line() -> None:
    env = TrackEnv(small_world(), 2)
    with pytest.raises(UserError, match=r"before the first reset, expected env\.reset\(\)"):
        env.step(env.fake_tensordict())


def vector(*more: Callable[[], Transform]) -> Callable[[EnvBase], EnvBase]:
    return lambda env: TransformedEnv(env, Compose(ObservationVector(), *(make() for make in more)))


def several(kind: type[ParallelEnv | SerialEnv]) -> Callable[[EnvBase], EnvBase]:
    return lambda env: kind(2, partial(TrackEnv, small_world(), env.batch_size))


TABLE: dict[str, Callable[[EnvBase], EnvBase]] = {
    "bare": lambda env: env,
    "StepCounter": lambda env: TransformedEnv(env, StepCounter(max_steps=4)),
    "RewardSum": lambda env: TransformedEnv(env, RewardSum()),
    "InitTracker": lambda env: TransformedEnv(env, InitTracker()),
    "RewardScaling": lambda env: TransformedEnv(env, RewardScaling(0.5, 2.0)),
    "VecNorm of the reward": vector(lambda: VecNormV2(in_keys=["reward"], reduce_batch_dims=True)),
    "RenameTransform": lambda env: TransformedEnv(env, RenameTransform(["last_cell"], ["cell"])),
    "ExcludeTransform": lambda env: TransformedEnv(env, ExcludeTransform("action_history")),
    "ObservationVector": vector(),
    "ObservationNorm": vector(lambda: ObservationNorm(loc=0.5, scale=2.0, in_keys=["observation"])),
    "VecNorm": vector(lambda: VecNormV2(in_keys=["observation"], reduce_batch_dims=True)),
    "CatTensors": vector(
        lambda: FlattenObservation(-2, -1, in_keys=["action_history"]),
        lambda: DTypeCastTransform(torch.bool, torch.float32, in_keys=["action_history"]),
        lambda: CatTensors(in_keys=["observation", "action_history"], out_key="all"),
    ),
    "CatFrames": vector(lambda: CatFrames(N=3, dim=-1, in_keys=["observation"])),
    "CatFrames, zeros before": vector(
        lambda: CatFrames(N=3, dim=-1, in_keys=["observation"], padding="constant")
    ),
    "all of them": vector(
        StepCounter, RewardSum, InitTracker, lambda: ExcludeTransform("last_cell", "action_history")
    ),
    "SerialEnv": several(SerialEnv),
    "ParallelEnv": several(ParallelEnv),
}


@pytest.mark.filterwarnings("ignore:Support of VecNormV2 for containers with non-empty batch-size")
@pytest.mark.parametrize("shape", [(), (3,), (2, 2)])
@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=[pytest.mark.slow] * (name == "ParallelEnv")) for name in TABLE],
)
def test_it_works_with(name: str, shape: tuple[int, ...]) -> None:
    """Specs as TorchRL checks them; and 30 steps of the same episodes as without the transform."""
    if name == "ParallelEnv" and shape != (3,):
        pytest.skip("worker processes take seconds to start")
    if name == "CatFrames" and len(shape) > 1:
        # Only by its default padding: `dim = self.dim - _reset.ndim + 1` in `CatFrames._call`
        # (torchrl/envs/transforms/_observation.py) is -2 for a mask [2, 2, 1] and dim=-1, and repeats rows, not frames.
        pytest.skip(
            "TorchRL 0.14.1's CatFrames with padding='same' resets no part of a batch of two dimensions"
        )
    bare = TrackEnv(small_world(), shape, seed=3)
    env = TABLE[name](TrackEnv(small_world(), shape, seed=3))
    try:
        check_env_specs(env, break_when_any_done="both")
        if "Env" not in name and name != "StepCounter":
            bare.restore(
                env.base_env.snapshot() if isinstance(env, TransformedEnv) else env.snapshot()
            )
            actions = torch.rand(30, *shape, 9, generator=torch.Generator().manual_seed(1)) < 0.4
            mine, theirs = (stepped(each, actions) for each in (env, bare))
            assert torch.equal(mine, theirs)
    finally:
        env.close()


def stepped(env: EnvBase, actions: torch.Tensor) -> torch.Tensor:
    """The ends of episodes under given actions."""
    rows, ends = env.reset(), []
    for action in actions:
        frame, rows = env.step_and_maybe_reset(rows.set("action", action))
        ends.append(frame["next", "done"])
    return torch.stack(ends)


def test_a_recurrent_policy_keeps_its_state() -> None:
    """The state of a GRU after a step is that before the next one, and 0 where an episode begins."""
    env = TransformedEnv(
        TrackEnv(limited(small_world(), 4), 3, seed=1), Compose(ObservationVector(), InitTracker())
    )
    gru = GRUModule(
        input_size=env.observation_spec["observation"].shape[-1],
        hidden_size=9,
        in_keys=["observation", "state", "is_init"],
        out_keys=["features", ("next", "state")],
    )
    env.append_transform(gru.make_tensordict_primer())
    check_env_specs(env)
    on = TensorDictModule(lambda features: features > 0, ["features"], ["action"])
    with torch.no_grad():
        frames = env.rollout(20, TensorDictSequential(gru, on), break_when_any_done=False)
    after, before = frames["next", "state"][:, :-1], frames["state"][:, 1:]
    done = frames["next", "done"][:, :-1].squeeze(-1)
    assert done.any() and (before[done] == 0).all()
    assert torch.equal(before[~done], after[~done]) and (after[~done] != 0).any()


def test_the_vector_is_the_state_in_bits() -> None:
    """Cell 4 of nine; one miss of two allowed; the sensors 0 and 8 were on."""
    env = TransformedEnv(TrackEnv(replace(small_world(), t_max=1), ()), ObservationVector())
    env.reset()
    history = torch.zeros(2, 9, dtype=torch.bool)
    history[0, [0, 8]] = True
    state = {
        "last_cell": torch.tensor(4),
        "steps_since_detection": torch.tensor(1),
        "action_history": history,
    }
    made = env.transform(TensorDict(state, []))["observation"]
    assert made.nonzero().squeeze(-1).tolist() == [4, 9 + 1, 12 + 0, 12 + 8]
    assert made.shape == env.observation_spec["observation"].shape == (9 + 3 + 18,)


@pytest.mark.parametrize("how", ["in an environment", "alone"])
def test_of_several_targets_there_is_no_vector(how: str) -> None:
    group = Group([small_world()] * 2)
    with pytest.raises(UserError, match=r"^ObservationVector: .*, expected a task, a world or an"):
        if how == "alone":
            ObservationVector(group)  # type: ignore[arg-type]
        TransformedEnv(TrackEnv(group, 3), ObservationVector()).rollout(2)


def test_its_picture() -> None:
    """A target that stays in cell 1 of 2 x 2: at the start, seen by its sensor, missed, seen by the safe action."""
    world = World(np.eye(4), 2, cost=0.1, t_max=0, max_steps=4)
    env = TrackEnv(world, 2)
    env.reset()
    there = env.snapshot()
    there["rows"] |= dict.fromkeys(("place", "last_cell"), torch.tensor([3, 1]))
    rows = env.restore(there)
    pictures = [env.render("text", 1).splitlines()]
    for cells in ([0, 1], [2], [0], [1]):
        action = torch.isin(torch.arange(4), torch.tensor(cells)).expand(2, 4)
        _, rows = env.step_and_maybe_reset(rows.set("action", action))
        pictures.append(env.render("text", 1).splitlines())
    assert [each[:2] for each in pictures[:4]] == [
        ["· ●", "· ·"],
        ["▪ ●", "· ·"],
        ["· ○", "▪ ·"],
        ["▪ ●", "▪ ▪"],
    ]
    assert sorted("".join(pictures[4][:2]).replace(" ", "")) == [
        "·",
        "·",
        "·",
        "●",
    ]  # a new episode


def test_a_picture_in_pixels() -> None:
    env = TrackEnv(small_world(), 1)
    env.reset()
    picture = env.render()
    assert (picture.shape, picture.dtype) == ((48, 48, 3), np.uint8)
    row, column = divmod(int(env.target), 3)
    blue = (picture == (0, 90, 181)).all(-1)
    assert (
        blue[16 * row : 16 * row + 16, 16 * column : 16 * column + 16].sum()
        == blue.sum()
        == 14 * 14
    )
    with pytest.raises(UserError, match=r"expected rgb_array or text, a row of 0 \.\.\. 0"):
        env.render("human")


def test_it_says_what_it_is() -> None:
    env = TrackEnv(limited(small_world(t_max=2), 7), [4, 2])
    assert (
        repr(env)
        == "TrackEnv(3 x 3 cells, 9 sensors, t_max=2, max_steps=7, batch_size=[4, 2], device=cpu)"
    )


def test_its_signature_is_its_own_and_one_target_is_the_default() -> None:
    assert [*inspect.signature(TrackEnv).parameters] == [
        "world",
        "batch_size",
        "seed",
        "stream",
        "device",
    ]
    assert TrackEnv(small_world()).batch_size == ()
    assert TrackEnv(small_world(), np.int64(4)).batch_size == (4,)  # type: ignore[arg-type]


@pytest.mark.parametrize("wrong", ["8", 2.5, -1, 0, (2, -3), (3, 0), None])
def test_a_batch_size_that_is_none_is_named(wrong: Any) -> None:
    with pytest.raises(UserError, match=r"batch_size=.*expected a number of targets"):
        TrackEnv(small_world(), wrong)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        (lambda: TrackEnv(small_world(), device="x"), "device=x: no such device here"),
        (lambda: TrackEnv(small_world(), device="vulkan"), "device=vulkan: no such device here"),
        (lambda: TrackEnv(small_world()).to("x"), "device=x: no such device here"),
        (lambda: TrackEnv(small_world(), seed=-1), "seed=-1: expected an integer >= 0"),
        (lambda: TrackEnv(small_world()).set_seed(-1), "seed=-1: expected an integer >= 0"),
    ],
)
def test_a_device_that_is_not_here_and_a_seed_that_is_none_are_named(
    wrong: Callable[[], object], message: str
) -> None:
    with pytest.raises(UserError, match=message):
        wrong()


@pytest.mark.parametrize(
    "kind", [torch.float32, torch.float64, torch.bfloat16, torch.uint8, torch.int8, torch.int64]
)
def test_an_action_of_any_type_is_the_same_step(kind: torch.dtype) -> None:
    """Bernoulli samples are floats, Gymnasium's are int8."""
    action = torch.rand(5, 9, generator=torch.Generator().manual_seed(0)) < 0.5
    frames = []
    for given in (action, action.to(kind)):
        env = TrackEnv(small_world(), 5, seed=1)
        frames.append(env.step(env.reset().set("action", given))["next"])
    assert (frames[0] == frames[1]).all()


@pytest.mark.parametrize(
    ("action", "message"),
    [
        (torch.ones(5, 8), r"\[5, 9\], got float32 \[5, 8\]"),
        (torch.full((5, 9), 2), "got 2"),
        (torch.full((5, 9), 0.5), "got 0.5"),
        (torch.full((5, 9), torch.nan), "got nan"),
        (-torch.ones(5, 9), "got -1"),
    ],
)
def test_other_actions_are_refused_in_a_line(action: torch.Tensor, message: str) -> None:
    env = TrackEnv(small_world(), 5)
    with pytest.raises(UserError, match=f"action: expected 0 or 1 for each sensor, {message}"):
        env.step(env.reset().set("action", action))


def rubbish(env: TrackEnv) -> dict[str, Any]:
    good = env.snapshot()
    rows, generators = good["rows"], good["generators"]
    return {
        "empty": {"rows": {}, "generators": {}},
        "none": None,
        "of another batch": TrackEnv(small_world(), 3, seed=1).snapshot(),
        "a place outside": {"rows": rows | {"place": torch.full((4,), 99)}}
        | {"generators": generators},
        "a cell outside": {"rows": rows | {"last_cell": torch.full((4,), -1)}}
        | {"generators": generators},
        "without generators": {"rows": rows, "generators": {}},
        "half the generators": {
            "rows": rows,
            "generators": generators | {"start": torch.zeros(3, dtype=torch.uint8)},
        },
    }


@pytest.mark.parametrize("name", rubbish(TrackEnv(small_world(), 4)))
def test_a_snapshot_that_is_none_changes_nothing(name: str) -> None:
    env = TrackEnv(small_world(), 4, seed=3)
    env.rollout(3, break_when_any_done=False)
    before = TensorDict(env.snapshot()).clone()
    with pytest.raises(UserError, match="snapshot: expected one of TrackEnv"):
        env.restore(rubbish(env)[name])
    assert (TensorDict(env.snapshot()) == before).all()


class _Sent(pickle.Pickler):
    """Collects the memory of the tensors that a new process would be given, and the generators."""

    def __init__(self) -> None:
        super().__init__(io.BytesIO())
        self.memory: list[int] = []
        self.generators = 0

    def reducer_override(self, obj: Any) -> Any:
        if isinstance(obj, torch.Tensor) and obj.numel():
            self.memory.append(obj.untyped_storage().data_ptr())
        self.generators += isinstance(obj, torch.Generator)
        return NotImplemented


@pytest.mark.parametrize(
    "problem",
    [small_world(), Group([small_world()] * 2), recorded(by_hand([0, 1, 2], [3, 4]))],
    ids=["world", "group", "tracks"],
)
def test_a_process_can_be_started_with_an_environment(problem: Any) -> None:
    """As `MultiSyncCollector([env, env])` does: no two tensors share memory, no generator brings a temporary one."""
    env = TrackEnv(problem, 4)
    env.rollout(2, break_when_any_done=False)
    sent = _Sent()
    sent.dump(env)
    assert sent.memory and len(set(sent.memory)) == len(sent.memory)
    assert sent.generators == 0
    other = copy.deepcopy(env)
    begun = env.reset()  # from where the generators are
    assert (begun == other.reset()).all()
    action = torch.ones_like(env.full_action_spec["action"].zero())
    begun["action"] = action
    assert (env.step(begun.clone()) == other.step(begun)).all()
