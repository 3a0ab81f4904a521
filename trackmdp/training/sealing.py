"""`summary.json`: what came out of a run, a digest of each file it belongs to, and one of itself.

So a summary, a kernel, a config or a policy copied from another run, or changed by hand, is noticed by whoever reads
the results. The digests are no signatures: who means to deceive can compute them anew.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from trackmdp.durable import write_sealed
from trackmdp.errors import UserError
from trackmdp.untrusted import opened, read_object, unsealed

SUMMARY = "summary.json"
_FILES = ("config.yaml", "kernel.npz", "tracks.json", "policy.npz")
_LARGEST = 2**36


def write_summary(folder: Path, content: Mapping[str, Any]) -> None:
    """Write `summary.json` of the run in `folder`, once all its other files are there."""
    files = {name: _digest(folder / name) for name in _FILES if (folder / name).is_file()}
    write_sealed(folder / SUMMARY, {**content, "files": files})


def read_summary(folder: Path) -> dict[str, Any]:
    """The summary of the run in `folder`, as it was written.

    Raises:
        UserError: there is none, or it is damaged or changed.
    """
    return unsealed(read_object(folder / SUMMARY), str(folder / SUMMARY))


def check_files(folder: Path, summary: Mapping[str, Any], *names: str) -> None:
    """See that the files `names`, by default all, are those that the run of `summary` left.

    Raises:
        UserError: one is missing, or is another.
    """
    known = summary.get("files")
    if not isinstance(known, Mapping):
        raise UserError(f"{folder / SUMMARY}: names no files; it is by another version of this program")
    for name in names or known:
        if name not in known or known[name] != _digest(folder / name):
            raise UserError(f"{folder / name}: not the file that this run left, as its {SUMMARY} has it")


def _digest(file: Path) -> str:
    with opened(file, most=_LARGEST) as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()
