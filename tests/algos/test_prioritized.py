"""Prioritised replay: what is drawn how often, what it weighs, and how it is saved."""

from __future__ import annotations

import io

import numpy as np
import pytest
import torch
from scipy import stats
from tensordict import TensorDict
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer

from trackmdp.algos.dqn import PrioritizedSampler


def buffer(
    alpha: float = 0.5, beta: float = 1.0, *, capacity: int = 6, seed: int = 0
) -> TensorDictReplayBuffer:
    sampler = PrioritizedSampler(capacity, alpha, beta)
    made = TensorDictReplayBuffer(
        storage=LazyTensorStorage(capacity), sampler=sampler, batch_size=1000
    )
    made.set_rng(torch.Generator().manual_seed(seed))
    return made


def fill(made: TensorDictReplayBuffer, *values: float) -> None:
    made.extend(TensorDict({"x": torch.tensor(values)}, [len(values)]))


def share_of(made: TensorDictReplayBuffer, draws: int = 100) -> np.ndarray:
    rows = torch.cat([made.sample()["index"] for _ in range(draws)])
    return np.bincount(rows, minlength=len(made))


def test_items_are_drawn_by_their_priority_to_the_alpha() -> None:
    made = buffer(alpha=0.5)
    fill(made, 0.0, 1.0, 2.0, 3.0)
    made.update_priority(torch.arange(4), torch.tensor([1.0, 4.0, 9.0, 0.25]))
    p = np.array([1, 2, 3, 0.5]) / 6.5
    counts = share_of(made)
    assert stats.chisquare(counts, counts.sum() * p).pvalue > 1e-3


def test_weights_undo_the_draw_and_the_largest_is_one() -> None:
    made = buffer(alpha=0.5, beta=0.7)
    fill(made, 0.0, 1.0, 2.0, 3.0)
    made.update_priority(torch.arange(4), torch.tensor([1.0, 4.0, 9.0, 0.25]))
    rows = made.sample()
    p = torch.tensor([1, 2, 3, 0.5]) / 6.5
    expected = (4 * p) ** -0.7
    expected = (expected / expected.max())[rows["index"]]
    torch.testing.assert_close(rows["priority_weight"], expected)
    assert torch.equal(rows["x"], rows["index"].float())


def test_the_sign_of_a_priority_does_not_count_and_zero_is_still_drawn_with_finite_weights() -> (
    None
):
    made = buffer(alpha=1.0)
    fill(made, 0.0, 1.0)
    made.update_priority(torch.arange(2), torch.tensor([-2.0, 2.0]))
    counts = share_of(made, 20)
    assert abs(counts[0] - counts[1]) < 5 * counts.sum() ** 0.5
    made.update_priority(torch.arange(2), torch.zeros(2))
    assert (share_of(made, 20) > 5_000).all()
    assert torch.isfinite(made.sample()["priority_weight"]).all()


def test_new_items_get_the_largest_priority_seen() -> None:
    made = buffer(alpha=1.0, capacity=3)
    fill(made, 0.0, 1.0)
    made.update_priority(torch.tensor([0]), torch.tensor([7.0]))
    made.update_priority(torch.tensor([0]), torch.tensor([1.0]))
    fill(made, 2.0)
    p = np.array([1, 1, 7]) / 9  # the second item came when the largest was 1
    counts = share_of(made)
    assert stats.chisquare(counts, counts.sum() * p).pvalue > 1e-3


def test_an_overwritten_item_loses_its_priority() -> None:
    made = buffer(alpha=1.0, capacity=2)
    fill(made, 0.0, 1.0)
    made.update_priority(torch.arange(2), torch.tensor([5.0, 1e-6]))
    fill(made, 2.0, 3.0)
    counts = share_of(made, 20)
    assert abs(counts[0] - counts[1]) < 5 * counts.sum() ** 0.5


def test_only_what_is_stored_is_drawn() -> None:
    made = buffer(capacity=1000)
    fill(made, 0.0, 1.0, 2.0)
    assert share_of(made).nonzero()[0].tolist() == [0, 1, 2]


def test_draws_come_from_the_buffers_own_generator() -> None:
    drawn = []
    for _ in range(2):
        made = buffer(seed=4)
        fill(made, 0.0, 1.0, 2.0)
        torch.rand(5)
        drawn.append(made.sample()["index"])
    before = torch.get_rng_state()
    made.sample()
    assert torch.equal(*drawn)
    assert torch.equal(torch.get_rng_state(), before)


def test_its_state_loads_without_unpickling_and_draws_go_on() -> None:
    made = buffer(alpha=1.0)
    fill(made, 0.0, 1.0, 2.0)
    made.update_priority(torch.arange(3), torch.tensor([1.0, 4.0, 9.0]))
    made.sample()
    stream = io.BytesIO()
    torch.save(made.state_dict(), stream)
    stream.seek(0)
    later = buffer(alpha=1.0, seed=99)
    fill(later, 0.0)
    later.load_state_dict(torch.load(stream, weights_only=True))
    first, second = made.sample(), later.sample()
    assert torch.equal(first["index"], second["index"])
    assert torch.equal(first["priority_weight"], second["priority_weight"])
    assert torch.equal(first["x"], second["x"])
    fill(made, 5.0)
    fill(later, 5.0)
    assert torch.equal(made.sample()["index"], later.sample()["index"])


def test_a_saved_state_does_not_change_with_the_sampler() -> None:
    made = buffer(alpha=1.0)
    fill(made, 0.0, 1.0)
    saved = {key: value.clone() for key, value in made.sampler.state_dict().items()}
    other = PrioritizedSampler(6, 1.0, 1.0)
    other.load_state_dict(saved)
    other.update_priority(torch.tensor([0]), torch.tensor([50.0]))
    assert all(torch.equal(value, made.sampler.state_dict()[key]) for key, value in saved.items())


def test_files_are_not_offered() -> None:
    with pytest.raises(NotImplementedError, match="state_dict"):
        PrioritizedSampler(2, 1.0, 1.0).dumps("somewhere")
