"""From typed words to a composed config, by Hydra's public calls: what is composed is data, and names no code."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any, Self

from hydra import compose, initialize_config_dir
from hydra.core.config_store import ConfigStore
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.core.plugins import Plugins
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from trackmdp.app.sources import searched
from trackmdp.app.words import diagnose, parsed
from trackmdp.config import GROUPS, ROOTS, conf_dir
from trackmdp.config.registry import load_plugins, register_resolvers
from trackmdp.config.sweeping import PLUGINS
from trackmdp.config.untrusted import entries, names_code
from trackmdp.errors import UserError

_LOG_FILE = "${hydra.runtime.output_dir}/${hydra.job.name}.log"
"""The one log file that Hydra's own logging configs write."""


_HYDRAS_OWN = {
    "_target_": "hydra._internal.core_plugins.basic_sweeper.BasicSweeper",
    "max_batch_size": None,
    "params": None,
}
"""Hydra's default under `hydra.sweeper`, where a primary config chooses no sweeper; this package never calls it."""


_stored: dict[tuple[str, str], type[Any]] = {}
"""The schema of each group and choice that Hydra knows, of the commands in the group `""`."""


def register() -> None:
    """Make every schema known to Hydra as `base_<name>`, for the `defaults` lists in `conf/`."""
    register_resolvers()
    # What stands in a config is data: `${oc.deprecated:...}` is refused as it would warn, in lines of its own.
    warnings.filterwarnings("error", module=r"omegaconf\.resolvers")
    load_plugins()  # installed packages add their choices to `GROUPS`
    # A config typed by a dataclass is what makes Hydra refuse an unknown key or a wrong type while it composes.
    schemas = {("", command): root for command, root in ROOTS.items()}
    schemas |= {(group, name): schema for group, members in GROUPS.items() for name, schema in members.items()}
    if schemas == _stored:  # making nodes of them takes longer than composing
        return
    _stored.update(schemas)
    store = ConfigStore.instance()
    for (group, name), schema in schemas.items():
        store.store(group=group or None, name=f"base_{name}", node=schema)
    # First load Hydra's plugins, then take out what they stored: what they store later would stay.
    Plugins.instance()  # Hydra's plugins store launchers and sweepers of the same names, which ours replace
    for part in PLUGINS:
        for name in GROUPS[f"hydra/{part}"]:
            # Where `hydra-joblib-launcher` is installed, Hydra would take the `hydra/launcher/joblib` that it stores
            # for the schema of our file of that name.
            store.repo["hydra"][part].pop(f"{name}.yaml", None)


class Composer:
    """Composes configs of one command; Hydra is initialised while the context is open.

    Args:
        command: whose `conf/<command>.yaml` is composed, unless `name` is another file.
        words: what was typed, for the folders that `hydra.searchpath=` names.
        name: of the primary config.
        extra: a further folder (`--config-dir`).

    Raises:
        UserError: a folder is not there.
    """

    def __init__(
        self, command: str, words: Sequence[str] = (), name: str | None = None, extra: str | None = None
    ) -> None:
        self.command, self.name = command, name or command
        # Left in, Hydra would read those folders itself, without the checks of `trackmdp.app.sources`.
        self.words = [word for word in words if not _is_search_path(word)]
        """What was typed, but for search paths."""
        named = [path for word in words if _is_search_path(word) for path in _search_path(word)]
        self._users = [_existing("--config-dir", extra)] if extra is not None else []
        self._users += [_existing("hydra.searchpath", path) for path in named]
        self._opened = ExitStack()

    def __enter__(self) -> Self:
        # Plugins of this package's are loaded by it, and their folders are searched as soon as Hydra is initialised.
        register()
        self._opened.enter_context(searched(self._users, load_plugins()))
        # Without `version_base` Hydra warns, and behaves as its version 1.1. An absolute folder works for a clone, an
        # editable install and a wheel; a relative one works for a clone alone.
        self._opened.enter_context(initialize_config_dir(conf_dir(), job_name="trackmdp", version_base="1.3"))
        return self

    def __exit__(self, *_: object) -> None:
        # In this order: closing restores what was initialised before, and Hydra's state is a global of the process.
        self._opened.close()
        GlobalHydra.instance().clear()

    def __call__(self, words: Sequence[str]) -> DictConfig:
        """The config of `words`, with Hydra's own under `hydra`; `${hydra:...}` then refers to it.

        Raises:
            UserError: the words do not make a config, or the config names code to call.
        """
        try:
            cfg = self._compose(words)
        except Exception as error:  # Hydra raises many kinds, ValueError among them; all are about what was typed
            raise diagnose(error, self.command, words, self._compose) from error
        # Composing makes no object of what a config names; what would comes later, so this is early enough.
        _refuse_code(cfg, words)
        # `compose`, unlike Hydra's own entry point, leaves this to the caller; without it `${hydra:...}` cannot be
        # resolved.
        HydraConfig.instance().set_config(cfg)
        return cfg

    def _compose(self, words: Sequence[str]) -> DictConfig:
        # With Hydra's part, which says where to write, what to log, and how a sweep is run.
        return compose(self.name, overrides=list(words), return_hydra_config=True)


