"""Choosing a rendering backend, the messages if none works, and one backend per process.

Rendering happens in separate processes: a process that has loaded a backend cannot load
another, and processes that run other tests must not load one.
"""

import ctypes.util
import os
import subprocess
import sys

import pytest
from refusals import refused

from vawm.envs.host import rendering

needs_egl = pytest.mark.skipif(
    ctypes.util.find_library("EGL") is None, reason=f"needs {rendering.PACKAGES['egl']}"
)
needs_osmesa = pytest.mark.skipif(
    ctypes.util.find_library("OSMesa") is None, reason=f"needs {rendering.PACKAGES['osmesa']}"
)


@pytest.fixture(autouse=True)
def clear_the_cache():
    """Makes every test try the backends again, and tests after this module too."""
    rendering.fault.cache_clear()
    yield
    rendering.fault.cache_clear()


@pytest.fixture
def without_egl(monkeypatch):
    """EGL finds no driver, as if libgl1-mesa-dri were not installed."""
    monkeypatch.setenv("__EGL_VENDOR_LIBRARY_DIRS", "/nonexistent")
    monkeypatch.setenv("__EGL_VENDOR_LIBRARY_FILENAMES", "/nonexistent")


@pytest.fixture
def without_osmesa(monkeypatch, tmp_path):
    """OSMesa's library cannot be loaded, as if libosmesa6 were not installed."""
    for name in ("libOSMesa.so", "libOSMesa.so.6", "libOSMesa.so.8"):
        (tmp_path / name).touch()
    monkeypatch.setenv("LD_LIBRARY_PATH", str(tmp_path))


def in_a_process(script: str, **variables: str) -> str:
    """The output of a script in a new process."""
    done = subprocess.run(
        [sys.executable, "-c", script],
        env=os.environ | variables,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


@needs_egl
def test_auto_takes_egl_if_it_works():
    assert rendering.choose("auto") == "egl"


@needs_osmesa
def test_auto_falls_back_on_osmesa_with_a_warning(without_egl):
    with pytest.warns(UserWarning, match=r"egl .*osmesa"):
        assert rendering.choose("auto") == "osmesa"


@needs_osmesa
def test_osmesa_is_taken_if_it_is_asked_for():
    assert rendering.choose("osmesa") == "osmesa"


def test_egl_that_does_not_work_names_its_packages(without_egl):
    packages = "apt-get install libegl1 libgl1-mesa-dri libopengl0"
    with refused("env.renderer", "egl", naming=["Error: ", packages]):
        rendering.choose("egl")


def test_osmesa_that_does_not_work_names_its_package(without_osmesa):
    with refused("env.renderer", "osmesa", naming=["Error: ", "apt-get install libosmesa6"]):
        rendering.choose("osmesa")


def test_auto_names_the_packages_of_both_if_neither_works(without_egl, without_osmesa):
    packages = "libegl1 libgl1-mesa-dri libopengl0, or apt-get install libosmesa6"
    with refused("env.renderer", "auto", naming=["egl ", "osmesa ", packages]):
        rendering.choose("auto")


def test_an_unknown_renderer_is_refused_and_not_tried(monkeypatch):
    monkeypatch.setattr(subprocess, "run", lambda *_, **__: pytest.fail("tried"))
    with refused("env.renderer", "glfw", naming=["auto", "egl", "osmesa"]):
        rendering.choose("glfw")


def test_a_backend_that_hangs_does_not_work(monkeypatch):
    monkeypatch.setattr(rendering, "PROBE", "import time; time.sleep(60)")
    monkeypatch.setattr(rendering, "PROBE_SECONDS", 0.2)
    assert "0.2 s" in rendering.fault("egl")


def test_a_backend_that_crashes_without_output_does_not_work(monkeypatch):
    monkeypatch.setattr(rendering, "PROBE", "import os; os.abort()")
    assert "-6" in rendering.fault("egl")


def test_a_long_reason_is_cut(monkeypatch):
    monkeypatch.setattr(rendering, "PROBE", "raise OSError('a library said ' * 99)")
    reason = rendering.fault("egl")
    assert reason.startswith("OSError: a library said a library said")
    assert len(reason) <= rendering.LONGEST


def test_a_backend_is_tried_once_per_process(monkeypatch):
    monkeypatch.setattr(rendering, "PROBE", "")
    assert rendering.choose("auto") == "egl"
    monkeypatch.setattr(subprocess, "run", lambda *_, **__: pytest.fail("tried again"))
    assert rendering.choose("egl") == "egl"


def test_trying_a_backend_does_not_change_this_process():
    before = dict(os.environ), set(sys.modules)
    rendering.fault("egl")
    assert (dict(os.environ), set(sys.modules)) == before


@needs_egl
def test_use_overrides_the_environment_variables():
    script = """
from vawm.envs.host import rendering
rendering.use("egl")
from dm_control import _render, mujoco
model = "<mujoco><worldbody><geom size='1'/></worldbody></mujoco>"
assert mujoco.Physics.from_xml_string(model).render(8, 8).any()
rendering.use("egl")  # again, with dm_control loaded
print(_render.BACKEND)
"""
    said = in_a_process(script, MUJOCO_GL="disable", PYOPENGL_PLATFORM="osmesa")
    assert said == "egl"


REFUSED = """
from vawm.envs.host import rendering
try:
    rendering.use("osmesa")
except Exception as error:
    print(f"{type(error).__name__}: {error}")
"""


def test_a_process_that_loaded_dm_control_for_physics_is_refused():
    said = in_a_process(f"from dm_control import mujoco\n{REFUSED}", MUJOCO_GL="disable")
    assert "env.renderer='osmesa'" in said
    assert "'off'" in said


@needs_egl
def test_a_process_that_loaded_mujoco_with_another_backend_is_refused():
    said = in_a_process(f"import mujoco\n{REFUSED}", MUJOCO_GL="egl", PYOPENGL_PLATFORM="egl")
    assert "env.renderer='osmesa'" in said
    assert "'egl'" in said
