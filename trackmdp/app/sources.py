"""Hydra's search path: `conf/`, folders of installed plugins, and the user's folders, whose files are read as data."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from hydra.core.config_search_path import ConfigSearchPath
from hydra.core.object_type import ObjectType
from hydra.core.plugins import Plugins
from hydra.plugins.config_source import ConfigLoadError, ConfigResult, ConfigSource
from hydra.plugins.search_path_plugin import SearchPathPlugin
from omegaconf import DictConfig, OmegaConf

from trackmdp.config.tree import at_key
from trackmdp.config.untrusted import MAX_BYTES, parse_yaml
from trackmdp.errors import UserError
from trackmdp.untrusted import read_text

_FORBIDDEN = {
    "hydra.callbacks": "a config does not name code to call",
    "hydra.searchpath": "further folders are named on the command line",
    "hydra.job.env_set": "the environment is set in the shell",
}
"""Keys that a file of the user's may not set, and why: each reaches code outside the config."""

_folders: list[tuple[str, str]] = []
"""(provider, path) of the folders that `_Folders` adds, while `searched` is open."""


@contextmanager
def searched(users: Sequence[Path], plugins: Sequence[Path]) -> Iterator[None]:
    """Hydra, initialised inside, also searches these folders, after the main one and in this order.

    Args:
        users: named on the command line; their files are read by `_UserFolder`.
        plugins: of installed packages.
    """
    # Hydra makes both itself, without arguments, when it is initialised: they learn what to do from this module's
    # state.
    for kind in (_UserFolder, _Folders):
        Plugins.instance().register(kind)  # what is registered already stays
    # Hydra picks the class that reads a folder by the scheme before `://`; "data" is ours, "file" is Hydra's own.
    _folders[:] = [("command-line", f"{_UserFolder.scheme()}://{folder.absolute()}") for folder in users]
    # An installed package has run its code already: its files are read as those of `conf/` are.
    _folders.extend(("plugin", f"file://{folder.absolute()}") for folder in plugins)
    try:
        yield
    finally:
        _folders.clear()


class _Folders(SearchPathPlugin):
    """Hydra asks every such plugin for changes to its search path."""

    def manipulate_search_path(self, search_path: ConfigSearchPath) -> None:
        for provider, path in _folders:
            # After `conf/`: where both have a file of one name, Hydra takes the first.
            search_path.append(provider, path)


class _UserFolder(ConfigSource):
    """A folder of the user's: only plain YAML files in it are read, of bounded size, and none names code."""

    @staticmethod
    def scheme() -> str:
        return "data"

    def load_config(self, config_path: str) -> ConfigResult:
        """The config at `config_path`, such as ``experiment/mine``.

        Raises:
            ConfigLoadError: there is no such file; Hydra then looks elsewhere.
            UserError: it is not plain data.
        """
        file = self._file(config_path)
        if not file.is_file():
            raise ConfigLoadError(f"Config not found : {file}")
        # The user named this folder, so links in it are the user's; a pipe or a device would block for ever, and is
        # refused.
        text = read_text(file, most=MAX_BYTES, links=True)
        config = parse_yaml(text, str(file))
        try:
            # Lines such as `# @package _global_`; Hydra's own reader looks for them in the first 512 characters as
            # well.
            header = self._get_header_dict(text[:512])
        except ValueError as error:
            raise UserError(f"{file}: not a config ({error})") from error
        _refuse_settings(config, header.get("package") or "", file)
        return ConfigResult(config=config, path=self.full_path(), provider=self.provider, header=header)

    def available(self) -> bool:
        return self.is_group("")

    def is_group(self, config_path: str) -> bool:
        return (Path(self.path) / config_path).is_dir()

    def is_config(self, config_path: str) -> bool:
        return self._file(config_path).is_file()

    def list(self, config_path: str, results_filter: ObjectType | None) -> list[str]:
        names: list[str] = []
        for entry in (Path(self.path) / config_path).iterdir():
            self._list_add_result(names, str(Path(config_path) / entry.name), entry.name, results_filter)
        return sorted(set(names))

    def _file(self, config_path: str) -> Path:
        return Path(self.path) / self._normalize_file_name(config_path)


def _refuse_settings(config: DictConfig, package: str, file: Path) -> None:
    """Refuse a file that sets a key of `_FORBIDDEN`, taking its `# @package` header into account."""
    # A file with `# @package hydra.job` that says `env_set: {...}` sets hydra.job.env_set without ever naming it.
    prefix = [] if package in ("", "_global_") else package.split(".")
    plain = OmegaConf.to_container(config, resolve=False)
    for name in reversed(prefix):
        plain = {name: plain}
    for key, why in _FORBIDDEN.items():
        if at_key(plain, key):
            raise UserError(f"{file}: sets {key}, which is not taken from a file ({why})")
