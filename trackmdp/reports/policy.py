"""A learned policy as a run leaves it: `policy.npz`, its sets and its exact values, without pickle."""

from __future__ import annotations

import io
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy import sparse

from trackmdp.arrays import load_npz, npz_bytes
from trackmdp.errors import UserError
from trackmdp.policies.saved import load_policy
from trackmdp.policies.table import PolicyTable
from trackmdp.solvers.renewal import IndexArray, per_row
from trackmdp.world.files import whole_csr
from trackmdp.world.model import Array

POLICY_FILE = "policy.npz"


@dataclass(frozen=True, eq=False)
class Sensed:
    """What a deterministic policy senses, and what that earns.

    Attributes:
        sets: `[M (t_max + 1), M]` bool, row x (t_max + 1) + n the cells sensed at n misses after the target was located
            in x; a share of the detections there, where the policy remembers or is told more than the cell.
        value: `[M]`, expected reward of an episode from each start cell, exactly.
    """

    sets: sparse.csr_array
    value: Array

    @property
    def choices(self) -> int:
        """t_max + 1."""
        return int(self.sets.shape[0] // self.sets.shape[1])

    @property
    def averaged(self) -> bool:
        """Whether `sets` are shares."""
        return bool(self.sets.dtype != np.bool_)

    def on(self, n: int) -> sparse.csr_array:
        """`[M, M]`, the cells sensed at n misses after the target was located in each cell."""
        return self.sets[n :: self.choices]


def joined(parts: Iterable[np.ndarray]) -> np.ndarray:
    """Arrays `[K_i]` end to end, the form in which many small ones are stored; `[0]` of none."""
    return np.concatenate([np.zeros(0), *parts])


def taken_apart(streams: Iterable[np.ndarray], sizes: Iterable[np.ndarray]) -> Iterator[tuple[np.ndarray, ...]]:
    """Of each item its part of every stream of `joined`, in which item i takes `sizes[i]` places."""
    # The last sum is the end of the stream, not a place to cut.
    pairs = zip(streams, sizes, strict=True)
    return zip(*(np.split(each, np.cumsum(size)[:-1]) for each, size in pairs), strict=True)


def pack_all(policies: Mapping[str, Sensed]) -> bytes:
    """The bytes of a file with many policies, each under a name."""
    every = list(policies.values())
    # All in one row of arrays, one after the other, as `results` packs motions: a CSR matrix of m rows has m + 1 row
    # pointers, which begin anew at 0 for each policy. Every entry stored is a sensor on, or with `shares` that share.
    packed = {
        "names": np.array(list(policies), dtype=np.str_),
        # `reshape`: no policy at all is still a table of three columns.
        "shapes": np.array([(*each.sets.shape, each.sets.nnz) for each in every], dtype=np.int64).reshape(-1, 3),
        "indices": joined(each.sets.indices for each in every).astype(np.int32),
        "indptr": joined(each.sets.indptr for each in every).astype(np.int64),
        "values": joined(each.value for each in every),
    }
    if any(each.averaged for each in every):
        packed["shares"] = joined(each.sets.data for each in every).astype(np.float32)
        packed["averaged"] = np.array([each.averaged for each in every])
    return npz_bytes(packed)


def unpack_all(content: bytes) -> dict[str, Sensed]:
    """What `pack_all` packed.

    Raises:
        Exception: the bytes are something else; call it inside `untrusted.decoded`.
    """
    stored = load_npz(io.BytesIO(content))
    names, shapes, indices, indptr, values = (stored[key] for key in ("names", "shapes", "indices", "indptr", "values"))
    shares, averaged = stored.get("shares", np.ones(len(indices))), stored.get("averaged", np.zeros(len(names)))
    found: dict[str, Sensed] = {}
    sizes = (shapes[:, 2], shapes[:, 2], shapes[:, 0] + 1, shapes[:, 1])
    parts = taken_apart((indices, shares, indptr, values), sizes)
    for name, shape, mean, (cells, data, pointer, value) in zip(names, shapes.tolist(), averaged, parts, strict=False):
        sets = whole_csr(data.astype(float if mean else bool), cells, pointer, tuple(shape[:2]))
        found[str(name)] = Sensed(sets, value)
    return found


def read(file: Path, visits: Callable[[PolicyTable], Array]) -> Sensed:
    """Read a policy back.

    Args:
        file: of a run.
        visits: `[keys]` of a policy that remembers or is told more than the cell, how often it comes to each key: its
            plans for one cell are averaged with these weights.

    Raises:
        UserError: the file is missing or damaged, or holds something else.
    """
    table, value = load_policy(file)
    if value is None:
        raise UserError(f"{file}: not the policy of a run (it has no values)")
    if not table.deterministic:
        raise UserError("policy: draws its sets at random, so that there is no table of them")
    task = table.task
    # One probability for all sensors is written out: all of them on, on a grid small enough, or none.
    shape = (task.num_keys * task.num_choices, task.total_sensors)
    sets = table.sets
    if sets is None:
        sets = sparse.csr_array(table.dense().reshape(shape) if table.probability else shape, dtype=bool)
    sets = sets if task.coverage is None else task.coverage.seen(sets)
    return Sensed(_averaged(table, sets, visits(table)) if task.keyed else sets, value)


def _averaged(policy: PolicyTable, sets: sparse.csr_array, visits: Array) -> sparse.csr_array:
    """`[M (t_max + 1), M]`, means of `sets` `[keys (t_max + 1), M]` over the keys of each cell."""
    task = policy.task
    keys: IndexArray = np.arange(task.num_keys)
    cells = task.keys.cell(keys)
    # no cell without visits: episodes start anywhere
    share = visits / per_row(cells, visits, task.num_cells)[cells]
    means = sparse.csr_array((share, (cells, keys)), shape=(task.num_cells, task.num_keys))
    # Row x (t_max + 1) + n of the result is that of the keys at the same n.
    found = sparse.kron(means, sparse.eye_array(task.num_choices), format="csr") @ sets.astype(np.float64)
    found.sort_indices()
    return sparse.csr_array(found)
