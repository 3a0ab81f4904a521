"""Hydra's search path: `conf/`, folders of installed plugins, and the user's folders, with files read within limits."""

from __future__ import annotations

import io
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from hydra._internal.core_plugins.file_config_source import FileConfigSource
from hydra.core.config_search_path import ConfigSearchPath
from hydra.core.plugins import Plugins
from hydra.plugins.config_source import ConfigResult
from hydra.plugins.search_path_plugin import SearchPathPlugin
from omegaconf import OmegaConf

from trackmdp.untrusted import decoded, parse_yaml, read_text

_folders: list[tuple[str, str]] = []
"""(provider, path) of the folders that `_Folders` adds, while `searched` is open."""


@contextmanager
def searched(users: Sequence[Path], plugins: Sequence[Path]) -> Iterator[None]:
    """Hydra, initialised inside, also searches these folders, after the main one and in this order.

    Args:
        users: named on the command line.
        plugins: of installed packages.
    """
    # Hydra constructs both itself, without arguments: their data is in this module.
    for kind in (_UserFolder, _Folders):
        Plugins.instance().register(kind)
    # The scheme before `://` selects the class that reads a folder; "file" is Hydra's own.
    _folders[:] = [
        ("command-line", f"{_UserFolder.scheme()}://{path.absolute()}") for path in users
    ]
    _folders.extend(("plugin", f"file://{path.absolute()}") for path in plugins)
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


class _UserFolder(FileConfigSource):
    """A folder of the user's: Hydra reads a file once it is YAML of limited size and depth."""

    @staticmethod
    def scheme() -> str:
        return "data"

    def load_config(self, config_path: str) -> ConfigResult:
        """The config at `config_path`, such as ``experiment/mine``.

        Raises:
            UserError: it is no YAML of plain data.
        """
        file = Path(self.path) / self._normalize_file_name(config_path)
        text = read_text(file, links=True)
        parse_yaml(text, str(file))
        with decoded(str(file), "a config"):
            header = self._get_header_dict(text)
            source = f"{self.scheme()}://{self.path}"
            return ConfigResult(self.provider, source, OmegaConf.load(io.StringIO(text)), header)
