"""From typed words to a composed config, by Hydra's public calls; a config is data, and names no code."""

from __future__ import annotations

import os
import warnings
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any, Self

from hydra import compose, initialize_config_dir
from hydra.core.config_store import ConfigStore
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.core.plugins import Plugins
from omegaconf import DictConfig, OmegaConf

from trackmdp.app.sources import searched
from trackmdp.app.words import diagnose, refuse_deleted
from trackmdp.config import GROUPS, ROOTS, conf_dir
from trackmdp.config.registry import load_plugins, register_resolvers
from trackmdp.config.sweeping import PLUGINS
from trackmdp.errors import UserError

_NO_LOGGING = {"version": 1, "root": None, "disable_existing_loggers": False}
"""`hydra/job_logging=none`; all others name classes and files."""


_stored: dict[tuple[str, str], type[Any]] = {}
"""The schema of each group and choice that Hydra knows, of the commands in the group `""`."""


def register() -> None:
    """Make every schema known to Hydra as `base_<name>`, for the `defaults` lists in `conf/`."""
    register_resolvers()
    # `${oc.deprecated:...}` and a missing search path are refused in one line, in place of a warning in several.
    warnings.filterwarnings("error", module=r"omegaconf\.resolvers")
    warnings.filterwarnings("error", message=r"provider=")
    load_plugins()  # installed packages add their choices to `GROUPS`
    # With a schema Hydra refuses an unknown key or a wrong type while it composes.
    groups: dict[str, Any] = {"": ROOTS, **GROUPS}
    schemas = {
        (group, name): schema
        for group, members in groups.items()
        for name, schema in members.items()
    }
    if schemas == _stored:  # making nodes of them takes longer than composing
        return
    _stored.update(schemas)
    store = ConfigStore.instance()
    for (group, name), schema in schemas.items():
        store.store(group=group or None, name=f"base_{name}", node=schema)
    # Hydra's plugins store launchers and sweepers of the same names, which ours replace: first load, then take out.
    Plugins.instance()
    for part in PLUGINS:
        for name in GROUPS[f"hydra/{part}"]:
            # Where `hydra-joblib-launcher` is installed, Hydra would take the `hydra/launcher/joblib` that it stores
            # for the schema of our file of that name.
            store.repo["hydra"][part].pop(f"{name}.yaml", None)


class Composer(ExitStack):
    """Composes configs of one command; Hydra is initialised while the context is open.

    Args:
        command: `conf/<command>.yaml` is composed, unless `name` is another file.
        words: as typed.
        name: of the primary config.
        folders: further folders (`--config-dir`).

    Raises:
        UserError: a folder is missing.
    """

    def __init__(
        self,
        command: str,
        words: Sequence[str] = (),
        name: str | None = None,
        folders: Sequence[str] = (),
    ) -> None:
        super().__init__()
        self.command, self.name, self.words = command, name or command, list(words)
        for folder in folders:
            if not os.path.isdir(folder):  # noqa: PTH112  False where pathlib raises: a name that is too long
                raise UserError(f"--config-dir {folder}: no such folder")
        self._folders = list(map(Path, folders))

    def __enter__(self) -> Self:
        # Plugins of this package's are loaded by it, and their folders are searched as soon as Hydra is initialised.
        register()
        # Afterwards, as the last: Hydra's state is a global of the process, and closing restores the one from before.
        self.callback(lambda: GlobalHydra.instance().clear())
        self.enter_context(searched(self._folders, load_plugins()))
        # Without `version_base` Hydra warns, and behaves as its version 1.1. An absolute folder works for a clone, an
        # editable install and a wheel; a relative one works for a clone alone.
        self.enter_context(
            initialize_config_dir(conf_dir(), job_name="trackmdp", version_base="1.3")
        )
        return self

    def __call__(self, words: Sequence[str]) -> DictConfig:
        """The config of `words`, with Hydra's own under `hydra`; `${hydra:...}` then refers to it.

        Raises:
            UserError: the words do not make a config, or the config names code to call.
        """
        try:
            cfg = self._compose(words)
            refuse_deleted(self.command, words, self._compose)
        except Exception as error:  # of many kinds, ValueError among them; all are about the words
            raise diagnose(error, self.command, words, self._compose) from error
        _refuse_code(cfg, words)
        # `compose`, unlike Hydra's own entry point, leaves this to the caller; without it `${hydra:...}` cannot be
        # resolved.
        HydraConfig.instance().set_config(cfg)
        return cfg

    def _compose(self, words: Sequence[str]) -> DictConfig:
        # With Hydra's part: folders, and how a sweep is run.
        return compose(self.name, overrides=list(words), return_hydra_config=True)


def _refuse_code(cfg: DictConfig, words: Sequence[str]) -> None:
    """Refuse a config by which code of others would run; nothing here makes an object of a `_target_`.

    Raises:
        UserError: it configures logging or callbacks, or a file in it sets the environment or the search path.
    """
    # Unresolved: resolving would call resolvers before anything is checked.
    hydra: Any = OmegaConf.to_container(cfg.hydra, resolve=False)
    if hydra["searchpath"]:
        raise UserError("hydra.searchpath: expected --config-dir FOLDER")
    for name in ("job_logging", "hydra_logging"):  # read by Python's logging.config, which calls
        if hydra[name] != _NO_LOGGING:
            raise UserError(f"hydra/{name}: expected none, a config names no code to call")
    if hydra["callbacks"]:
        raise UserError("hydra.callbacks: not read, a config names no code to call")
    if not isinstance(hydra["verbose"], (bool, str, list)):
        raise UserError("hydra.verbose: expected true, false, or a list of loggers")
    # PATH or LD_PRELOAD from a file of somebody's data would decide which code every child process runs.
    if hydra["job"]["env_set"] and not any("hydra.job.env_" in word for word in words):
        raise UserError(
            "hydra.job.env_set: not taken from a file; set the environment in the shell"
        )
