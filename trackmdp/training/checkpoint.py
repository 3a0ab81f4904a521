"""Checkpoints: one file each, whole or absent, tensors and plain values only."""

from __future__ import annotations

import os
import pickle
import re
from pathlib import Path
from typing import Any

import torch

from trackmdp.errors import UserError

__all__ = ["FORMAT", "load", "newest", "save"]

FORMAT = 1
_NAME = re.compile(r"iteration-(\d+)\.pt")


def save(folder: Path, iteration: int, state: dict[str, Any], *, keep: int) -> Path:
    """Write `folder`/iteration-N.pt and remove all but the newest `keep`.

    The file appears under its name only once its bytes are on the disk.
    """
    folder.mkdir(exist_ok=True)
    file = folder / f"iteration-{iteration:08d}.pt"
    part = file.with_suffix(".part")
    with part.open("wb") as stream:
        torch.save({"format": FORMAT, "iteration": iteration, **state}, stream)
        stream.flush()
        os.fsync(stream.fileno())
    part.replace(file)
    _sync(folder)
    for old in _all(folder)[:-keep]:
        old.unlink()
    return file


def newest(run: Path) -> Path:
    """The newest checkpoint of a run folder.

    Raises:
        UserError: the run has none.
    """
    files = _all(run / "checkpoints")
    if not files:
        raise UserError(f"run={run}: no checkpoint in {run / 'checkpoints'}; the run has not saved one yet")
    return files[-1]


def load(file: Path, device: torch.device | str = "cpu") -> dict[str, Any]:
    """Read a checkpoint without unpickling code.

    Raises:
        UserError: the file is damaged, foreign, or of another format.
    """
    try:
        state = torch.load(file, map_location=device, weights_only=True)
    except (RuntimeError, EOFError, OSError, ValueError, KeyError, pickle.UnpicklingError) as error:
        raise UserError(f"{file}: not a checkpoint, or a damaged one") from error
    if not isinstance(state, dict) or state.get("format") != FORMAT:
        found = state.get("format") if isinstance(state, dict) else None
        raise UserError(f"{file}: checkpoint format {found}, expected {FORMAT}")
    return state


def _all(folder: Path) -> list[Path]:
    return sorted(file for file in folder.glob("iteration-*.pt") if _NAME.fullmatch(file.name))


def _sync(folder: Path) -> None:
    """Make the rename itself survive a power failure."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
