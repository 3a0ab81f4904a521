"""A stand-in for `torch._dynamo`, torch's compiler: it is loaded when something is compiled, and not before.

A command compiles nothing. But tensordict marks its functions for the compiler while it is imported (`allow_in_graph`,
since pytorch/tensordict#1636), TorchRL does as well, and `torch.optim` imports the compiler at its first step. It takes
half a second of CPU time, with SymPy. torch itself has put the same import off (pytorch/pytorch#162595).
"""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable
from functools import partial
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from importlib.util import spec_from_loader
from types import ModuleType
from typing import Any

_NAME = "torch._dynamo"


class _Deferred(ModuleType):
    """Keeps the marks that functions get, and hands them on when the compiler is loaded."""

    def __init__(self) -> None:
        super().__init__(_NAME)
        self.__path__ = []  # a package: imports of its modules come to `_Modules`
        self._marked: list[tuple[str, Callable[..., Any]]] = []
        self._disabled: list[tuple[Any, bool]] = []

        self.allow_in_graph = partial(self._mark, "allow_in_graph")
        self.assume_constant_result = partial(self._mark, "assume_constant_result")

    def _mark(self, mark: str, function: Callable[..., Any]) -> Callable[..., Any]:
        self._marked.append((mark, function))
        return function

    def disable(self, function: Any = None, recursive: bool = True, **options: Any) -> Any:
        if "wrapping" not in options:
            # torch's own wrapper, which comes back here with `wrapping` at the first call of the function.
            return importlib.import_module("torch")._disable_dynamo(function, recursive)
        self._disabled.append((function, recursive))
        return function

    def graph_break(self, *_: Any) -> None:
        pass

    def __getattr__(self, name: str) -> Any:
        # Special names are asked of every module, by `inspect` for one; nothing is compiled by that.
        if name.startswith("__"):
            raise AttributeError(name)
        return getattr(self.load(), name)

    def load(self) -> Any:
        """The compiler, with all marks."""
        if sys.modules.get(_NAME) is self:
            del sys.modules[_NAME]
            vars(sys.modules["torch"]).pop("_dynamo", None)
            compiler = importlib.import_module(_NAME)
            for mark, function in self._marked:
                getattr(compiler, mark)(function)
            for function, recursive in self._disabled:
                found = compiler.disable(function, recursive, wrapping=False)
                vars(function)["__dynamo_disable"] = found  # where `torch._disable_dynamo` keeps it
        return sys.modules[_NAME]


class _Modules(MetaPathFinder, Loader):
    """Modules of the compiler's package: an import of one loads the package."""

    def __init__(self, package: _Deferred) -> None:
        self._package = package

    def find_spec(self, fullname: str, *_: Any) -> ModuleSpec | None:
        waits = fullname.startswith(f"{_NAME}.") and sys.modules[_NAME] is self._package
        return spec_from_loader(fullname, self) if waits else None

    def create_module(self, spec: ModuleSpec) -> ModuleType:
        self._package.load()
        return importlib.import_module(spec.name)

    def exec_module(self, module: ModuleType) -> None:
        """Nothing: the module is there."""


def defer_compiler() -> None:
    """From now on `torch._dynamo` is loaded when something of it is used, unless it is loaded already."""
    if _NAME not in sys.modules:
        sys.modules[_NAME] = package = _Deferred()
        sys.meta_path.insert(0, _Modules(package))
