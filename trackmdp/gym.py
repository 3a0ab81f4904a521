"""Registers `trackmdp/Track-v0` with Gymnasium, whichever of the two packages is imported first.

    import gymnasium, trackmdp
    env = gymnasium.make("trackmdp/Track-v0", kernel="random_walk", size=5, cost=0.1)
    env = gymnasium.make_vec("trackmdp/Track-v0", num_envs=64, world=world)

`import trackmdp` does it; ``gymnasium.make("trackmdp:trackmdp/Track-v0")`` needs no import. Gymnasium is an extra (gym)
and takes a fifth of a second to import, so that it is not imported here: where it comes later, the registration follows
its own import. (Gymnasium 1.0 and later look at no entry points.)
"""

from __future__ import annotations

import sys
from importlib.machinery import ModuleSpec, PathFinder
from types import ModuleType
from typing import Any

ID = "trackmdp/Track-v0"
_REGISTRY = "gymnasium.envs.registration"


def _register(registration: ModuleType) -> None:
    if ID not in registration.registry:
        # By name: torch is loaded when an environment is made.
        registration.register(
            ID,
            "trackmdp.environment.gym_env:TrackGym",
            vector_entry_point="trackmdp.environment.gym_env:TrackVector",
        )


class _Finder:
    """Finds Gymnasium's registry as Python does; once it is loaded, `_register` follows.

    Not a `MetaPathFinder`: Python asks for `find_spec` alone, and `importlib.abc` loads half the standard library.
    """

    def find_spec(self, fullname: str, *where: Any) -> ModuleSpec | None:
        if fullname != _REGISTRY:
            return None
        sys.meta_path.remove(self)
        found = PathFinder.find_spec(fullname, *where)
        if found is not None and found.loader is not None:
            load = found.loader.exec_module

            def load_and_register(module: ModuleType) -> None:
                load(module)
                _register(module)

            found.loader.exec_module = load_and_register  # type: ignore[method-assign]
        return found


if _REGISTRY in sys.modules:
    _register(sys.modules[_REGISTRY])
else:
    sys.meta_path.insert(0, _Finder())
