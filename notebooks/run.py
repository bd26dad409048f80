"""Run the notebooks, and store what they print and draw under notebooks/outputs/.

    python notebooks/run.py                # all of them
    python notebooks/run.py 01_losses

Notebooks are stored without outputs, so a change of one is a change of its text. The site shows
the outputs that this program stored; run it again after you changed the code of a notebook.
Needs the extra `notebooks`.
"""

from __future__ import annotations

import base64
import hashlib
import io
import json
import pathlib
import shutil
import sys
from collections.abc import Sequence
from typing import Any

FOLDER = pathlib.Path(__file__).resolve().parent
OUTPUTS = FOLDER / "outputs"
COLORS = 128
"""Of a stored picture: plots need few, and the repository keeps every version."""


def fingerprint(source: str) -> str:
    """Tells the code of one cell from another's."""
    return hashlib.sha256(source.encode()).hexdigest()[:16]


def code_cells(notebook: Any) -> list[Any]:
    return [cell for cell in notebook["cells"] if cell["cell_type"] == "code"]


def printed(cell: Any) -> str:
    """What a cell wrote to standard output."""
    streams = [out for out in cell["outputs"] if out["output_type"] == "stream"]
    return "".join("".join(out["text"]) for out in streams if out["name"] == "stdout")


def drawn(cell: Any) -> list[bytes]:
    """The pictures that a cell showed, as PNG."""
    shown = [out["data"] for out in cell["outputs"] if "data" in out]
    return [base64.b64decode(data["image/png"]) for data in shown if "image/png" in data]


def execute(path: pathlib.Path) -> Any:
    """The notebook with the outputs of its cells."""
    import nbclient
    import nbformat

    notebook = nbformat.read(path, as_version=4)
    client = nbclient.NotebookClient(
        notebook, timeout=600, resources={"metadata": {"path": str(path.parent)}}
    )
    return client.execute()


def small(png: bytes) -> bytes:
    """The same picture with a palette."""
    from PIL import Image

    picture = Image.open(io.BytesIO(png)).convert("RGB").quantize(COLORS)
    file = io.BytesIO()
    picture.save(file, "PNG", optimize=True)
    return file.getvalue()


def store(name: str, notebook: Any) -> None:
    """Replaces what is stored of the notebook `name`."""
    folder = OUTPUTS / name
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    cells = []
    for number, cell in enumerate(code_cells(notebook)):
        pictures = []
        for png in drawn(cell):
            pictures.append(f"{number:02}-{len(pictures)}.png")
            (folder / pictures[-1]).write_bytes(small(png))
        lines = printed(cell).splitlines()
        cells.append({"code": fingerprint(cell["source"]), "printed": lines, "drawn": pictures})
    (folder / "outputs.json").write_text(json.dumps(cells, indent=1, ensure_ascii=False) + "\n")


def main(argv: Sequence[str]) -> None:
    for path in sorted(FOLDER.glob("*.ipynb")):
        if not argv or path.stem in argv:
            print(path.name, flush=True)
            store(path.stem, execute(path))


if __name__ == "__main__":
    main(sys.argv[1:])
