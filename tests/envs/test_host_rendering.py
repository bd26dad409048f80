"""Which backend renders, what is said where none does, and that a process keeps to one.

Whatever renders does so in a process of its own: one that has loaded a backend cannot load
another, and those that run other tests are to have none.
"""

import ctypes.util
import os
import subprocess
import sys

import pytest

from vawm.envs.host import rendering
from vawm.errors import InvalidInput

needs_egl = pytest.mark.skipif(
    ctypes.util.find_library("EGL") is None, reason=f"needs {rendering.PACKAGES['egl']}"
)
needs_osmesa = pytest.mark.skipif(
    ctypes.util.find_library("OSMesa") is None, reason=f"needs {rendering.PACKAGES['osmesa']}"
)


@pytest.fixture(autouse=True)
def nothing_remembered():
    """Lets every test try the backends anew, and those after this module too."""
    rendering.fault.cache_clear()
    yield
    rendering.fault.cache_clear()


@pytest.fixture
def without_egl(monkeypatch):
    """No driver for EGL to find, as where libgl1-mesa-dri is not installed."""
    monkeypatch.setenv("__EGL_VENDOR_LIBRARY_DIRS", "/nonexistent")
    monkeypatch.setenv("__EGL_VENDOR_LIBRARY_FILENAMES", "/nonexistent")


@pytest.fixture
def without_osmesa(monkeypatch, tmp_path):
    """OSMesa's library cannot be loaded, as where libosmesa6 is not installed."""
    for name in ("libOSMesa.so", "libOSMesa.so.6", "libOSMesa.so.8"):
        (tmp_path / name).touch()
    monkeypatch.setenv("LD_LIBRARY_PATH", str(tmp_path))


def in_a_process(script: str, **variables: str) -> str:
    """What a script prints in a process that has loaded nothing yet."""
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
def test_auto_takes_egl_where_it_works():
    assert rendering.choose("auto") == "egl"


@needs_osmesa
def test_auto_falls_back_on_osmesa_and_says_so(without_egl):
    with pytest.warns(UserWarning, match="egl does not render here .*: osmesa does, its pix"):
        assert rendering.choose("auto") == "osmesa"


@needs_osmesa
def test_osmesa_is_taken_where_it_is_asked_for():
    assert rendering.choose("osmesa") == "osmesa"


def test_egl_that_does_not_work_names_its_packages(without_egl):
    with pytest.raises(InvalidInput) as refusal:
        rendering.choose("egl")
    message = str(refusal.value)
    assert message.startswith("env.renderer='egl': egl does not render here (")
    assert message.endswith("; apt-get install libegl1 libgl1-mesa-dri libopengl0")
    assert "Error: " in message  # what the library said
    assert "\n" not in message


def test_osmesa_that_does_not_work_names_its_package(without_osmesa):
    with pytest.raises(InvalidInput) as refusal:
        rendering.choose("osmesa")
    message = str(refusal.value)
    assert message.startswith("env.renderer='osmesa': osmesa does not render here (")
    assert message.endswith("; apt-get install libosmesa6")
    assert "Error: " in message
    assert "\n" not in message


def test_auto_names_the_packages_of_both_where_neither_works(without_egl, without_osmesa):
    with pytest.raises(InvalidInput) as refusal:
        rendering.choose("auto")
    message = str(refusal.value)
    assert message.startswith("env.renderer='auto': egl does not render here (")
    assert ", osmesa does not render here (" in message
    assert "libegl1 libgl1-mesa-dri libopengl0, or apt-get install libosmesa6" in message
    assert "\n" not in message


def test_an_unknown_renderer_is_refused_and_not_tried(monkeypatch):
    monkeypatch.setattr(subprocess, "run", lambda *_, **__: pytest.fail("tried"))
    with pytest.raises(InvalidInput, match=r"env\.renderer='glfw': use auto, egl or osmesa"):
        rendering.choose("glfw")


def test_a_backend_that_hangs_does_not_work(monkeypatch):
    monkeypatch.setattr(rendering, "PROBE", "import time; time.sleep(60)")
    monkeypatch.setattr(rendering, "PROBE_SECONDS", 0.2)
    assert rendering.fault("egl") == "no frame within 0.2 s"


def test_a_backend_that_crashes_without_a_word_does_not_work(monkeypatch):
    monkeypatch.setattr(rendering, "PROBE", "import os; os.abort()")
    assert rendering.fault("egl") == "exit code -6"


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


def test_trying_a_backend_leaves_this_process_alone():
    before = dict(os.environ), set(sys.modules)
    rendering.fault("egl")
    assert (dict(os.environ), set(sys.modules)) == before


@needs_egl
def test_a_process_renders_with_what_it_uses_whatever_the_environment_said():
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
    assert "this process has loaded 'off' already" in said


@needs_egl
def test_a_process_that_loaded_mujoco_with_another_backend_is_refused():
    said = in_a_process(f"import mujoco\n{REFUSED}", MUJOCO_GL="egl", PYOPENGL_PLATFORM="egl")
    assert "this process has loaded 'egl' already" in said
