"""The handbooks: every link, named file, heading and Python block of all `*.md` files is true."""

from __future__ import annotations

import re
import tomllib
from inspect import signature
from itertools import zip_longest
from pathlib import Path

import pytest
import yaml

from tests.documents import (
    ROOT,
    Block,
    anchors,
    blocks,
    broken_links,
    commands,
    documents,
    inline_commands,
    missing_files,
    prose,
    single,
    slug,
    words_of,
)
from trackmdp.app.cli import main
from trackmdp.config import GROUPS, ROOTS
from trackmdp.motion.kernels import drift

THEORY = ROOT / "trackmdp" / "theory.md"
DOCUMENTS = documents()
WRITTEN = frozenset(
    {
        "best.pt",
        "comparison.json",
        "config.yaml",
        "episode.html",
        "episodes.layout.json",
        "evaluation.json",
        "frontier.csv",
        "frontier.json",
        "frontier.svg",
        "mean_budget.json",
        "metrics.csv",
        "paper.json",
        "picture.txt",
        "plan.json",
        "policy.npz",
        "problem.npz",
        "report.html",
        "runs.csv",
        "sets.json",
        "sets.npz",
        "solution.json",
        "summary.json",
        "tracks.html",
        "tracks.json",
    }
)
"""Files that commands write."""


def name_of(path: Path) -> str:
    return path.relative_to(ROOT).as_posix()


@pytest.mark.parametrize("path", DOCUMENTS, ids=name_of)
def test_links_lead_to_files_and_headings(path: Path) -> None:
    assert broken_links(path) == []


@pytest.mark.parametrize("path", DOCUMENTS, ids=name_of)
def test_named_files_exist(path: Path) -> None:
    assert missing_files(path, WRITTEN) == []


def test_the_checks_see_a_broken_link_and_a_missing_file(tmp_path: Path) -> None:
    (tmp_path / "other.md").write_text("# A heading, here\n")
    path = tmp_path / "page.md"
    path.write_text(
        "[a](other.md#a-heading-here) [b](other.md#none) [c](none.md) [d](https://x.org/none.md)\n"
        "`tests/conftest.py` `tests/none.py` `other.md` `lost.yaml` `policy.npz`\n"
        "```sh\n`tests/in_a_block.py` [e](nowhere.md)\n```\n"
    )
    assert broken_links(path) == ["other.md#none", "none.md"]
    assert missing_files(path, WRITTEN) == ["tests/none.py", "lost.yaml"]


OURS = {
    tuple(words): (path, line)
    for path in DOCUMENTS
    for line in [*commands(path), *inline_commands(path)]
    if (words := words_of(line)) is not None
}.values()
"""Command lines of this package in all documents, in blocks and in the prose."""


