"""A learned policy as a run leaves it: `policy.npz`, its sets and its exact values, without pickle."""

from __future__ import annotations

import io
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy import sparse

from trackmdp.arrays import load_npz
from trackmdp.errors import UserError
from trackmdp.policies.saved import load_policy
from trackmdp.world.model import Array

POLICY_FILE = "policy.npz"


@dataclass(frozen=True, eq=False)
class Sensed:
    """What a deterministic policy senses, and what that earns.

    Attributes:
        sets: `[M (t_max + 1), M]` bool, row x (t_max + 1) + n the sensors on at n misses after the target was located
            in x.
        value: `[M]`, expected reward of an episode from each start cell, exactly.
    """

    sets: sparse.csr_array
    value: Array

    @property
    def choices(self) -> int:
        """t_max + 1."""
        return int(self.sets.shape[0] // self.sets.shape[1])

    def on(self, n: int) -> sparse.csr_array:
        """`[M, M]` bool, the sensors on at n misses after the target was located in each cell."""
        return self.sets[n :: self.choices]


def arrays(content: bytes, *keys: str) -> list[npt.NDArray[Any]]:
    """The arrays of a `.npz`; code in it is not run.

    Raises:
        Exception: whatever zipfile and NumPy raise over damage; call it inside `untrusted.decoded`.
    """
    found = load_npz(io.BytesIO(content), keys)
    return [found[key] for key in keys]


def pack_all(policies: Mapping[str, Sensed]) -> bytes:
    """The bytes of a file with many policies, each under a name."""
    every = list(policies.values())
    # All in one row of arrays, one after the other, as `results` packs motions: a CSR matrix of m rows has m + 1 row
    # pointers, which begin anew at 0 for each policy. Every entry stored is a sensor on.
    packed = {
        "names": np.array(list(policies), dtype=np.str_),
        # `reshape`: no policy at all is still a table of three columns.
        "shapes": np.array([(*each.sets.shape, each.sets.nnz) for each in every], dtype=np.int64).reshape(-1, 3),
        "indices": np.concatenate([each.sets.indices for each in every] or [np.zeros(0)]).astype(np.int32),
        "indptr": np.concatenate([each.sets.indptr for each in every] or [np.zeros(0)]).astype(np.int64),
        "values": np.concatenate([each.value for each in every] or [np.zeros(0)]),
    }
    stream = io.BytesIO()
    np.savez_compressed(stream, **packed)  # type: ignore[arg-type]
    return stream.getvalue()


def unpack_all(content: bytes) -> dict[str, Sensed]:
    """What `pack_all` packed.

    Raises:
        Exception: the bytes are something else; call it inside `untrusted.decoded`.
    """
    names, shapes, indices, indptr, values = arrays(content, "names", "shapes", "indices", "indptr", "values")
    found: dict[str, Sensed] = {}
    # The last sum is the end of each stream, not a place to cut.
    cuts = [np.cumsum(sizes)[:-1] for sizes in (shapes[:, 2], shapes[:, 0] + 1, shapes[:, 1])]
    parts = zip(*(np.split(each, cut) for each, cut in zip((indices, indptr, values), cuts, strict=True)), strict=True)
    for name, (rows, columns, nnz), (cells, pointer, value) in zip(names, shapes.tolist(), parts, strict=False):
        sets = sparse.csr_array((np.ones(nnz, dtype=bool), cells, pointer), shape=(rows, columns))
        sets.check_format(full_check=True)  # indices of somebody else's file may lead anywhere
        found[str(name)] = Sensed(sets, value)
    return found


def read(file: Path) -> Sensed:
    """Read a policy back.

    Raises:
        UserError: the file is missing or damaged, or holds something else.
    """
    table, value = load_policy(file)
    if value is None:
        raise UserError(f"{file}: not the policy of a run (it has no values)")
    if not table.deterministic:
        raise UserError("policy: draws its sets at random, so that there is no table of them")
    # One probability for all sensors is written out: all of them on, on a grid small enough, or none.
    shape = (table.task.num_keys * table.task.num_choices, table.task.num_cells)
    none = sparse.csr_array(shape, dtype=bool)
    written = none if table.probability == 0.0 else None
    sets = table.sets if table.sets is not None else written
    return Sensed(sparse.csr_array(table.dense().reshape(shape)) if sets is None else sets, value)
