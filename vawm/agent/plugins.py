"""Modules outside of the package that register agents, imported where a program names them."""

from __future__ import annotations

import importlib
import importlib.util
import os
import pathlib
import sys

from vawm.errors import InvalidInput

VARIABLE = "VAWM_PLUGINS"
"""Environment variable: modules, or files that end in .py, separated by `os.pathsep`.

Processes that a program starts inherit it, so that sweeps work."""

_loaded: set[str] = set()


def add(names: list[str]) -> None:
    """Adds plugins for this process and those that it starts.

    Files are found from any working directory afterwards.

    Raises:
      InvalidInput: one cannot be imported, or has the separator in its path.
    """
    known = [name for name in os.environ.get(VARIABLE, "").split(os.pathsep) if name]
    absolute = [str(pathlib.Path(name).resolve()) if _is_file(name) else name for name in names]
    for name in absolute:
        if os.pathsep in name:
            remedy = f"has a {os.pathsep!r}, which separates plugins in {VARIABLE}"
            raise InvalidInput("plugin", name, f"{remedy}; copy the file to a path without it")
    os.environ[VARIABLE] = os.pathsep.join(dict.fromkeys([*known, *absolute]))
    load_named()


def load_named() -> None:
    """Imports what the environment variable names, each once.

    Raises:
      InvalidInput: one cannot be imported.
    """
    for name in os.environ.get(VARIABLE, "").split(os.pathsep):
        if name and name not in _loaded:
            _loaded.add(name)  # first: a plugin may ask for the names of agents itself
            try:
                _load(name)
            except BaseException:
                _loaded.discard(name)
                raise


def _is_file(name: str) -> bool:
    return name.endswith(".py")


def _load(name: str) -> None:
    path = pathlib.Path(name).resolve()
    if _is_file(name) and _is_imported(path):
        return  # such as the program itself, which registers what it has
    try:
        if _is_file(name):
            _load_file(path)
        else:
            importlib.import_module(name)
    except InvalidInput:
        raise
    except Exception as error:
        reason = f"{type(error).__name__}: {str(error).splitlines()[0] if str(error) else ''}"
        remedy = f"cannot be imported ({reason}); name a module, or a file that ends in .py"
        raise InvalidInput("plugin", name, remedy) from error


def _is_imported(path: pathlib.Path) -> bool:
    files = (getattr(module, "__file__", None) for module in list(sys.modules.values()))
    same = (file for file in files if file and pathlib.Path(file).name == path.name)
    return any(pathlib.Path(file).resolve() == path for file in same)


def _load_file(path: pathlib.Path) -> None:
    if not path.is_file():
        raise InvalidInput("plugin", str(path), "there is no such file; check the path")
    name = path.stem if path.stem not in sys.modules else f"{path.stem} of {path}"
    spec = importlib.util.spec_from_file_location(name, path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module  # where dataclasses look their types up
    try:
        spec.loader.exec_module(module)
    except BaseException:
        del sys.modules[name]
        raise
