"""A policy in a file, `policy.npz`: its sparse table, its task, and if wanted its values; nothing is unpickled."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy import sparse

from trackmdp.arrays import LARGE, load_npz
from trackmdp.durable import write_bytes
from trackmdp.errors import UserError
from trackmdp.policies.table import PolicyTable
from trackmdp.untrusted import decoded, opened
from trackmdp.world.model import Array, Task

__all__ = ["load_policy", "save_policy"]

_TASK = ("size", "cost", "t_max", "safe_cost", "reward", "max_steps", "window", "markov")


def save_policy(file: Path, policy: PolicyTable, value: Array | None = None) -> None:
    """Write a policy, whole or not at all; the same policy, the same bytes.

    Args:
        file: to write.
        policy: its table or its one probability, and how many sensors it draws.
        value: `[M]`, what an episode is worth from each cell.
    """
    content: dict[str, Any] = {f"task_{name}": _number(getattr(policy.task, name)) for name in _TASK}
    if policy.sets is None:
        content["probability"] = np.float64(policy.probability)
    else:
        # Fixed integer widths: SciPy's own choice depends on the number of entries, and the bytes would with it.
        content |= {"indices": policy.sets.indices.astype(np.int32), "indptr": policy.sets.indptr.astype(np.int64)}
        if not policy.deterministic:  # else every entry stored is a sensor on
            content["data"] = policy.sets.data
    if policy.k is not None:
        content["k"] = np.int64(policy.k)
    if value is not None:
        content["value"] = value
    stream = io.BytesIO()
    np.savez_compressed(stream, **content)
    write_bytes(file, stream.getvalue())


def load_policy(file: Path) -> tuple[PolicyTable, Array | None]:
    """A policy that `save_policy` wrote, and its values where it has them.

    Raises:
        UserError: the file is missing or damaged, or holds something else.
    """
    with opened(file, most=LARGE) as stream, decoded(str(file), "a policy"):
        content = load_npz(stream)
        task = _task(content)
        value = content.get("value")
        if value is not None and (value.shape != (task.num_cells,) or value.dtype != np.float64):
            raise ValueError(f"values {value.dtype} {value.shape} for {task.num_cells} cells")
        k = int(content["k"]) if "k" in content else None
        if "probability" in content:
            return PolicyTable(task, probability=float(content["probability"]), k=k), value
        return PolicyTable(task, _sets(content, task), k=k), value


def _number(value: Any) -> npt.NDArray[Any]:
    """A number, a pair or an array; NaN for None."""
    return np.asarray(np.nan if value is None else value)


def _task(content: dict[str, npt.NDArray[Any]]) -> Task:
    given = {name: content[f"task_{name}"] for name in _TASK}
    rows, columns = map(int, given["size"])
    return Task(
        (rows, columns),
        cost=given["cost"],
        t_max=int(given["t_max"]),
        safe_cost=float(given["safe_cost"]),
        reward=float(given["reward"]),
        max_steps=None if np.isnan(given["max_steps"]) else int(given["max_steps"]),
        window=None if np.isnan(given["window"]) else int(given["window"]),
        markov=bool(given["markov"]),
    )


def _sets(content: dict[str, npt.NDArray[Any]], task: Task) -> sparse.csr_array:
    indices, indptr = content["indices"], content["indptr"]
    data = content.get("data", np.ones(len(indices), dtype=bool))
    shape = (task.num_cells * task.num_choices, task.num_cells)
    sets = sparse.csr_array((data, indices, indptr), shape=shape)
    sets.check_format(full_check=True)  # indices of somebody else's file may lead anywhere
    if not np.isfinite(sets.data).all():
        raise UserError("a probability that is not finite")
    return sets