def _refuse_code(cfg: DictConfig, words: Sequence[str]) -> None:
    """Refuse a config by which anything but our own code would be called.

    Raises:
        UserError: it names a callable, a callback, a launcher or a sweeper that is none of ours, or logging of its own.
    """
    # Unresolved: resolving would already call resolvers, before anything is checked.
    plain = OmegaConf.to_container(cfg, resolve=False)
    assert isinstance(plain, dict)
    for part in PLUGINS:
        known = GROUPS[f"hydra/{part}"]
        # It names a class by `_target_`, which the search for names of code at the end would find.
        if plain["hydra"][part] == _HYDRAS_OWN:
            del plain["hydra"][part]
        # The type of a node is the schema it was composed from, another for the launcher of another package. Keys that
        # `+` adds to ours keep the type, and are looked through at the end.
        elif OmegaConf.get_type(cfg.hydra, part) not in known.values():
            raise UserError(f"hydra/{part}: expected one of {', '.join(known)}")
    # Hydra would make an object of each entry, by its `_target_`.
    if cfg.hydra.callbacks:
        raise UserError(f"hydra.callbacks.{next(iter(cfg.hydra.callbacks))}: a config names no code to call")
    verbose = plain["hydra"]["verbose"]
    if not (
        isinstance(verbose, (bool, str))
        or (isinstance(verbose, list) and all(isinstance(name, str) for name in verbose))
    ):
        raise UserError(f"hydra.verbose={verbose}: expected true, false, or a list of loggers")
    # PATH or LD_PRELOAD from a file that came with a data set would decide what every child process runs.
    if cfg.hydra.job.env_set and not any("hydra.job.env_" in word for word in words):
        raise UserError("hydra.job.env_set: not taken from a file; set the environment in the shell")
    # Hydra appends it to the run's folder: `../other` would be written to as well.
    if Path(cfg.hydra.output_subdir or "x").name != (cfg.hydra.output_subdir or "x"):
        raise UserError(f"hydra.output_subdir={cfg.hydra.output_subdir}: expected a name, or null")
    for name in ("job_logging", "hydra_logging"):
        _check_logging(cfg.hydra, name)
    del plain["hydra"]["job_logging"], plain["hydra"]["hydra_logging"]  # colorlog's formatter is named by "()"
    if key := names_code(plain):
        raise UserError(f"{key}: a config is data, and names no code to call")


def _check_logging(hydra: DictConfig, name: str) -> None:
    """Logging may only be one of Hydra's own choices: its configs name classes, factories and files."""
    node = hydra[name]
    plain = OmegaConf.to_container(node, resolve=False) if node is not None else {}
    # Python's `logging.config` calls what "()" and "class" name, opens what "filename" names, and looks up "ext://..."
    # among all modules. Hydra's own choices use some of that, so each entry is compared with what those hold.
    known = {"none", "default", "stdout", "disabled", "colorlog", None}
    if hydra.runtime.choices.get(f"hydra/{name}") not in known:
        raise UserError(f"hydra/{name}: expected one of none, default, stdout, disabled, colorlog")
    for place, key, value in entries(plain, f"hydra.{name}."):
        allowed = {
            "class": value in ("logging.StreamHandler", "logging.FileHandler", "logging.NullHandler"),
            "()": value == "colorlog.ColoredFormatter",
            # The name of the job is part of the file's name, and could lead out of the run's folder.
            "filename": value == _LOG_FILE and "/" not in str(hydra.job.name),
        }.get(key, not str(value).startswith(("ext://", "cfg://")) or value in ("ext://sys.stdout", "ext://sys.stderr"))
        if not allowed:
            raise UserError(f"{place}: a config names no code to call and no file to log to")


def _is_search_path(word: str) -> bool:
    # `++` forces an override in Hydra's grammar and `+` adds one: both are the same option.
    return word.lstrip("+").startswith("hydra.searchpath=")


def _search_path(word: str) -> list[str]:
    """The folders that `hydra.searchpath=[...]` names."""
    try:
        # Parsed as Hydra parses it, so that quotes and escapes within the list mean the same.
        value = parsed(word).value()
    except (UserError, OmegaConfBaseException):
        value = word
    paths = [] if value is None else value
    if not isinstance(paths, list) or not all(isinstance(path, str) for path in paths):
        raise UserError(f"{word}: expected hydra.searchpath=[FOLDER, ...]")
    paths = [path.removeprefix("file://") for path in paths]
    if scheme := next((path for path in paths if "://" in path), None):
        raise UserError(f"hydra.searchpath={scheme}: expected a folder; configs are not taken from a package")
    return paths


def _existing(option: str, folder: str) -> Path:
    with suppress(OSError):  # a name that is too long
        if (path := Path(folder).absolute()).is_dir():
            return path
    raise UserError(f"{option} {folder}: no such folder")
