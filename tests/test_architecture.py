"""The house keeps its shape: imports follow the arrow, nothing prints, nothing unpickles."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[1] / "trackmdp"
FILES = sorted(PACKAGE.rglob("*.py"))

BEFORE_ALL = ("errors", "seeding", "durable", "untrusted", "arrays", "statistics")

# config, world, policy, collector, loss, trainer, checkpoint and log, replay and report; build and the commands on top
ARROW = [
    ["trackmdp", *(f"trackmdp.{name}" for name in BEFORE_ALL)],
    ["trackmdp.config"],
    ["trackmdp.world"],
    ["trackmdp.policies", "trackmdp.solvers"],
    ["trackmdp.training.signals"],
    ["trackmdp.training.collect", "trackmdp.training.devices", "trackmdp.training.on_ray"],
    ["trackmdp.algos"],
    ["trackmdp.training"],
    ["trackmdp.episodes"],
    ["trackmdp.reports"],
    ["trackmdp.paper"],
    ["trackmdp.build"],
    ["trackmdp.app.bench"],
    ["trackmdp.app.commands"],
    ["trackmdp.app.sweep.schema"],
    ["trackmdp.app.outputs", "trackmdp.app.manual", "trackmdp.app.diagnose", "trackmdp.app.prepare"],
    ["trackmdp.app.sources"],
    ["trackmdp.app.compose"],
    ["trackmdp.app.questions"],
    ["trackmdp.app.sweep"],
    ["trackmdp.app.launch"],
    ["trackmdp.app", "trackmdp.app.cli"],
]


def rank(module: str) -> int:
    """How far right of the arrow's tail a module stands."""
    parts = module.split(".")
    for end in range(len(parts), 0, -1):
        for place, names in enumerate(ARROW):
            if ".".join(parts[:end]) in names and (end > 1 or len(parts) == 1):
                return place
    raise AssertionError(f"{module} has no place in the arrow")


def module_name(file: Path) -> str:
    return ".".join(file.relative_to(PACKAGE.parent).with_suffix("").parts).removesuffix(".__init__")


def imported(tree: ast.AST) -> Iterator[str]:
    """Modules of this package that a syntax tree imports, wherever the import stands."""
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom):
            assert node.level == 0, "relative import"
            for alias in node.names:
                inner = f"{node.module}.{alias.name}"
                yield inner if is_module(inner) else str(node.module)
        elif isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)


def is_module(name: str) -> bool:
    path = PACKAGE.parent.joinpath(*name.split("."))
    return path.with_suffix(".py").is_file() or (path / "__init__.py").is_file()


def against_the_arrow(module: str, source: str) -> list[str]:
    ours = (name for name in imported(ast.parse(source)) if name.split(".")[0] == "trackmdp")
    return [name for name in ours if rank(name) > rank(module)]


@pytest.mark.parametrize("file", FILES, ids=module_name)
def test_modules_import_only_from_the_left_of_the_arrow(file: Path) -> None:
    assert not against_the_arrow(module_name(file), file.read_text(encoding="utf-8"))


def test_the_arrow_test_sees_a_broken_arrow() -> None:
    assert against_the_arrow("trackmdp.world.env", "from trackmdp.algos import ppo") == ["trackmdp.algos.ppo"]
    assert against_the_arrow("trackmdp.config.tree", "def f():\n    import trackmdp.build") == ["trackmdp.build"]
    assert not against_the_arrow("trackmdp.algos.ppo", "from trackmdp.world.model import Task\nimport torch")


def test_modules_do_not_import_each_other_in_a_circle() -> None:
    edges = {
        module_name(file): {name for name in imported(ast.parse(file.read_text(encoding="utf-8"))) if is_module(name)}
        for file in FILES
        if file.name != "__init__.py"
    }
    done: set[str] = set()

    def visit(module: str, path: tuple[str, ...]) -> None:
        assert module not in path, " -> ".join((*path, module))
        if module not in done:
            for target in edges.get(module, ()):
                visit(target, (*path, module))
            done.add(module)

    for module in edges:
        visit(module, ())


LEARNERS = [file for file in FILES if module_name(file).startswith(("trackmdp.algos", "trackmdp.policies"))]


@pytest.mark.parametrize("file", LEARNERS, ids=module_name)
def test_learners_do_not_reach_for_the_motion(file: Path) -> None:
    names = set(imported(ast.parse(file.read_text(encoding="utf-8"))))
    apart = {f"trackmdp.world.{name}" for name in ("kernels", "motion", "belief")}
    apart |= {"trackmdp.build"}
    assert not names & apart
    assert not any(name.startswith("trackmdp.paper") for name in names)


@pytest.mark.parametrize("file", FILES, ids=module_name)
def test_nothing_prints_or_unpickles(file: Path) -> None:
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        if not isinstance(node, ast.Call):
            continue
        called = ast.unparse(node.func)
        arguments = {word.arg: ast.unparse(word.value) for word in node.keywords}
        assert called not in ("print", "pickle.load", "pickle.loads"), f"{file}:{node.lineno}"
        if called == "np.load":
            assert arguments.get("allow_pickle") == "False", f"{file}:{node.lineno}"
        if called == "torch.load":
            assert arguments.get("weights_only") == "True", f"{file}:{node.lineno}"


def test_the_top_level_holds_only_what_belongs_there() -> None:
    allowed = {"pyproject.toml", "trackmdp", "conf", "scripts", "tests", "README.md"}
    ignored = {"runs", "multirun", "outputs", "build", "dist"}
    found = {path.name for path in PACKAGE.parent.iterdir() if not path.name.startswith((".", "__pycache__"))}
    assert {name for name in found if not name.endswith(".egg-info")} - ignored == allowed
