"""A hook of mkdocs: a page of reference for every module of the package, and the notebooks.

No module is listed by hand: one whose room `ORDER` does not know comes last, under "More".
"""

from __future__ import annotations

import json
import pathlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from mkdocs.config.defaults import MkDocsConfig
    from mkdocs.structure.files import Files

ROOT = pathlib.Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "vawm"
NOTEBOOKS = ROOT / "notebooks"

ORDER = {
    "Losses": ("losses", "distributions"),
    "Data and choices": ("types", "config", "presets", "errors"),
    "World models and agents": ("world_model", "agent", "nets"),
    "Environments": ("envs",),
    "Learning": ("learning",),
    "Runs": ("runs", "process", "cli"),
    "Evaluation": ("policy", "evaluate", "export"),
    "Comparison": ("analysis", "sweep"),
}
"""Title -> rooms of the package, which are modules or folders, in the order of reading."""


def rooms() -> list[str]:
    """Every room of the package."""
    found = (path for path in PACKAGE.iterdir() if path.suffix == ".py" or path.is_dir())
    names = {path.name.removesuffix(".py") for path in found}
    return sorted(name for name in names if modules(name))


def modules(room: str) -> list[str]:
    """Dotted names of a room's modules that hold anything, the room itself first."""
    path = PACKAGE / room
    files = path.rglob("*.py") if path.is_dir() else [path.with_suffix(".py")]
    filled = (file for file in files if file.exists() and file.read_text().strip())
    names = (".".join(file.relative_to(ROOT).with_suffix("").parts) for file in filled)
    return sorted(name.removesuffix(".__init__") for name in names)


def pages() -> dict[str, str]:
    """Path of a page, relative to docs/ -> module."""
    names = (name for room in rooms() for name in modules(room))
    return {page(name): name for name in names}


def page(module: str) -> str:
    return f"reference/{module}.md"


def section(room: str) -> dict[str, Any]:
    """A room in the navigation: a page, or a folder of pages."""
    links = [{name.removeprefix("vawm."): page(name)} for name in modules(room)]
    return links[0] if len(links) == 1 else {room: links}


def navigation() -> list[Any]:
    """The reference, in the order of `ORDER`."""
    known = {room for group in ORDER.values() for room in group}
    here = [room for room in rooms() if room != "__init__"]
    order = ORDER | {"More": tuple(room for room in here if room not in known)}
    groups = [
        {title: [section(room) for room in group if room in here]}
        for title, group in order.items()
    ]
    return [{"vawm": page("vawm")}, *groups]


def list_notebooks() -> str:
    """The page that links to the notebooks, by their first lines."""
    lines = ["# Notebooks\n", "They run on a CPU; the extra `notebooks` has what they need.\n"]
    for path in sorted(NOTEBOOKS.glob("*.ipynb")):
        title = cells(path)[0][1].splitlines()[0].lstrip("# ")
        lines.append(f"- [{title}](notebooks/{path.stem}.md)")
    return "\n".join(lines)


def cells(path: pathlib.Path) -> list[tuple[str, str]]:
    """Kind and text of every cell of a notebook."""
    content = json.loads(path.read_text())["cells"]
    return [(cell["cell_type"], "".join(cell["source"])) for cell in content]


def notebook_page(path: pathlib.Path) -> str:
    """A notebook to read: its text and code. Plots come when it is run."""
    title, *rest = (
        text if kind == "markdown" else f"```python\n{text}\n```" for kind, text in cells(path)
    )
    download = f"[Download it]({path.name}) to run it; its plots are made then."
    return "\n\n".join([title, download, *rest]) + "\n"


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """Adds to the navigation what is not written by hand."""
    assert config.nav is not None
    config.nav += [{"Reference": navigation()}, {"Notebooks": "notebooks.md"}]
    return config


def on_files(files: Files, *, config: MkDocsConfig) -> Files:
    """Adds the pages, and the notebooks to read and to run."""
    from mkdocs.structure.files import File

    for path, module in pages().items():
        files.append(File.generated(config, path, content=f"::: {module}\n"))
    files.append(File.generated(config, "notebooks.md", content=list_notebooks()))
    for notebook in NOTEBOOKS.glob("*.ipynb"):
        path = f"notebooks/{notebook.stem}.md"
        files.append(File.generated(config, path, content=notebook_page(notebook)))
        path = f"notebooks/{notebook.name}"
        files.append(File.generated(config, path, abs_src_path=str(notebook)))
    return files
