"""Imports point downwards, and libraries with one importer keep it."""

import ast
import itertools
import pathlib

import pytest

PACKAGE = pathlib.Path(__file__).parents[1] / "vawm"

# From the ground up: a room may import those before it. Rooms are modules or folders.
FLOORS = [
    ["errors", "process", "config", "types", "losses"],
    ["nets", "envs"],
    ["world_model"],
    ["agent"],
    ["learning"],
    ["runs"],
    ["policy", "cli"],
    ["evaluate"],
    ["analysis"],
    ["export"],
    ["sweep"],
    ["__main__"],
]
SOLE_IMPORTERS = {
    "flax": "nets/",
    "distrax": "nets/distributions.py",
    "optax": "learning/",
    "orbax": "runs/checkpoint/",
}
"""Library -> the folder or file of the package that alone imports it."""


def rooms():
    for path in sorted(PACKAGE.rglob("*.py")):
        room = path.relative_to(PACKAGE).parts[0].removesuffix(".py")
        if room != "__init__":
            yield room, path


def imports(path):
    """Dotted names that a file imports, and `package.name` of each `from` import."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            above = (
                ["vawm", *path.relative_to(PACKAGE).parts[: -node.level]] if node.level else []
            )
            module = ".".join([*above, *([node.module] if node.module else [])])
            yield from (f"{module}.{alias.name}" for alias in node.names)


def ours(path):
    """Rooms of ours that a file imports."""
    return {name.split(".")[1] for name in imports(path) if name.startswith("vawm.")}


ROOMS = [room for floor in FLOORS for room in floor]


@pytest.mark.parametrize("room", ROOMS)
def test_imports_point_downwards(room):
    paths = [path for name, path in rooms() if name == room]
    assert paths, f"no room {room}"
    used = set().union(*(ours(path) for path in paths)) - {room}
    below = itertools.takewhile(lambda floor: room not in floor, FLOORS)
    assert used <= set(itertools.chain(*below))


def test_every_room_has_its_place():
    assert {room for room, _ in rooms()} == set(ROOMS)
    assert len(ROOMS) == len(set(ROOMS))


def test_the_front_hall_is_small():
    assert len([path for path in PACKAGE.iterdir() if path.name != "__pycache__"]) <= 20


@pytest.mark.parametrize("library", SOLE_IMPORTERS)
def test_libraries_with_one_importer_keep_it(library):
    importers = {
        path.relative_to(PACKAGE).as_posix()
        for _, path in rooms()
        if any(name.split(".")[0] == library for name in imports(path))
    }
    assert importers
    assert all(name.startswith(SOLE_IMPORTERS[library]) for name in importers)


def test_no_module_is_imported_under_an_alias_that_ends_in_lib():
    for folder in ("vawm", "tests", "experiments"):
        for path in (PACKAGE.parent / folder).rglob("*.py"):
            for node in ast.walk(ast.parse(path.read_text())):
                if isinstance(node, ast.Import | ast.ImportFrom):
                    assert not any(str(a.asname).endswith("_lib") for a in node.names), path
