"""`torch.compile` of the environment: one graph, and the same bits as without it; every tensor on its own device."""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule

from tests.helpers import limited, small_world
from tests.tracks import by_hand, recorded
from trackmdp.environment import targets
from trackmdp.environment.dynamics import Dynamics, State
from trackmdp.environment.env import TrackEnv
from trackmdp.motion.modes import heading_kernel
from trackmdp.seeding import generator
from trackmdp.world.model import World

TRACKS = ([0, 1, 2], [3, 4, 5, 8], [7, 4, 1, 0])


def heading() -> World:
    kernel, modes = heading_kernel(3, keep=0.8, go=0.9, exit_probability=0.1)
    return World(kernel, 3, modes=modes, cost=0.2, t_max=1, clip=1)


PROBLEMS: dict[str, Callable[[], Any]] = {
    "world": lambda: small_world(t_max=2),
    "limited": lambda: limited(small_world(t_max=2), 4),
    "window": lambda: replace(small_world(), window=1),
    "misses": lambda: replace(
        small_world(), detection=np.full(9, 0.7), safe_detection=np.full(9, 0.6)
    ),
    "hidden": heading,
    "tracks": lambda: recorded(by_hand(*TRACKS, exits=True)),
    "memory": lambda: recorded(by_hand(*TRACKS), memory="displacement_gap", clip=1),
}


# torch 2.13 imports modules of its own that it has deprecated (`torch.jit.script_method`).
pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning")


@pytest.fixture(autouse=True)
def apart() -> Iterator[None]:
    """Compiled code is kept per function, and is guarded by the environments of earlier tests."""
    torch._dynamo.reset()
    yield
    torch._dynamo.reset()


def pair(name: str, shape: tuple[int, ...] = (5,)) -> tuple[TrackEnv, TrackEnv]:
    """The same environment twice, after its first reset."""
    envs = tuple(TrackEnv(PROBLEMS[name](), shape, seed=3) for _ in range(2))
    for env in envs:
        env.reset()
    return envs


def every_other(cell: torch.Tensor, history: torch.Tensor) -> torch.Tensor:
    """A policy that is on where the last action was off, in cells of its last cell's parity."""
    off = ~history[..., 0, :]
    return off & (torch.arange(off.shape[-1]) % 2 == cell.unsqueeze(-1) % 2)


POLICY = TensorDictModule(every_other, ["last_cell", "action_history"], ["action"])


def stepped(step: Any, env: TrackEnv, count: int) -> list[TensorDictBase]:
    """Frames of `count` steps, episodes begun anew as they end."""
    rows, frames = env.restore(env.snapshot()), []
    for _ in range(count):
        frame, rows = step(POLICY(rows.clone(recurse=False)))
        frames.append(frame.clone())
    return [*frames, rows.clone()]


def same(mine: TrackEnv, theirs: TrackEnv) -> bool:
    """Whether two environments stand at the same state, generators included, and draw the same picture."""
    (left, right) = (TensorDict(env.snapshot()) for env in (mine, theirs))
    assert set(left.keys(True, True)) == set(right.keys(True, True))
    return bool((left == right).all()) and mine.render("text") == theirs.render("text")


FAST = ("misses", "memory")


@pytest.mark.parametrize(
    "name",
    [each if each in FAST else pytest.param(each, marks=pytest.mark.slow) for each in PROBLEMS],
)
def test_a_step_is_one_graph_and_the_same_step(name: str) -> None:
    """30 steps of 5 targets, episodes ending and beginning; `fullgraph` refuses a graph break."""
    mine, theirs = pair(name)
    compiled = torch.compile(mine.step_and_maybe_reset, fullgraph=True, backend="eager")
    ours, plain = stepped(compiled, mine, 30), stepped(theirs.step_and_maybe_reset, theirs, 30)
    assert sum(int(frame["next", "done"].sum()) for frame in plain[:-1]) > 2
    assert all((one == other).all() for one, other in zip(ours, plain, strict=True))
    assert same(mine, theirs)


