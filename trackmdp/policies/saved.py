"""A policy in a file: its sparse table, its task, and if wanted its values; nothing is unpickled.

`policy.npz` and `sets.npz` are that. `sets.json` is the sets alone, for a reader of another language, on grids small
enough to be worth writing out: a million cells would be 260 MB.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from trackmdp.arrays.files import npz_bytes, whole_csr
from trackmdp.arrays.types import AnyArray, Array
from trackmdp.durable import write_bytes, write_json
from trackmdp.errors import UserError
from trackmdp.policies.table import PolicyTable
from trackmdp.sensing.task import Task
from trackmdp.untrusted import LARGE, decoded, load_npz, opened, read_object
from trackmdp.world.problem_file import as_arrays, from_arrays

LISTED_CELLS, LISTED_NUMBERS = 20_000, 2**21
"""Cells, and sets and sensors in them, up to which sets are written as JSON; writing a number takes 130 bytes."""

_TASK = "task_"
"""Begins the names of the arrays of a policy's task (`trackmdp.world.problem_file`)."""


def save_policy(file: Path, policy: PolicyTable, value: Array | None = None, **more: Array) -> None:
    """Write a policy, whole or not at all; the same policy, the same bytes.

    Args:
        file: to write.
        policy: its table or its one probability, and how many sensors it draws.
        value: `[M]`, the expected reward of an episode from each cell.
        **more: further `[M]` arrays that go with it.
    """
    task = as_arrays({f"{_TASK}{name}": given for name, given in policy.task.given.items()})
    values = more if value is None else {"value": value, **more}
    write_bytes(file, npz_bytes(task | packed(policy) | values))


def load_policy(file: Path) -> tuple[PolicyTable, Array | None]:
    """A policy that `save_policy` wrote, and its values where it has them.

    Raises:
        UserError: the file is missing or damaged, or holds something else.
    """
    with opened(file, most=LARGE) as stream, decoded(str(file), "a policy"):
        content = load_npz(stream)
        if "targets" in content:
            raise ValueError("the weights of several targets learned together: load_run reads them")
        own = {name: array for name, array in content.items() if name.startswith(_TASK)}
        task = Task(**from_arrays({name.removeprefix(_TASK): own[name] for name in own}))
        value = content.get("value")
        if value is not None and (value.shape != (task.num_cells,) or value.dtype != np.float64):
            raise ValueError(f"values {value.dtype} {value.shape} for {task.num_cells} cells")
        return unpacked_policy(task, content), value


def packed(policy: PolicyTable) -> dict[str, Any]:
    """A policy as plain arrays: its table or its one probability, and how many sensors it draws."""
    sets, content = policy.sets, dict[str, Any]()
    if (
        policy.alike
        and sets.nnz in (0, policy.task.available.sum())
        and (sets.data == sets.data[:1]).all()
    ):
        content["probability"] = np.float64(sets.data[0] if sets.nnz else 0.0)
    else:
        sets = policy.written
        # Fixed integer widths: SciPy's own choice depends on the number of entries, and the bytes would with it.
        content["indices"] = sets.indices.astype(np.int32)
        content["indptr"] = sets.indptr.astype(np.int64)
        if not policy.deterministic:  # else every entry stored is a sensor on
            content["data"] = sets.data
    return content if policy.k is None else content | {"k": np.int64(policy.k)}


def unpacked_policy(task: Task, content: Mapping[str, AnyArray]) -> PolicyTable:
    """The policy of `packed` arrays.

    Raises:
        UserError: they are no policy of `task`.
    """
    k = int(content["k"]) if "k" in content else None
    if "probability" in content:
        return PolicyTable(task, probability=float(content["probability"]), k=k)
    indices, indptr = content["indices"], content["indptr"]
    data = content.get("data", np.ones(len(indices), bool))
    sets = whole_csr(data, indices, indptr, (task.num_keys * task.num_choices, task.total_sensors))
    if not np.isfinite(sets.data).all():
        raise UserError("a probability that is not finite")
    entries = sets.nnz
    sets.sum_duplicates()
    if sets.nnz != entries:
        raise UserError("a sensor that stands twice in a set")
    return PolicyTable(task, sets, k=k)


