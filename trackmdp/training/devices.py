"""Names of torch devices."""

from __future__ import annotations

import torch

from trackmdp.errors import UserError


def make_device(name: str, key: str = "device") -> torch.device:
    """The torch device called `name`; `auto` is the first GPU where there is one.

    Raises:
        UserError: there is no such device here.
    """
    count = torch.cuda.device_count() if torch.cuda.is_available() else 0
    if name == "auto":
        return torch.device("cuda:0" if count else "cpu")
    try:
        device = torch.device(name)
    except RuntimeError:  # an index that is no C integer
        raise UserError(f"{key}={name}: no such device here ({count} CUDA devices found); use cpu or auto") from None
    if device.type == "cuda" and (device.index or 0) >= count:
        raise UserError(f"{key}={name}: no such device here ({count} CUDA devices found); use cpu or auto")
    return device
