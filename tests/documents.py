"""The Markdown files of the repository: their links, headings, named files and blocks of code."""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parents[1]
TOP = ("trackmdp", "conf", "scripts", "tests", ".ci")
"""Folders whose names begin a path from the root of the repository."""
_LINK = re.compile(r"\[[^\]\[]*\]\(([^)\s]+)\)")
_CODE = re.compile(r"`([^`\n]+)`")
_FILE = re.compile(r"[\w./-]+\.(?:py|md|yaml|toml|csv|json|npz|html|txt)")


@dataclass(frozen=True)
class Block:
    """A fenced block: its language, its lines, and the number of its first line."""

    language: str
    lines: list[str]
    number: int

    @property
    def text(self) -> str:
        """All lines, joined."""
        return "\n".join(self.lines)


def documents(root: Path = ROOT) -> list[Path]:
    """All `*.md` files; hidden folders, such as virtual environments, are left out."""
    found = sorted(root.rglob("*.md"))
    return [path for path in found if not any(part[0] == "." for part in inside(path, root))]


def inside(path: Path, root: Path = ROOT) -> tuple[str, ...]:
    """The parts of a path below the root."""
    return path.relative_to(root).parts


def blocks(path: Path) -> list[Block]:
    """The fenced blocks of a file, in order."""
    found: list[Block] = []
    current: Block | None = None
    for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), start=1):
        if line.startswith("```"):
            if current is None:
                current = Block(line[3:].strip(), [], number + 1)
            else:
                found.append(current)
                current = None
        elif current is not None:
            current.lines.append(line)
    assert current is None, f"{path}: a block is not closed"
    return found


def prose(path: Path) -> str:
    """The text outside of fenced blocks."""
    lines, fenced = [], False
    for line in path.read_text(encoding="utf-8").splitlines():
        if line.startswith("```"):
            fenced = not fenced
        elif not fenced:
            lines.append(line)
    return "\n".join(lines)


def slug(heading: str) -> str:
    """The anchor of a heading, as GitHub makes it: `Exact value (§ 3)` has `exact-value--3`."""
    plain = re.sub(r"[^\w\- ]", "", heading.strip().lower())
    return plain.replace(" ", "-")


def anchors(path: Path) -> set[str]:
    """The anchors of all headings of a file."""
    return {slug(heading) for heading in re.findall(r"^#+ (.+)$", prose(path), re.MULTILINE)}


def broken_links(path: Path) -> list[str]:
    """Relative links to a file or a heading that does not exist."""
    broken = []
    for target in _LINK.findall(prose(path)):
        if re.match(r"\w+:", target):
            continue
        name, _, anchor = target.partition("#")
        file = path.parent / name if name else path
        known = file.exists() and (not anchor or anchor in anchors(file))
        if not known:
            broken.append(target)
    return broken


def named_files(path: Path) -> Iterator[str]:
    """Paths and file names in the code spans of a file's prose."""
    folders = "|".join(map(re.escape, TOP))
    named = re.compile(rf"(?:{folders})/[\w./-]*|{_FILE.pattern}")
    return (span for span in _CODE.findall(prose(path)) if named.fullmatch(span))


def missing_files(path: Path, written: frozenset[str] = frozenset()) -> list[str]:
    """Named files that exist neither from the root, nor beside the file, nor (bare names) below its folder.

    Args:
        path: the document.
        written: names of files that a command writes, which are in no checkout.
    """

    def exists(name: str) -> bool:
        below = path.parent.rglob(name) if "/" not in name else ()
        return (ROOT / name).exists() or (path.parent / name).exists() or any(below)

    return [name for name in named_files(path) if name not in written and not exists(name)]


def commands(path: Path) -> list[str]:
    """The command lines of a file, from its `sh` blocks."""
    return [
        line for block in blocks(path) if block.language == "sh" for line in block.lines if line
    ]


def inline_commands(path: Path) -> list[str]:
    """Command lines in the prose of a file that can be typed as they stand: no placeholder, no file to be made."""
    spans = [" ".join(span.split()) for span in re.findall(r"`(trackmdp [^`]+)`", prose(path))]
    return [span for span in spans if not re.search(r"\.\.\.|FILE|mine|counts", span)]


def words_of(line: str) -> list[str] | None:
    """The words after `trackmdp`, of a command line of this package; None of any other."""
    words = shlex.split(line.split("&&")[-1])
    if words[0] == "trackmdp":
        return words[1:]
    script = re.fullmatch(r"scripts/(\w+)\.py", words[1]) if words[0] == "python" else None
    if script is None or script[1] == "benchmark":
        return None
    assert (ROOT / words[1]).is_file(), line
    return [script[1], *words[2:]]


def single(words: list[str]) -> list[str]:
    """The words of a sweep without the sweep: those that one run may have."""
    choices = [word for word in words if "," not in re.sub(r"\[[^\]]*\]", "", word)]
    return [word for word in choices if word != "-m" and not word.startswith("hydra")]
