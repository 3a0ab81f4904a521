"""The house keeps its shape: imports follow the arrow, nothing prints, nothing unpickles."""

from __future__ import annotations

import ast
import io
import tokenize
from collections import Counter
from collections.abc import Iterable, Iterator
from functools import cache
from pathlib import Path

PACKAGE = Path(__file__).parents[1] / "trackmdp"
FILES = sorted(PACKAGE.rglob("*.py"))

BEFORE_ALL = (
    "errors",
    "imports",
    "deferred",
    "notebook",
    "gym",
    "examples",
    "seeding",
    "durable",
    "untrusted",
    "statistics",
    "machine",
    "signals",
    "terminal",
    "cluster",
)

# What each may import: itself, and all before it.
ARROW = [
    ["trackmdp", *(f"trackmdp.{name}" for name in BEFORE_ALL)],
    ["trackmdp.config"],
    ["trackmdp.grid"],
    ["trackmdp.arrays"],
    ["trackmdp.motion"],
    ["trackmdp.memory"],
    ["trackmdp.sensing"],
    ["trackmdp.recordings"],
    ["trackmdp.world"],
    ["trackmdp.environment"],
    ["trackmdp.policies"],
    ["trackmdp.solvers"],
    ["trackmdp.algos"],
    ["trackmdp.training"],
    ["trackmdp.episodes"],
    ["trackmdp.reports"],
    ["trackmdp.paper"],
    ["trackmdp.app.commands"],
    [
        "trackmdp.app.completion",
        "trackmdp.app.manual",
        "trackmdp.app.words",
        "trackmdp.app.prepare",
    ],
    ["trackmdp.app.sources"],
    ["trackmdp.app.composer"],
    ["trackmdp.app.sweep"],
    ["trackmdp.app.launch"],
    ["trackmdp.app", "trackmdp.app.cli", "trackmdp.__main__"],
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
    return ".".join(file.relative_to(PACKAGE.parent).with_suffix("").parts).removesuffix(
        ".__init__"
    )


@cache
def trees() -> dict[str, ast.Module]:
    return {module_name(file): ast.parse(file.read_text(encoding="utf-8")) for file in FILES}


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


def against_the_arrow(module: str, tree: ast.AST) -> list[str]:
    if (
        module == "trackmdp"
    ):  # the front door names what stands behind it, and imports it when first asked for
        return []
    ours = (name for name in imported(tree) if name.split(".")[0] == "trackmdp")
    return [name for name in ours if rank(name) > rank(module)]


def test_modules_import_only_from_the_left_of_the_arrow() -> None:
    found = {module: against_the_arrow(module, tree) for module, tree in trees().items()}
    assert not {module: names for module, names in found.items() if names}


def test_the_arrow_test_sees_a_broken_arrow() -> None:
    for module, source, found in (
        (
            "trackmdp.environment.env",
            "from trackmdp.algos import on_policy",
            ["trackmdp.algos.on_policy"],
        ),
        ("trackmdp.config.tree", "def f():\n    import trackmdp.app.cli", ["trackmdp.app.cli"]),
        ("trackmdp.algos.on_policy", "from trackmdp.world.model import Task\nimport torch", []),
    ):
        assert against_the_arrow(module, ast.parse(source)) == found


def test_modules_do_not_import_each_other_in_a_circle() -> None:
    packages = {module_name(file) for file in FILES if file.name == "__init__.py"}
    edges = {
        module: {name for name in imported(tree) if is_module(name)}
        for module, tree in trees().items()
        if module not in packages
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


def top_level(tree: ast.AST) -> set[str]:
    """The packages that a syntax tree imports from, wherever the import stands."""
    found = {name.split(".")[0] for name in imported(tree)}
    return found | {
        alias.name.split(".")[0]
        for node in ast.walk(tree)
        if isinstance(node, ast.Import)
        for alias in node.names
    }


def test_hydra_stays_in_app_and_the_schema_is_light() -> None:
    for module, tree in trees().items():
        used = top_level(tree)
        assert module.startswith("trackmdp.app") or "hydra" not in used, module
        if module.startswith("trackmdp.config") or module in ("trackmdp", "trackmdp.errors"):
            assert not used & {"torch", "tensordict", "torchrl", "numpy", "scipy"}, module


def asks_for_a_schema(tree: ast.AST) -> list[int]:
    """Lines where the class of a config decides: an algorithm from outside would fall through."""
    return [
        node.lineno
        for node in ast.walk(tree)
        if isinstance(node, ast.Call)
        and ast.unparse(node.func) in ("isinstance", "issubclass", "type")
        and any(
            isinstance(part, ast.Name) and part.id.endswith("Config") for part in ast.walk(node)
        )
    ]


def test_nothing_but_config_and_app_asks_for_the_class_of_a_config() -> None:
    for module, tree in trees().items():
        assert module.startswith(("trackmdp.config", "trackmdp.app")) or not asks_for_a_schema(
            tree
        ), module


def test_the_test_of_schemas_sees_one() -> None:
    assert asks_for_a_schema(
        ast.parse("x = 1\nif isinstance(cfg.algo, (PpoConfig, A2cConfig)): pass")
    ) == [2]


SAME_BY_DESIGN = {"run": "trackmdp.app.commands.", "solve": "trackmdp.solvers."}
"""Names that a whole row of modules has, since they are called alike."""


def public_names() -> dict[str, list[str]]:
    """Public name -> the modules that define it: functions and classes without an underscore."""
    found: dict[str, list[str]] = {}
    for file in FILES:
        if file.name == "__init__.py":
            continue
        body = trees()[module_name(file)].body
        for name in {
            node.name for node in body if isinstance(node, ast.FunctionDef | ast.ClassDef)
        }:
            if not name.startswith("_"):
                found.setdefault(name, []).append(module_name(file))
    return found


def test_no_public_name_means_two_things() -> None:
    twice = {name: modules for name, modules in public_names().items() if len(modules) > 1}
    for name, prefix in SAME_BY_DESIGN.items():
        if all(module.startswith(prefix) for module in twice.get(name, ())):
            twice.pop(name, None)
    assert not twice


def modules_by_name(modules: Iterable[str]) -> dict[str, list[str]]:
    """Last part of a module's name -> the modules of that name, where there are several."""
    found: dict[str, list[str]] = {}
    for module in modules:
        found.setdefault(module.rpartition(".")[2], []).append(module)
    return {name: same for name, same in found.items() if len(same) > 1}


def test_no_module_name_means_two_things() -> None:
    """A command's module and the one whose function of that name it runs, such as `solve`, are one thing."""
    functions = {(module, name) for name, modules in public_names().items() for module in modules}
    files = [module_name(file) for file in FILES if file.name != "__init__.py"]
    for name, modules in modules_by_name(files).items():
        commands = [module for module in modules if module.startswith("trackmdp.app.commands.")]
        others = [module for module in modules if module not in commands]
        assert len(commands) == len(others) == 1, modules
        assert (others[0], name) in functions, modules


def test_modules_of_one_name_are_seen() -> None:
    assert modules_by_name(["a.page", "b.page", "b.other"]) == {"page": ["a.page", "b.page"]}


def test_learners_do_not_reach_for_the_motion() -> None:
    for module, tree in trees().items():
        if module.startswith(("trackmdp.algos", "trackmdp.policies")):
            names = set(imported(tree))
            assert not any(name.startswith("trackmdp.motion") for name in names), module
            assert not any(name.startswith("trackmdp.paper") for name in names), module


def test_nothing_prints_or_unpickles() -> None:
    nodes = ((module, node) for module, tree in trees().items() for node in ast.walk(tree))
    for module, node in nodes:
        if not isinstance(node, ast.Call):
            continue
        called = ast.unparse(node.func)
        arguments = {word.arg: ast.unparse(word.value) for word in node.keywords}
        assert called not in ("print", "pickle.load", "pickle.loads"), f"{module}:{node.lineno}"
        if called == "np.load":
            assert arguments.get("allow_pickle") == "False", f"{module}:{node.lineno}"
        if called == "torch.load":
            assert arguments.get("weights_only") == "True", f"{module}:{node.lineno}"


def size_of(source: str) -> tuple[int, int]:
    """Tokens of code (no docstrings, comments), which no layout changes, and the number of comments."""
    texts: set[int] = set()
    for node in ast.walk(ast.parse(source)):
        if (
            isinstance(node, ast.Expr)
            and isinstance(node.value, ast.Constant)
            and isinstance(node.value.value, str)
        ):
            texts |= set(range(node.lineno, (node.end_lineno or node.lineno) + 1))
    layout = (tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT, tokenize.ENDMARKER)
    # Python 3.12 takes an f-string apart, and 3.11 does not: it is one token here.
    begins, ends = (getattr(tokenize, f"FSTRING_{name}", None) for name in ("START", "END"))
    tokens = comments = inside = 0
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type == tokenize.COMMENT:
            comments += 1
        elif token.type not in layout and token.start[0] not in texts:
            tokens += inside == 0
            inside += (token.type == begins) - (token.type == ends)
    return tokens, comments


def test_tokens_and_comments_are_counted() -> None:
    source = '"""A module."""\n\nx = [  # why\n    1,\n]\n# why\n\n\ndef f():\n    """Text."""\n    return f"{x}"\n'
    assert size_of(source) == (
        len(["x", "=", "[", "1", ",", "]", "def", "f", "(", ")", ":", "return", "f-string"]),
        2,
    )


def long_functions(tree: ast.AST) -> list[str]:
    """Names of functions of more than 40 lines, not counting the docstring."""

    def lines(node: ast.FunctionDef) -> int:
        """A docstring is the first statement."""
        first = node.body[0] if ast.get_docstring(node) is not None else None
        docstring = 0 if first is None else (first.end_lineno or 0) - first.lineno + 1
        return (node.end_lineno or 0) - node.lineno + 1 - docstring

    functions = (node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef))
    return [node.name for node in functions if lines(node) > 40]


def test_functions_are_short() -> None:
    found = {module: long_functions(tree) for module, tree in trees().items()}
    assert not {module: names for module, names in found.items() if names}


def test_long_functions_are_seen_and_docstrings_not_counted() -> None:
    long = 'def f():\n    """A\n\n    B.\n    """\n' + "    x = 1\n" * 39
    assert long_functions(ast.parse(long)) == []
    assert long_functions(ast.parse(long + "    x = 1\n")) == ["f"]


def test_every_package_says_why() -> None:
    """At least 4 comments per 1,000 tokens of code."""
    code, comments = Counter[str](), Counter[str]()
    for file in FILES:
        tokens, found = size_of(file.read_text(encoding="utf-8"))
        package = file.relative_to(PACKAGE).parts[0] if file.parent != PACKAGE else "."
        code[package] += tokens
        comments[package] += found
    rates = {name: 1000 * comments[name] / code[name] for name in code}
    assert {name: rate for name, rate in rates.items() if rate < 4} == {}


def test_the_top_level_holds_only_what_belongs_there() -> None:
    allowed = {"pyproject.toml", "trackmdp", "conf", "scripts", "tests", "README.md"}
    ignored = {"runs", "multirun", "outputs", "build", "dist"}
    found = {
        path.name
        for path in PACKAGE.parent.iterdir()
        if not path.name.startswith((".", "__pycache__"))
    }
    assert {name for name in found if not name.endswith(".egg-info")} - ignored == allowed
