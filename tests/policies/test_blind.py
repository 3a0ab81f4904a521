"""No policy sees the true cell."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch

from tests.acting import RandomSubset
from tests.helpers import ALGORITHMS, algorithm, random_state, small_world
from trackmdp.policies.policy import Policy

WORLD = small_world(t_max=1)


LEARNED = [f"{name} {role}" for name in ALGORITHMS for role in ("policy", "actor")]


def random_k() -> Policy:
    drawing = Policy.random_k(WORLD, 3)
    drawing.generator = torch.Generator()
    return drawing


FIXED = {
    "all on": Policy.all_on(WORLD),
    "random subset": RandomSubset(9, torch.Generator()),
    "random k": random_k(),
    "chains": Policy.from_dense(WORLD, np.random.default_rng(0).random((9, 2, 9)) > 0.5),
}


def policy_called(name: str) -> Any:
    if name in FIXED:
        return FIXED[name]
    learner, role = name.split()
    return getattr(algorithm(learner, WORLD), role)


@pytest.mark.parametrize("name", [*FIXED, *LEARNED])
def test_the_true_cell_changes_no_action(name: str) -> None:
    policy, rows = policy_called(name), random_state(WORLD, 100, seed=0).exclude("action")
    assert {"place", "target"} & set(policy.in_keys) == set()
    actions = []
    for shift in (0, 4):
        moved = rows.clone()
        moved["place"] = (rows["place"] + shift) % 9
        torch.manual_seed(0)
        if "random" in name:
            policy.generator.manual_seed(0)
        with torch.no_grad():
            actions.append(policy(moved)["action"].clone())
    assert torch.equal(*actions)
    assert actions[0].dtype == torch.bool
    assert actions[0].shape == (100, 9)
