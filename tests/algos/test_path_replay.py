"""A policy that remembers, replayed along known paths, against the same followed one path at a time."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from tests.helpers import headings
from trackmdp.algos.gains import Credit
from trackmdp.algos.path_replay import Replay
from trackmdp.sensing.windows import Window

DISCOUNT, SAFE = 0.7, -0.4


def walks(world: object, count: int, steps: int, rng: torch.Generator) -> torch.Tensor:
    """Keys with all sensors on of random walks on 3 x 3 cells, some from an episode's start; 10 % leave a step."""
    cells = torch.randint(9, (steps + 1, count), generator=rng)
    gone = (torch.rand(steps + 1, count, generator=rng) < 0.1).cummax(0).values
    keys = world.keys  # type: ignore[attr-defined]
    key = keys.start(cells[0])
    key = torch.where(torch.arange(count) % 3 == 0, key, keys.next(key, 0, cells[0]))
    paths = [key]
    for cell in cells[1:]:
        key = keys.next(key, 0, cell)
        paths.append(key)
    gone[0] = False
    return torch.where(gone, keys.num_keys, torch.stack(paths))


@pytest.mark.parametrize(
    ("memory", "t_max"), [("displacement", 1), ("displacement_gap", 0), ("two_displacements", 2)]
)
def test_it_is_followed_as_one_path_at_a_time(memory: str, t_max: int) -> None:
    world, rng = headings(t_max=t_max, memory=memory), torch.Generator().manual_seed(0)
    keys, settled = world.keys, Replay.settling(world.keys)
    paths = walks(world, 40, Replay.steps(keys), rng)
    on = torch.rand(keys.num_keys, t_max + 1, 9, generator=rng) < 0.4
    spent, value = (
        torch.rand(keys.num_keys, t_max + 1, generator=rng),
        torch.rand(keys.num_keys, generator=rng),
    )

    def moved(key: int, n: int, cell: int) -> tuple[bool, int]:
        found = n > t_max or bool(on[key, n, cell])
        return found, int(keys.next(torch.tensor(key), n, torch.tensor(cell))) if found else key

    def worth(path: list[int], key: int, at: int) -> float:
        """Located at a step with a key: what follows, up to the first detection that settles, and V there."""
        total, weight, n = 0.0, 1.0, 0
        for step in range(1, settled + t_max + 2):
            if path[at + step] == keys.num_keys:
                return total
            price, forced = float(spent[key, min(n, t_max)]), n > t_max
            found, key = moved(key, n, path[at + step] // keys.num_classes)
            total += weight * (SAFE if forced else found - price)
            weight, n = weight * DISCOUNT, 0 if found else n + 1
            if found and step >= settled:
                return total + weight * float(value[key])
        raise AssertionError

    expected = []
    for path in paths.T.tolist():
        key, n, at = path[0], 0, 0
        while key % keys.num_classes != 0 or at:
            if n == 0 and at >= settled:
                break
            at += 1
            if path[at] == keys.num_keys:
                at = -1
                break
            found, key = moved(key, n, path[at] // keys.num_classes)
            n = 0 if found else n + 1
        if at < 0:
            continue
        here = path[at:]
        own = [key] + [
            keys.num_keys
            if here[step] == keys.num_keys
            else moved(key, t_max + 1, here[step] // keys.num_classes)[1]
            for step in range(1, t_max + 3)
        ]
        if "gap" in memory:  # the misses before are those of the step
            own[1:] = [
                k
                if k == keys.num_keys
                else int(
                    keys.next(torch.tensor(key), s, torch.tensor(here[s + 1] // keys.num_classes))
                )
                for s, k in enumerate(own[1:])
            ]
        after = [
            0.0 if k == keys.num_keys else worth(here, k, step + 1)
            for step, k in enumerate(own[1:])
        ]
        expected.append((own, after))
    task = replace(world.task, safe_cost=(1.0 - SAFE) * world.reward)
    credit = Credit.of(task, DISCOUNT, rng.device)
    replay = Replay(replace(task, markov=False), Window(world, None), credit, on, spent, rng)
    begun, own = replay.begin(paths)
    found = replay.worth(begun, own, value)
    assert own.T.tolist() == [each for each, _ in expected]
    assert len(expected) > 15
    torch.testing.assert_close(found.T, torch.tensor([each for _, each in expected]))
