"""The example programs: in the wheel in `_examples` beside this file, in a clone in `scripts/examples`."""

from __future__ import annotations

from pathlib import Path

from trackmdp.errors import UserError

_ROOT = Path(__file__).parent
_FOLDERS = (
    _ROOT / "_examples",
    _ROOT.parent / "scripts" / "examples",
    _ROOT.parent / "tests" / "data",
)
_ENDINGS = (".py", ".ipynb", ".csv")


def examples() -> dict[str, Path]:
    """Name, such as ``own_tracks`` or ``city.csv`` -> file."""
    found = {}
    for file in (each for folder in _FOLDERS for each in sorted(folder.glob("*"))):
        if file.suffix in _ENDINGS:
            found[file.stem if file.suffix == ".py" else file.name] = file
    return found


def example_file(name: str) -> Path:
    """The file of an example.

    Raises:
        UserError: there is none of that name.
    """
    known = examples()
    if name not in known:
        raise UserError(f"example {name}: expected one of {', '.join(known)}")
    return known[name]
