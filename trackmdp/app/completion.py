"""Completion of `trackmdp COMMAND option=value` in bash: ``eval "$(trackmdp train -sc install=bash)"``.

Hydra's own script asks the program for the choices of its first word, and so `trackmdp` for those of no command.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from hydra._internal.hydra import Hydra
from omegaconf import OmegaConf

_SCRIPT = """\
_trackmdp() {
    local word=${COMP_WORDS[COMP_CWORD]} command=${COMP_WORDS[1]} choice
    if (( COMP_CWORD == 1 )); then
        mapfile -t COMPREPLY < <(compgen -S ' ' -W '%(commands)s' -- "$word")
        return
    fi
    # The program reads a line without the command; choices that begin with base_ are parts of others, and given
    # stands for a problem made in Python.
    COMPREPLY=()
    while read -r choice; do
        # Not compgen -W: it would run $(...) in the name of a file.
        [[ $choice != "$word"* ]] || COMPREPLY+=("$(printf %%q "$choice")")
    done < <(COMP_LINE="${COMP_WORDS[0]} ${COMP_LINE#*" $command"}" \\
        "${COMP_WORDS[0]}" "$command" -sc query=bash 2>/dev/null | tr ' ' '\\n' | grep -v -e '=base_' -e '=given$')
}
COMP_WORDBREAKS=${COMP_WORDBREAKS//=}
complete -o nospace -o default -F _trackmdp trackmdp
"""


def bash(commands: Iterable[str]) -> str:
    """The script that bash evaluates; `commands` are the words that may follow `trackmdp`."""
    return _SCRIPT % {"commands": " ".join(commands)}


def complete_line(hydra: Hydra, command: str) -> None:
    """Print how the line in COMP_LINE may go on; `command` is its config."""
    composed = hydra.config_loader.load_configuration

    def untyped(*given: Any, **named: Any) -> Any:
        # Hydra takes an option whose type is a list for a group of options, and ends it with a dot.
        return OmegaConf.create(OmegaConf.to_container(composed(*given, **named)))

    hydra.config_loader.load_configuration = untyped  # type: ignore[method-assign]
    hydra.shell_completion(command, ["query=bash"])
