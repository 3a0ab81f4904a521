"""A network that reads what is known of all targets, as a policy for several targets."""

from __future__ import annotations

import copy
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy import sparse
from tensordict import TensorDict
from tensordict.nn import TensorDictModule, TensorDictModuleBase
from torch import Tensor
from torchrl.envs.utils import ExplorationType, set_exploration_type

from trackmdp.arrays.files import npz_bytes
from trackmdp.arrays.types import Array, BoolArray, IndexArray
from trackmdp.durable import write_bytes
from trackmdp.errors import UserError, output_of
from trackmdp.policies.forms import DrawsError, check_reads, mode_of, state_keys
from trackmdp.seeding import preserved_global_rng
from trackmdp.sensing.actions import checked_action
from trackmdp.solvers.several.beliefs import Beliefs, Clocks
from trackmdp.solvers.several.group_tracker import Followed
from trackmdp.solvers.several.merging import Rule
from trackmdp.world.group import Group


class JointRule(Followed, Rule):
    """The most likely sets of an actor over the observations that `TrackEnv` shows of a group.

    Args:
        group: the targets.
        actor: writes `action`; later changes of its weights have no effect.
        device: of the actor.
    """

    name = "joint"
    reads_history = True

    def __init__(self, group: Group, actor: TensorDictModuleBase, device: torch.device) -> None:
        super().__init__(group, ())
        # Rounding differs with the number of rows of a batch. In double precision that does not turn a set over, so
        # that an episode that is simulated again, beside others, is the same.
        self._device, self.actor = device, copy.deepcopy(actor).to(device).double()

    @classmethod
    def given(cls, group: Group, policy: Any) -> JointRule:
        """A user's actor of TorchRL, or model of Stable-Baselines3, that reads the states of a group, at its mode.

        It is not copied.

        Raises:
            DrawsError: it draws.
            UserError: it reads other keys, or those of other targets or another grid; or its action has another form.
        """
        known = [*state_keys(group.task, group.targets), "action_mask"]
        module = isinstance(policy, TensorDictModuleBase)
        names = list(policy.in_keys if module else policy.observation_space.spaces)
        check_reads(names, known)
        if module and "action" not in policy.out_keys:
            raise UserError("policy: the module writes no action")
        weights = policy.parameters() if module else ()
        device = next((each.device for each in weights), torch.device("cpu"))

        def action(*state: Tensor) -> Tensor:
            seen = dict(zip(names, state, strict=True))
            if module:
                return policy(TensorDict(seen, len(state[0]), device=device))["action"]
            return torch.as_tensor(mode_of(policy, seen))

        # A function has no weights, of which others would be made in double precision.
        rule = cls(group, TensorDictModule(action, names, ["action"]), device)
        with preserved_global_rng():
            before = torch.get_rng_state()
            rule.first_sets()
            if not torch.equal(before, torch.get_rng_state()):
                raise DrawsError("policy: draws at random, expected one that does not")
        return rule

    def within(self, group: Group) -> JointRule:
        """See `Rule`."""
        if group.targets != self.group.targets:
            raise UserError(
                f"policy: learned for targets of the kinds {list(self.group.targets)}, expected "
                f"{list(group.targets)}"
            )
        return JointRule(group, self.actor, self._device)

    def sets(self, seen: Clocks, moved: Beliefs) -> IndexArray:  # noqa: ARG002
        """See `Rule`."""
        return np.flatnonzero(self._chosen(seen))

    def first_sets(self) -> list[sparse.csr_array]:
        """See `Rule`; the single target is the only one in the grid."""
        found = []
        for kind in range(len(self.group.kinds)):
            alone = np.arange(len(self.group)) == self.group.targets.index(kind)
            start = self.start(self.group.state_of(np.arange(self.cells)[:, None]))
            shown = Clocks(start.located, start.misses, start.present & alone, start.history)
            found.append(sparse.csr_array(self._chosen(shown)))
        return found

    @torch.no_grad()
    def _chosen(self, seen: Clocks) -> BoolArray:
        """`[E, S]`."""
        # A target that has left has no clock.
        misses = np.where(seen.present, seen.misses, 0)
        parts = {
            "last_cell": seen.located,
            "steps_since_detection": misses,
            "present": seen.present,
        }
        rows = {name: torch.as_tensor(part) for name, part in parts.items()}
        rows["action_history"] = torch.as_tensor(seen.history)
        rows["action_mask"] = torch.as_tensor(self.task.available).expand(len(misses), -1)
        state = TensorDict(rows, len(misses)).to(self._device)
        with set_exploration_type(ExplorationType.DETERMINISTIC):
            action = self.actor(state)["action"]
        shape = len(misses), self.sensors
        found = checked_action(action, shape, "policy: its action", self.task.budget)
        return found.cpu().numpy() & self.task.available

    @property
    def rule(self) -> JointRule:
        """See `Followed`."""
        return self

    def packed(self) -> list[dict[str, Any]]:
        """The weights by their names, in single precision as they were learned, and the kind of each target."""
        weights = self.actor.state_dict().items()
        found = {name: part.to(torch.float32).cpu().numpy() for name, part in weights}
        return [{"targets": np.array(self.group.targets), **found}]

    def save(self, file: Path, value: Array | None = None) -> None:  # noqa: ARG002 (there is none)
        """Write `packed`; the same weights, the same bytes."""
        write_bytes(output_of(file, "save"), npz_bytes(self.packed()[0]))
