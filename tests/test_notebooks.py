"""Every notebook runs from top to bottom, is stored without outputs, and has them beside it."""

import base64
import importlib.util
import io
import json
import pathlib
import re

import hurry
import nbclient
import nbformat
import pytest
from PIL import Image

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

PICTURE = 100_000
"""Bytes of a stored picture, at most: the repository keeps every version."""


def load(path):
    spec = importlib.util.spec_from_file_location("run_notebooks", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


run = load(NOTEBOOKS[0].parent / "run.py")
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


def stored(path):
    return json.loads((run.OUTPUTS / path.stem / "outputs.json").read_text())


@every_notebook
def test_the_outputs_that_are_stored_are_those_of_the_code(path):
    cells = run.code_cells(nbformat.read(path, as_version=4))
    assert [output["code"] for output in stored(path)] == [
        run.fingerprint(cell.source) for cell in cells
    ], f"run again: python notebooks/run.py {path.stem}"
    pictures = {name for output in stored(path) for name in output["drawn"]}
    files = {file.name: file for file in (run.OUTPUTS / path.stem).iterdir()}
    assert files.keys() == pictures | {"outputs.json"}
    assert all(file.stat().st_size < PICTURE for file in files.values())


def test_outputs_are_stored_as_lines_and_small_pictures(tmp_path, monkeypatch):
    monkeypatch.setattr(run, "OUTPUTS", tmp_path)
    file = io.BytesIO()
    Image.new("RGBA", (40, 30), "red").save(file, "PNG")
    png = base64.b64encode(file.getvalue()).decode()
    cell = {
        "cell_type": "code",
        "source": "print(1)",
        "outputs": [
            {"output_type": "stream", "name": "stdout", "text": "1\n2\n"},
            {"output_type": "stream", "name": "stderr", "text": "a warning"},
            {"output_type": "execute_result", "data": {"text/plain": "<Axes at 0x7f>"}},
            {"output_type": "display_data", "data": {"image/png": png}},
        ],
    }
    run.store("toy", {"cells": [{"cell_type": "markdown", "source": "a"}, cell]})
    (output,) = json.loads((tmp_path / "toy" / "outputs.json").read_text())
    assert output["code"] == run.fingerprint("print(1)") != run.fingerprint("print(2)")
    assert output["printed"] == ["1", "2"]
    assert output["drawn"] == ["00-0.png"]
    picture = Image.open(tmp_path / "toy" / "00-0.png")
    assert (picture.mode, picture.size) == ("P", (40, 30))
    assert picture.convert("RGB").getpixel((5, 5)) == (255, 0, 0)


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
    executed = client.execute()
    for cell, output in zip(run.code_cells(executed), stored(path), strict=True):
        assert bool(run.printed(cell)) == bool(output["printed"]), cell.source
        assert len(run.drawn(cell)) == len(output["drawn"]), cell.source