def listable(policy: PolicyTable) -> bool:
    """Whether the sets are few enough to be written as JSON; always on, 40 x 40 sensors are too many."""
    task = policy.task
    rows = task.num_keys * task.num_choices
    on = policy.sets.nnz * (rows if policy.alike else 1)
    return task.num_cells <= LISTED_CELLS and rows + on <= LISTED_NUMBERS


def sets_name(policy: PolicyTable) -> str:
    """`sets.json`, or where the sets are too many for that `sets.npz`."""
    return "sets.json" if listable(policy) else "sets.npz"


def write_sets(folder: Path, policy: PolicyTable, **arrays: Array) -> dict[str, Any]:
    """Write the sets of a policy, and return `arrays` as a report in JSON has them.

    Where they are `listable` the sets go to `sets.json`, unless they are drawn at random, and the arrays are returned
    as lists. Else both go to `sets.npz`, as `load_policy` reads it, and in place of each array its file is named.
    """
    for earlier in ("sets.json", "sets.npz"):  # of another policy
        (folder / earlier).unlink(missing_ok=True)
    file = folder / sets_name(policy)
    if file.suffix == ".npz":
        save_policy(file, policy, **arrays)
        return dict.fromkeys(arrays, file.name)
    if policy.deterministic:
        write_json(file, policy.as_lists())
    return {name: array.tolist() for name, array in arrays.items()}


def read_sets(task: Task, file: str | Path) -> PolicyTable:
    """The policy in a `sets.json`, or in a `sets.npz` or `policy.npz`, for `task`; its memory is its own.

    Raises:
        UserError: the file is missing or damaged, holds something else, or is for another grid or t_max.
    """
    file = Path(file)
    if file.suffix == ".npz":
        table = load_policy(file)[0]
        table.check_fits(task)
        made = table.task
        own = task.remembering(made.memory, clip=made.clip, revealed=made.revealed)
        return PolicyTable(own, table.sets, k=table.k)
    if file.suffix != ".json":
        raise UserError(f"{file}: expected a sets.json, or a sets.npz or policy.npz")
    content = read_object(file, most=LARGE)
    with decoded(str(file), "sets"):
        memory = content.get("memory", {"kind": "cell", "clip": 2})
        if not isinstance(memory, dict) or not isinstance(memory.get("kind"), str):
            raise ValueError(f"memory {memory!r:.40}: expected an object with kind and clip")
        own = task.remembering(
            memory["kind"], clip=memory["clip"], revealed=memory.get("revealed", 1)
        )
        return _listed(own, content)


def _listed(task: Task, content: dict[str, Any]) -> PolicyTable:
    """The policy that `PolicyTable.as_lists` wrote."""
    if content.get("footprints") != (None if task.coverage is None else task.coverage.as_lists()):
        raise ValueError("sets of sensors of other footprints")
    if content["size"] != list(task.size):  # as many cells in other rows would fit
        raise ValueError(f"size {content['size']}, rows and columns; expected {list(task.size)}")
    plans, count = content["sets"], task.num_keys
    if not isinstance(plans, dict):
        raise ValueError(f"sets: expected {count} plans by their keys")
    # Counted first: the memory in a stranger's file may make any number of keys.
    if (content["t_max"], len(plans)) != (task.t_max, count):
        raise ValueError(
            f"{len(plans)} plans, t_max {content['t_max']}; expected {count}, {task.t_max}"
        )
    rows: list[list[int]] = []
    for key in range(count):
        plan = plans[str(key)]
        lists = isinstance(plan, list) and all(isinstance(on, list) for on in plan)
        if not lists or len(plan) != task.num_choices:
            raise ValueError(f"plan {key}: expected {task.num_choices} lists of sensors")
        for sensor in itertools.chain(*plan):
            # numpy would cut 1.5 to 1, and take true for it.
            if type(sensor) is not int or not 0 <= sensor < task.total_sensors:
                most = task.total_sensors - 1
                raise ValueError(
                    f"plan {key}: sensor {sensor!r}, expected a whole number from 0 to {most}"
                )
        rows += plan
    pointer = np.cumsum([0, *map(len, rows)])
    indices = np.fromiter(itertools.chain(*rows), dtype=np.int64)
    return unpacked_policy(task, {"indices": indices, "indptr": pointer})
