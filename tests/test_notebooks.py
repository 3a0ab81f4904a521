"""The notebooks run from the first cell to the last, and show what is stored in them, but for digits."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import pytest

from tests.notebooks import FOLDER, executed

NOTEBOOKS = sorted(file.name for file in FOLDER.glob("*.ipynb"))


def shown(outputs: list[dict[str, Any]]) -> list[str]:
    """Kind of each output, with its text; a sign and digits may differ between machines."""
    found = []
    for each in outputs:
        data = each.get("data", {})
        text = "".join(each.get("text", data.get("text/plain", [])))
        kinds = " ".join(sorted(data))
        found.append(f"{each['output_type']} {kinds} {re.sub(r'[-–]?[0-9.,]+|nan|NaN', '#', text)}")
    return [re.sub(r"\s+", " ", each) for each in found]


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::DeprecationWarning")
@pytest.mark.parametrize("name", NOTEBOOKS)
def test_a_notebook_shows_what_its_cells_give(name: str, empty_folder: Path) -> None:
    pytest.importorskip("matplotlib").use("agg")
    pytest.importorskip("pyproj")
    notebook = json.loads((FOLDER / name).read_text("utf-8"))
    cells = [cell for cell in notebook["cells"] if cell["cell_type"] == "code"]
    assert [cell["execution_count"] for cell in cells] == list(range(1, len(cells) + 1))
    for cell, outputs in zip(cells, executed(notebook), strict=True):
        assert shown(outputs) == shown(cell["outputs"]), "".join(cell["source"])


def test_there_are_two() -> None:
    assert len(NOTEBOOKS) >= 2