@pytest.mark.parametrize(("path", "line"), OURS, ids=[f"{name_of(p)}:{x}" for p, x in OURS])
def test_every_command_is_one_that_the_options_allow(
    path: Path, line: str, empty_folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command, *words = single(words_of(line) or [])
    assert main([command, *words, "--cfg", "job"]) == 0, capsys.readouterr().err


def block_of(path: Path, language: str, begin: str) -> str:
    """The text of the one block of a language that begins so."""
    (text,) = (
        block.text
        for block in blocks(path)
        if block.language == language and block.text.startswith(begin)
    )
    return text


def test_the_config_of_ones_own_is_taken(
    empty_folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    own = empty_folder / "mine" / "experiment" / "dear.yaml"
    own.parent.mkdir(parents=True)
    own.write_text(block_of(ROOT / "conf/README.md", "yaml", "# @package"), encoding="utf-8")
    assert main(["train", "--config-dir", "mine", "experiment=dear", "--cfg", "job"]) == 0
    shown = yaml.safe_load(capsys.readouterr().out)
    assert "clip_epsilon" in shown["algo"] and shown["cost"]["sensor"] == 0.3


def test_the_signature_of_a_kernel_is_that_of_drift() -> None:
    shown = block_of(ROOT / "conf/README.md", "text", "def drift")
    assert re.findall(r"\w+(?=[,)])", shown) == [*signature(drift).parameters]


def test_every_command_has_a_section() -> None:
    handbook = ROOT / "scripts" / "README.md"
    assert set(ROOTS) <= anchors(handbook)
    typed = {(words_of(line) or [""])[0] for line in commands(handbook)}
    assert set(ROOTS) <= typed


def test_the_handbook_of_configs_names_every_group_and_choice() -> None:
    text = prose(ROOT / "conf" / "README.md")
    rows = {row[0]: row[1] for row in re.findall(r"^\| `([\w/]+)` \| .*? \| (.+) \|$", text, re.M)}
    files = {path.stem for path in (ROOT / "conf" / "experiment").glob("*.yaml")}
    choices = {group: {*members} - {"given"} for group, members in GROUPS.items()}
    choices |= {"experiment": files}
    shipped = {
        group: {name for name in names if (ROOT / "conf" / group / f"{name}.yaml").is_file()}
        for group, names in choices.items()
    }
    assert {group: set(re.findall(r"`(\w+)`", row)) for group, row in rows.items()} == shipped
    assert set(re.findall(r"`(\w+)\.yaml`", text)) >= set(ROOTS)


def test_the_handbook_of_examples_links_every_example() -> None:
    folder = ROOT / "scripts" / "examples"
    linked = set(re.findall(r"\]\(([\w/]+\.py)\)", prose(folder / "README.md")))
    shown = {path.relative_to(folder).as_posix() for path in folder.rglob("*.py")}
    assert linked == {name for name in shown if "trackmdp_stone_soup" not in name}


def test_the_handbooks_name_every_package_folder_and_marker() -> None:
    package, tests = prose(ROOT / "trackmdp/README.md"), prose(ROOT / "tests/README.md")
    for folder in (ROOT / "trackmdp").iterdir():
        if (folder / "__init__.py").is_file():
            assert f"| `trackmdp/{folder.name}` |" in package
            missing = not (ROOT / "tests" / folder.name).is_dir()
            assert missing or f"`tests/{folder.name}`" in tests
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    for marker in settings["tool"]["pytest"]["ini_options"]["markers"]:
        assert f"| `{marker.split(':')[0]}` |" in tests


def sources() -> list[Path]:
    """Python files that may cite the theory."""
    return [path for top in ("trackmdp", "scripts", "tests") for path in (ROOT / top).rglob("*.py")]


def test_docstrings_cite_sections_of_the_theory_that_exist() -> None:
    known, cited = anchors(THEORY), set()
    for path in sources():
        text = path.read_text(encoding="utf-8")
        for anchor in re.findall(r"theory\.md#([\w-]+)", text):
            assert anchor in known, f"{name_of(path)}: {anchor}"
            cited.add(anchor)
        if path != Path(__file__):
            assert not re.search(r"\(theory[:,-]|theory-extensions", text), name_of(path)
    assert len(cited) >= 5


def theory_sections() -> dict[str, str]:
    """Heading -> text of each section."""
    parts = re.split(r"^## (.+)$", prose(THEORY), flags=re.MULTILINE)
    return dict(zip(parts[1::2], parts[2::2], strict=True))


def test_each_section_of_the_theory_names_its_module_and_its_test() -> None:
    sections = theory_sections()
    assert sections.popitem()[0] == "Further reading"
    for heading, text in sections.items():
        _, code, tests = re.split(r"\bCode: |\bTests: ", text)
        assert re.search(r"`trackmdp/[\w/]+\.py`", code), heading
        assert re.search(r"`tests/[\w/]+\.py`", tests), heading


def test_the_theorys_contents_list_all_sections_in_order() -> None:
    listed = re.findall(r"^- \[([^\]]+)\]\(#([\w-]+)\)$", prose(THEORY), re.MULTILINE)
    assert [heading for heading, _ in listed] == [*theory_sections()]
    assert all(slug(heading) == anchor for heading, anchor in listed)


def python_blocks() -> list[tuple[Path, Block, Block | None]]:
    """Python blocks of all handbooks, each with the `text` block of its output, if one follows.

    The README's own blocks are run by `test_readme`.
    """
    found = []
    for path in DOCUMENTS:
        if path == ROOT / "README.md":
            continue
        every = blocks(path)
        for block, after in zip_longest(every, every[1:]):
            if block.language == "python":
                shown = after if after is not None and after.language == "text" else None
                found.append((path, block, shown))
    return found


@pytest.mark.parametrize(
    ("path", "block", "shown"),
    [
        pytest.param(
            *case,
            id=f"{name_of(case[0])}:{case[1].number}",
            marks=[pytest.mark.slow] if "tm.train(" in case[1].text else [],
        )
        for case in python_blocks()
    ],
)
def test_python_blocks_print_their_output(
    path: Path,
    block: Block,
    shown: Block | None,
    empty_folder: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    exec(compile(block.text, name_of(path), "exec"), {"__name__": "__main__"})
    if shown is not None:
        assert capsys.readouterr().out.splitlines() == shown.lines
