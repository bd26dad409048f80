"""A hook of mkdocs: pages of reference for all modules, the notebooks, and files of results.

No module is listed by hand: one whose room `ORDER` does not know comes last, under "More".
Pages link to files of results where the repository has them; the site has copies.
"""

from __future__ import annotations

import json
import pathlib
import posixpath
import re
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from mkdocs.config.defaults import MkDocsConfig
    from mkdocs.structure.files import Files
    from mkdocs.structure.pages import Page

ROOT = pathlib.Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "vawm"
NOTEBOOKS = ROOT / "notebooks"
OUTPUTS = NOTEBOOKS / "outputs"
RESULTS = ROOT / "experiments" / "results"

ORDER = {
    "Losses": ("losses",),
    "Data and choices": ("types", "config", "errors"),
    "World models and agents": ("world_model", "agent", "nets"),
    "Environments": ("envs",),
    "Learning": ("learning",),
    "Runs": ("runs", "process", "cli", "__main__"),
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


def notebooks() -> list[pathlib.Path]:
    return sorted(NOTEBOOKS.glob("*.ipynb"))


def title(notebook: pathlib.Path) -> str:
    return cells(notebook)[0][1].splitlines()[0].lstrip("# ")


def notebook_links() -> list[dict[str, str]]:
    """The notebooks in the navigation."""
    pages = [{title(path): f"notebooks/{path.stem}.md"} for path in notebooks()]
    return [{"All notebooks": "notebooks.md"}, *pages]


def list_notebooks() -> str:
    """The page that links to the notebooks."""
    lines = [
        "# Notebooks\n",
        "They run on a CPU; the extra `notebooks` has what they need. Alone on two cores, with "
        "nothing compiled before, they take 11, 63, 87 and 57 seconds. The outputs shown here "
        "were stored by `python notebooks/run.py`.\n",
    ]
    lines += [f"- [{title(path)}](notebooks/{path.stem}.md)" for path in notebooks()]
    return "\n".join(lines) + "\n"


def cells(path: pathlib.Path) -> list[tuple[str, str]]:
    """Kind and text of every cell of a notebook."""
    content = json.loads(path.read_text())["cells"]
    return [(cell["cell_type"], "".join(cell["source"])) for cell in content]


def outputs(path: pathlib.Path) -> list[dict[str, Any]]:
    """What every cell with code printed and drew: see `notebooks/run.py`."""
    return json.loads((OUTPUTS / path.stem / "outputs.json").read_text())


def notebook_page(path: pathlib.Path) -> str:
    """A notebook to read: its text, its code, and the outputs that are stored."""
    (_, first), *rest = cells(path)
    stored, heading = iter(outputs(path)), title(path)
    parts = [first, f"[Download it]({path.name}) to run it."]
    for kind, text in rest:
        if kind == "markdown":
            headings = re.findall(r"^#+ (.*)$", text, re.MULTILINE)
            heading = headings[-1] if headings else heading
            parts.append(text)
            continue
        parts.append(f"```python\n{text}\n```")
        output = next(stored)
        if output["printed"]:
            parts.append("\n".join(["```text", *output["printed"], "```"]))
        pictures = [f"{path.stem}/{name}" for name in output["drawn"]]
        parts += [f"[![{heading}]({picture})]({picture})" for picture in pictures]
    return "\n\n".join(parts) + "\n"


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """Adds to the navigation what is not written by hand."""
    assert config.nav is not None
    config.nav += [{"Reference": navigation()}, {"Notebooks": notebook_links()}]
    return config


def on_files(files: Files, *, config: MkDocsConfig) -> Files:
    """Adds the pages, the notebooks to read and to run, and the files of results."""
    from mkdocs.structure.files import File, InclusionLevel

    def add(path: str, **source: Any) -> None:
        files.append(File.generated(config, path, **source))

    for path, module in pages().items():
        add(path, content=f"::: {module}\n")
    add("notebooks.md", content=list_notebooks())
    for notebook in notebooks():
        add(f"notebooks/{notebook.stem}.md", content=notebook_page(notebook))
        add(f"notebooks/{notebook.name}", abs_src_path=str(notebook))
        for picture in (OUTPUTS / notebook.stem).glob("*.png"):
            path = f"notebooks/{notebook.stem}/{picture.name}"
            add(path, abs_src_path=str(picture))
    for result in filter(pathlib.Path.is_file, RESULTS.rglob("*")):
        path = f"results/files/{result.relative_to(RESULTS).as_posix()}"
        level = InclusionLevel.NOT_IN_NAV
        add(path, abs_src_path=str(result), inclusion=level)
    return files


def on_page_markdown(markdown: str, *, page: Page, **_: Any) -> str:
    """Lets links to files of results lead to their copies."""
    here = posixpath.dirname(page.file.src_uri)
    copies = posixpath.relpath("results/files", here or ".")
    return re.sub(r"\]\((?:\.\./)+experiments/results/", f"]({copies}/", markdown)


def on_page_content(html: str, **_: Any) -> str:
    """Lets a long name of code in a table break after its dots, underscores and signs."""

    def breakable(cell: re.Match[str]) -> str:
        return re.sub(r"<code>([^<]*)</code>", word, cell[0])

    def word(code: re.Match[str]) -> str:
        return "<code>" + re.sub(r"([._=/])(?=[^\s._=/])", r"\1<wbr>", code[1]) + "</code>"

    return re.sub(r"<td[^>]*>.*?</td>", breakable, html, flags=re.DOTALL)
