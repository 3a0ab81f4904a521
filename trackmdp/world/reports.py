"""Whether a sensor that is on, or the safe action, reports the target: draws and their meaning, batched."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import torch
from torch import Tensor

from trackmdp.seeding import generator
from trackmdp.world.draws import Draw
from trackmdp.world.model import Task


class Reports:
    """The reports of a task's sensors; nothing is drawn where none of them can miss.

    Args:
        task: p_d and p_s of its cells.
        device: where the tensors live.

    Attributes:
        certain: whether every sensor and the safe action always report.
    """

    def __init__(self, task: Task, device: torch.device | str = "cpu") -> None:
        self.certain, self._device = task.perfect and task.safe, torch.device(device)
        # [2, M + 1]: p_d in row 0, p_s in row 1; an exited target, at M, is never reported.
        table = np.pad(np.stack([task.detection, task.safe_detection]), ((0, 0), (0, 1)))
        self._probability = torch.as_tensor(table, device=device)
        self._draw = Draw(self._draw_of, torch.float64, self._device)

    def seed(self, seed: int, stream: str) -> None:
        """Begin the draws of the generator called (`stream`, "report")."""
        if not self.certain:
            self._generator = generator(seed, stream, "report", device=self._device)

    def state(self) -> dict[str, Tensor]:
        """State of the generator, for a checkpoint; nothing where there is none."""
        return {} if self.certain else {"report": self._generator.get_state()}

    def load_state(self, state: Mapping[str, Tensor]) -> None:
        """Go on where `state` was taken."""
        if not self.certain:
            self._generator.set_state(state["report"].cpu())

    def draw(self, rows: Tensor) -> Tensor | None:
        """`[B]` float64 uniform draws for `seen` of the targets `rows` `[B]`; None where all reports are certain."""
        return None if self.certain else self._draw(rows)

    def _draw_of(self, rows: Tensor) -> Tensor:
        return torch.rand(len(rows), dtype=torch.float64, generator=self._generator, device=self._device)

    def seen(self, target: Tensor, forced: Tensor, draws: Tensor | None) -> Tensor | bool:
        """`[B]` whether a sensor at `target` `[B]`, if it is on, reports it; where `forced`, the safe action does."""
        if self.certain:
            return True
        assert draws is not None
        return draws < self._probability[forced.long(), target]