@pytest.mark.parametrize("name", PROBLEMS)
def test_every_tensor_is_made_on_the_environments_device(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With `meta`, which holds no data, as torch's default device: a tensor made without a device would be empty."""
    mine, theirs = pair(name)
    plain = stepped(theirs.step_and_maybe_reset, theirs, 20)
    begun, start = list[torch.device](), Dynamics.start

    def started(dynamics: Dynamics, place: torch.Tensor) -> State:
        begun.append(place.device)
        return start(dynamics, place)

    monkeypatch.setattr(Dynamics, "start", started)
    with torch.device("meta"):
        env = TrackEnv(PROBLEMS[name](), 5, seed=3, device="cpu")
        env.reset()
        rows = env.restore(mine.snapshot())
        for frame in plain[:-1]:
            after, rows = env.step_and_maybe_reset(rows.set("action", frame["action"]))
            assert (after == frame).all()
        env.restore(env.snapshot())
    assert {each.type for each in begun} == {"cpu"}


@pytest.mark.parametrize("name", ["world", "limited"])
def test_all_of_it_moves_to_another_device(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """To `meta`, which holds no data: tensors of two devices in one operation are an error there, as on a GPU."""
    # No generator lives there.
    monkeypatch.setattr(targets, "generator", lambda seed, *names, device: generator(seed, *names))
    env = pair(name)[0].to("meta")
    off = TensorDict({"action": env.action_spec.zero()}, env.batch_size)
    carried = env.step_and_maybe_reset(off.clone())[1]
    parts = (env.step(off)["next"], carried, env.reset(), env.snapshot()["rows"])
    assert {each.device.type for part in parts for each in part.values()} == {"meta"}


@pytest.mark.slow
@pytest.mark.parametrize("name", ["window", "memory"])
def test_to_machine_code_it_is_the_same_bit_for_bit(name: str) -> None:
    mine, theirs = pair(name, (7,))
    compiled = torch.compile(mine.step_and_maybe_reset, fullgraph=True)
    ours, plain = stepped(compiled, mine, 40), stepped(theirs.step_and_maybe_reset, theirs, 40)
    assert all((one == other).all() for one, other in zip(ours, plain, strict=True))
    assert same(mine, theirs)


@pytest.mark.slow
def test_to_machine_code_a_rollout_is_the_same_bit_for_bit() -> None:
    mine, theirs = pair("misses")
    compiled = torch.compile(mine.rollout, fullgraph=True)
    for _ in range(3):
        ours = compiled(3, POLICY, break_when_any_done=False)
        assert (ours == theirs.rollout(3, POLICY, break_when_any_done=False)).all()
        assert same(mine, theirs)


@pytest.mark.slow
def test_torchrls_own_calls_have_no_graph_break() -> None:
    """As counted by TorchDynamo: `step`, `reset`, and a rollout of three steps."""
    env, _ = pair("world")
    action = env.rand_action(TensorDict(batch_size=5))
    assert breaks(env.step, action) == breaks(env.reset) == 0
    assert breaks(env.rollout, 3, POLICY, break_when_any_done=False) == 0


def test_where_torchrl_itself_branches_on_data() -> None:
    """TorchRL 0.14.1, `EnvBase.any_done` (torchrl/envs/common.py, line 4284): `if any_done:`, on a tensor.

    `rollout` asks it after each step if it is to stop at the first end (how long it is then depends on data), and
    before the first step with `auto_reset=False`.
    """
    env, _ = pair("world")
    with pytest.raises(
        torch._dynamo.exc.Unsupported,
        match=r"(?s)Data-dependent branching.*envs/common.py.*any_done",
    ):
        torch.compile(env.rollout, fullgraph=True, backend="eager")(3, POLICY)


def breaks(call: Callable[..., Any], *args: Any, **more: Any) -> int:
    torch._dynamo.reset()
    return torch._dynamo.explain(call)(*args, **more).graph_break_count


def test_a_copy_draws_from_its_own_generators() -> None:
    """Compiled, too: what a copy does leaves the original where it is."""
    mine, theirs = pair("misses")
    copied = copy.deepcopy(mine)
    compiled = torch.compile(copied.step_and_maybe_reset, fullgraph=True, backend="eager")
    plain = stepped(theirs.step_and_maybe_reset, theirs, 5)
    before = TensorDict(mine.snapshot()).clone()
    assert all(
        (one == other).all() for one, other in zip(stepped(compiled, copied, 5), plain, strict=True)
    )
    assert (TensorDict(mine.snapshot()) == before).all()
    assert same(copied, theirs)
