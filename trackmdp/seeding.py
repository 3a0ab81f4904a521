"""One seed, many named random generators.

Every random draw of a run comes from a generator with a name; two names never share a stream, so drawing more
from one (evaluating more often, for example) leaves the others as they were.
"""

from __future__ import annotations

import hashlib
import operator
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from trackmdp.errors import UserError

if TYPE_CHECKING:  # a world draws by numpy and is made without loading torch
    import torch


def whole_seed(seed: int) -> int:
    """The seed of a user.

    Raises:
        UserError: it is no whole number from 0 on.
    """
    try:
        number = operator.index(seed)  # int() would cut 1.5 to 1
    except TypeError:
        number = -1
    if number < 0:
        raise UserError(f"seed={seed}: expected an integer >= 0")
    return number


def derive(seed: int, *names: str | int) -> int:
    """A 63-bit seed for the stream called `names`, for example ``derive(0, "world", 3)``.

    Raises:
        UserError: `seed` is no whole number from 0 on.
    """
    # Hashed, so that neighbouring seeds and names give unrelated streams: with seed + worker, worker 1 of run 0 and
    # worker 0 of run 1 would draw the same numbers. `>> 1` leaves 63 bits, which fit a signed 64-bit integer.
    text = "/".join([str(whole_seed(seed)), *map(str, names)])
    return int.from_bytes(hashlib.sha256(text.encode()).digest()[:8], "big") >> 1


def generator(seed: int, *names: str | int, device: torch.device | str = "cpu") -> torch.Generator:
    """A fresh `torch.Generator` for the stream called `names`."""
    import torch

    return torch.Generator(device=device).manual_seed(derive(seed, *names))


def seed_global(seed: int, *names: str) -> None:
    """Seed torch's global generator: network initialisation and the sampling inside TorchRL's actors use it."""
    import torch

    torch.manual_seed(derive(seed, "torch", *names))


@contextmanager
def preserved_global_rng() -> Iterator[None]:
    """Leave torch's global generators as they were, after any draws inside."""
    import torch

    # Named, since fork_rng by default warns where there are several GPUs.
    devices = list(range(torch.cuda.device_count())) if torch.cuda.is_available() else []
    with torch.random.fork_rng(devices=devices):
        yield


@contextmanager
def single_precision() -> Iterator[None]:
    """Make networks and rewards in float32 inside, whatever the user's default: the same seed gives the same bytes."""
    import torch

    before = torch.get_default_dtype()
    torch.set_default_dtype(torch.float32)
    try:
        yield
    finally:
        torch.set_default_dtype(before)
