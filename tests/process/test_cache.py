"""The folder of the compilation cache."""

import os
import pathlib

import jax
import pytest

from vawm.process import cache


@pytest.fixture(autouse=True)
def restore_jax_settings():
    names = (
        "jax_compilation_cache_dir",
        "jax_enable_compilation_cache",
        "jax_persistent_cache_min_compile_time_secs",
    )
    before = {name: getattr(jax.config, name) for name in names}
    yield
    for name, value in before.items():
        jax.config.update(name, value)


def test_the_folder_of_the_environment_comes_first(tmp_path, monkeypatch):
    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", str(tmp_path / "mine"))
    assert cache.enable() == tmp_path / "mine"
    assert jax.config.jax_compilation_cache_dir == str(tmp_path / "mine")


def test_the_user_cache_is_the_default(tmp_path, monkeypatch):
    monkeypatch.delenv("JAX_COMPILATION_CACHE_DIR", raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert cache.enable() == tmp_path / "vawm" / "jax"
    monkeypatch.delenv("XDG_CACHE_HOME")
    assert cache.folder() == pathlib.Path("~/.cache/vawm/jax").expanduser()


def test_it_can_be_switched_off(monkeypatch):
    monkeypatch.setenv("VAWM_NO_CACHE", "1")
    assert cache.enable() is None
    assert not jax.config.jax_enable_compilation_cache


@pytest.mark.parametrize("name", ["file/below", os.fsdecode(b"\xff")])
def test_a_folder_that_cannot_be_used_is_a_warning(tmp_path, monkeypatch, capsys, name):
    (tmp_path / "file").touch()
    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", str(tmp_path / name))
    assert cache.enable() is None
    assert jax.config.jax_compilation_cache_dir is None
    warning = capsys.readouterr().err
    assert warning.startswith("warning: no compilation cache")
    assert warning.count("\n") == 1
