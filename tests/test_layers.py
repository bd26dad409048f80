"""Imports point downwards, and libraries with one importer keep it."""

import ast
import pathlib

import pytest

PACKAGE = pathlib.Path(__file__).parents[1] / "vawm"

# What each room may import of ours, besides itself. Rooms are modules or folders.
LAYERS = {
    "errors": set(),
    "config": set(),
    "presets": {"config"},
    "huge_pages": set(),
    "cache": set(),
    "types": set(),
    "transforms": set(),
    "signals": set(),
    "streams": set(),
    "losses": {"returns", "transforms"},
    "returns": set(),
    "distributions": {"transforms"},
    "optim": {"config"},
    "nets": {"types"},
    "replay": {"types"},
    "image_store": {"replay", "types"},
    "scores": {"errors"},
    "envs": {"errors", "streams", "types"},
    "world_model": {"config", "distributions", "errors", "nets", "transforms", "types"},
    "actor_critic": {"config", "distributions", "errors", "nets", "transforms", "types"},
    "imagination": {"distributions", "types", "world_model"},
    "agent": {"actor_critic", "config", "types", "world_model"},
    "value_gradient": {"agent", "config", "distributions", "losses", "transforms", "types"},
    "objective": {
        "agent",
        "config",
        "imagination",
        "losses",
        "returns",
        "transforms",
        "types",
        "value_gradient",
    },
    "open_loop": {"agent", "types"},
    "collector": {"agent", "config", "envs", "replay", "types"},
    "learner": {
        "agent",
        "config",
        "objective",
        "optim",
        "replay",
        "returns",
        "types",
    },
    "learn": {"agent", "config", "image_store", "learner", "replay", "types"},
    "train": {
        "agent",
        "collector",
        "config",
        "envs",
        "learn",
        "learner",
        "replay",
        "types",
    },
    "host_train": {
        "agent",
        "collector",
        "config",
        "envs",
        "image_store",
        "learn",
        "learner",
        "replay",
        "train",
        "types",
    },
}
HOST = {
    "analysis",
    "backends",
    "checkpoint",
    "command_line",
    "diagnosis",
    "display",
    "evaluate",
    "export",
    "flags",
    "manifest",
    "memory",
    "overhead",
    "play",
    "policy",
    "program",
    "resume",
    "rundir",
    "runner",
    "suites",
    "sweep",
    "tracking",
    "validate",
    "video",
    "weights",
}
SOLE_IMPORTERS = {"flax": {"nets"}, "distrax": {"distributions"}, "optax": {"learner", "optim"}}


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
            assert node.level == 0, f"{path}: relative import"
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def ours(path):
    """Rooms of ours that a file imports."""
    return {name.split(".")[1] for name in imports(path) if name.startswith("vawm.")}


@pytest.mark.parametrize("room", sorted(LAYERS))
def test_imports_point_downwards(room):
    paths = [path for name, path in rooms() if name == room]
    assert paths, f"no room {room}"
    used = set().union(*(ours(path) for path in paths)) - {room}
    assert used <= LAYERS[room]


def test_every_room_has_its_place():
    assert {room for room, _ in rooms()} == set(LAYERS) | HOST


def test_nothing_that_computes_imports_the_host_side():
    for room, path in rooms():
        if room not in HOST:
            assert not ours(path) & HOST, path


@pytest.mark.parametrize("library", SOLE_IMPORTERS)
def test_libraries_with_one_importer_keep_it(library):
    importers = {
        room
        for room, path in rooms()
        if any(name.split(".")[0] == library for name in imports(path))
    }
    assert importers == SOLE_IMPORTERS[library]
