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
from trackmdp.durable import write_bytes
from trackmdp.untrusted import decoded, read_bytes
from trackmdp.world.model import Array, BoolArray

__all__ = ["FILE", "Policy", "arrays", "pack", "pack_all", "read", "unpack_all", "write"]

FILE = "policy.npz"
_LARGEST = 2**30
"""Bytes of the longest; 64 x 64 cells need a few MB."""


@dataclass(frozen=True, eq=False)
class Policy:
    """A deterministic policy.

    Attributes:
        chains: `[M, t_max + 1, M]`, sensors on at n misses after the target was located in each cell.
        value: `[M]`, expected reward of an episode from each start cell, exactly.
    """

    chains: BoolArray
    value: Array


def pack(policy: Policy) -> bytes:
    """The bytes of a `policy.npz`: `chains` as bits, their `shape`, and `value`; the same policy, the same bytes."""
    stream = io.BytesIO()
    bits, shape = np.packbits(policy.chains), np.array(policy.chains.shape)
    np.savez_compressed(stream, chains=bits, shape=shape, value=policy.value)
    return stream.getvalue()


def arrays(content: bytes, *keys: str) -> list[npt.NDArray[Any]]:
    """The arrays of a `.npz`; code in it is not run.

    Raises:
        Exception: whatever zipfile and NumPy raise over damage; call it inside `untrusted.decoded`.
    """
    found = load_npz(io.BytesIO(content), keys)
    return [found[key] for key in keys]


def pack_all(policies: Mapping[str, Policy]) -> bytes:
    """The bytes of a file with many policies, each under a name."""
    every = list(policies.values())
    packed = {
        "names": np.array(list(policies), dtype=np.str_),
        "shapes": np.array([policy.chains.shape for policy in every], dtype=np.int64).reshape(-1, 3),
        "chains": np.packbits(np.concatenate([policy.chains.ravel() for policy in every] or [np.zeros(0, bool)])),
        "values": np.concatenate([policy.value for policy in every] or [np.zeros(0)]),
    }
    stream = io.BytesIO()
    np.savez_compressed(stream, **packed)  # type: ignore[arg-type]
    return stream.getvalue()


def unpack_all(content: bytes) -> dict[str, Policy]:
    """What `pack_all` packed.

    Raises:
        Exception: the bytes are something else; call it inside `untrusted.decoded`.
    """
    names, shapes, bits, values = arrays(content, "names", "shapes", "chains", "values")
    sizes = shapes.prod(axis=1)
    flat = np.unpackbits(bits, count=int(sizes.sum())).astype(np.bool_)
    chains = np.split(flat, np.cumsum(sizes)[:-1]) if len(names) else []
    value = np.split(values, np.cumsum(shapes[:, 0])[:-1]) if len(names) else []
    return {str(name): Policy(c.reshape(s), v) for name, c, s, v in zip(names, chains, shapes, value, strict=True)}


def write(file: Path, policy: Policy) -> None:
    """Write the policy, whole or not at all."""
    write_bytes(file, pack(policy))


def read(file: Path) -> Policy:
    """Read a policy back.

    Raises:
        UserError: the file is missing or damaged, or holds something else.
    """
    content = read_bytes(file, most=_LARGEST)
    with decoded(str(file), "the policy of a run"):
        bits, shape, value = arrays(content, "chains", "shape", "value")
        m, choices, sensors = (int(length) for length in shape)
        if min(m, choices) < 1 or sensors != m or value.shape != (m,) or bits.size != (m * choices * m + 7) // 8:
            raise ValueError("arrays that do not belong together")
        if value.dtype != np.float64 or not np.isfinite(value).all():
            raise ValueError("values that are not finite numbers")
        chains = np.unpackbits(bits, count=m * choices * m).astype(np.bool_).reshape(m, choices, m)
        return Policy(chains, value)
