"""`policy.npz`: the policy of a run, as bytes that depend on nothing else."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
import pytest

from tests.helpers import small_world, train_config
from trackmdp.app.commands import train
from trackmdp.errors import UserError
from trackmdp.reports import policy
from trackmdp.reports.policy import Policy
from trackmdp.solvers import qmdp
from trackmdp.solvers.evaluate import evaluate
from trackmdp.world.model import World


def stored(**changed: np.ndarray) -> bytes:
    """A `policy.npz` of a 2x2 grid, t_max 0, with other arrays."""
    arrays = {"chains": np.array([255, 255], dtype=np.uint8), "shape": np.array([4, 1, 4]), "value": np.zeros(4)}
    stream = io.BytesIO()
    np.savez_compressed(stream, **(arrays | changed))  # type: ignore[arg-type]
    return stream.getvalue()


def test_a_policy_is_read_back_as_it_was_written(tmp_path: Path) -> None:
    world = small_world(3, t_max=2)
    chains = qmdp.solve(world).dense()
    policy.write(tmp_path / "policy.npz", Policy(chains, evaluate(world, chains).value))
    found = policy.read(tmp_path / "policy.npz")
    assert np.array_equal(found.chains, chains)
    assert np.array_equal(found.value, evaluate(world, chains).value)
    assert found.chains.any()
    assert not found.chains.all()


def test_a_run_leaves_the_policy_that_its_summary_judges(tmp_path: Path) -> None:
    cfg = train_config(
        "grid.size=3", "algo.total_frames=2048", "algo.frames_per_batch=1024", "algo.envs=64", "algo.updates=5"
    )
    cfg.quiet, cfg.optimal.enabled = True, False
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        aihtr = train.run(cfg, tmp_path / name)
    world = World(np.load(tmp_path / "a/kernel.npy", allow_pickle=False), 3, cost=0.16, t_max=1)
    found = policy.read(tmp_path / "a/policy.npz")
    assert evaluate(world, found.chains).aihtr == aihtr
    assert found.value.mean() == pytest.approx(aihtr, rel=1e-12)
    assert (tmp_path / "a/policy.npz").read_bytes() == (tmp_path / "b/policy.npz").read_bytes()


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"PK\x03\x04 and then nothing",
        stored()[:100],
        stored(shape=np.array([4, 1, 5])),
        stored(shape=np.array([4, 9, 4])),
        stored(value=np.zeros(3)),
        stored(value=np.array(["a", "b", "c", "d"])),
    ],
)
def test_what_is_no_policy_is_refused_in_one_line(content: bytes, tmp_path: Path) -> None:
    (tmp_path / "policy.npz").write_bytes(content)
    with pytest.raises(UserError, match=r"policy\.npz: not the policy of a run") as caught:
        policy.read(tmp_path / "policy.npz")
    assert "\n" not in str(caught.value)


def test_code_in_a_policy_is_not_run(tmp_path: Path) -> None:
    np.savez(tmp_path / "policy.npz", chains=np.array([{}], dtype=object), shape=np.array([1]), value=np.zeros(1))
    with pytest.raises(UserError, match="not the policy of a run"):
        policy.read(tmp_path / "policy.npz")
