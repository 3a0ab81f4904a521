"""The paragraphs of reports stand in text files: a line with what each is called, then the paragraph itself."""

from __future__ import annotations

from functools import cache
from importlib.resources import files


@cache
def paragraphs(package: str, file: str = "prose.txt") -> dict[str, str]:
    """Name -> paragraph of a text file in a package; what stands in braces is filled in by `str.format`."""
    text = files(package).joinpath(file).read_text(encoding="utf-8")
    return {name: " ".join(lines) for name, *lines in map(str.splitlines, text.split("\n\n"))}
