"""A learned policy as a run leaves it: `policy.npz`, its sets and its exact values, without pickle."""

from __future__ import annotations

import io
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from trackmdp.arrays import load_npz
from trackmdp.errors import UserError
from trackmdp.policies.saved import load_policy
from trackmdp.world.model import Array, BoolArray

__all__ = ["POLICY_FILE", "StoredPolicy", "arrays", "pack_all", "read", "unpack_all"]

POLICY_FILE = "policy.npz"


@dataclass(frozen=True, eq=False)
class StoredPolicy:
    """A deterministic policy.

    Attributes:
        chains: `[M, t_max + 1, M]`, sensors on at n misses after the target was located in each cell.
        value: `[M]`, expected reward of an episode from each start cell, exactly.
    """

    chains: BoolArray
    value: Array


def arrays(content: bytes, *keys: str) -> list[npt.NDArray[Any]]:
    """The arrays of a `.npz`; code in it is not run.

    Raises:
        Exception: whatever zipfile and NumPy raise over damage; call it inside `untrusted.decoded`.
    """
    found = load_npz(io.BytesIO(content), keys)
    return [found[key] for key in keys]


def pack_all(policies: Mapping[str, StoredPolicy]) -> bytes:
    """The bytes of a file with many policies, each under a name."""
    every = list(policies.values())
    packed = {
        "names": np.array(list(policies), dtype=np.str_),
        # `reshape`: no policy at all is still a table of three columns.
        "shapes": np.array([policy.chains.shape for policy in every], dtype=np.int64).reshape(-1, 3),
        # One bit a sensor: as bytes a grid of 10 x 10 with t_max = 1 takes 20 kB, as bits 2.5 kB. One stream for all
        # policies, so that only its end is padded.
        "chains": np.packbits(np.concatenate([policy.chains.ravel() for policy in every] or [np.zeros(0, bool)])),
        "values": np.concatenate([policy.value for policy in every] or [np.zeros(0)]),
    }
    stream = io.BytesIO()
    np.savez_compressed(stream, **packed)  # type: ignore[arg-type]
    return stream.getvalue()


def unpack_all(content: bytes) -> dict[str, StoredPolicy]:
    """What `pack_all` packed.

    Raises:
        Exception: the bytes are something else; call it inside `untrusted.decoded`.
    """
    names, shapes, bits, values = arrays(content, "names", "shapes", "chains", "values")
    sizes = shapes.prod(axis=1)
    flat = np.unpackbits(bits, count=int(sizes.sum())).astype(np.bool_)
    # The last sum is the end of the stream, not a place to cut.
    chains = np.split(flat, np.cumsum(sizes)[:-1]) if len(names) else []
    value = np.split(values, np.cumsum(shapes[:, 0])[:-1]) if len(names) else []
    return {
        str(name): StoredPolicy(c.reshape(s), v) for name, c, s, v in zip(names, chains, shapes, value, strict=True)
    }


def read(file: Path) -> StoredPolicy:
    """Read a policy back.

    Raises:
        UserError: the file is missing or damaged, or holds something else.
    """
    table, value = load_policy(file)
    if value is None:
        raise UserError(f"{file}: not the policy of a run (it has no values)")
    return StoredPolicy(table.dense(), value)
