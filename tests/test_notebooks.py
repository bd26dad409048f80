"""Every notebook runs from top to bottom, and is stored in a form that can be compared."""

import pathlib
import re

import hurry
import nbclient
import nbformat
import pytest

NOTEBOOKS = sorted((pathlib.Path(__file__).parents[1] / "notebooks").glob("*.ipynb"))
NAMES = [
    "01_losses",
    "02_imagination",
    "03_value_alignment",
    "04_your_own_environment",
]
METADATA = {
    "kernelspec": {"display_name": "Python 3", "language": "python", "name": "python3"},
    "language_info": {"name": "python"},
}
CELL_SECONDS = 600
"""Of one cell: some train, and compile before. Generous, for machines with other work."""

every_notebook = pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)


def test_the_notebooks_are_there():
    assert [path.stem for path in NOTEBOOKS] == NAMES


@every_notebook
def test_a_notebook_is_stored_without_outputs(path):
    notebook = nbformat.read(path, as_version=4)
    nbformat.validate(notebook)
    assert notebook.metadata == METADATA
    for cell in notebook.cells:
        assert not cell.metadata
        assert not cell.get("outputs"), "clear the outputs"
        assert cell.get("execution_count") is None, "clear the outputs"


@every_notebook
def test_a_notebook_names_no_folder_of_a_machine(path):
    source = "\n".join(cell.source for cell in nbformat.read(path, as_version=4).cells)
    assert not re.search(r"""["'\s](/[a-z]|~/|[A-Z]:\\)""", source)


@every_notebook
def test_a_notebook_runs(path, monkeypatch):
    monkeypatch.setenv("XLA_FLAGS", hurry.USUAL)  # compiled as for a reader: it trains
    notebook = nbformat.read(path, as_version=4)
    client = nbclient.NotebookClient(
        notebook, timeout=CELL_SECONDS, resources={"metadata": {"path": str(path.parent)}}
    )
    client.execute()
