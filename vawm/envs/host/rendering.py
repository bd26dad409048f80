"""Rendering without a display: which OpenGL backend works here, and how a process takes one.

EGL draws on a GPU, or on the CPU by Mesa; OSMesa always on the CPU. dm_control and PyOpenGL
read their backend from the environment when they are imported, and an import that fails
leaves PyOpenGL unusable. So a backend is tried in a process of its own, and a process that
renders takes one before it imports dm_control. What MUJOCO_GL said before does not count;
which GPU EGL uses is for MUJOCO_EGL_DEVICE_ID to say.
"""

from __future__ import annotations

import functools
import os
import subprocess
import sys
import textwrap
import warnings
from typing import Literal

from vawm.errors import InvalidInput

Backend = Literal["egl", "osmesa"]

BACKENDS: tuple[Backend, ...] = ("egl", "osmesa")
"""In the order in which "auto" tries them."""
PACKAGES = {
    "egl": "libegl1 libgl1-mesa-dri libopengl0",
    "osmesa": "libosmesa6",
}
"""What a backend needs of the system, as Debian and Ubuntu call it. For a GPU of NVIDIA its
driver takes the place of libgl1-mesa-dri."""

PROBE = """
from dm_control import mujoco

model = "<mujoco><worldbody><geom size='1'/></worldbody></mujoco>"
assert mujoco.Physics.from_xml_string(model).render(8, 8).any(), "the frame is black"
"""
PROBE_SECONDS = 45
LONGEST = 160  # characters of the reason why a backend does not work


def choose(renderer: str) -> Backend:
    """The backend to render with: `renderer`, or the first that works where it is "auto".

    Trying one takes about a second, once per process.

    Raises:
      InvalidInput: it does not work here; why, and which packages it needs.
    """
    candidates = [backend for backend in BACKENDS if renderer in ("auto", backend)]
    if not candidates:
        raise InvalidInput("env.renderer", renderer, f"use auto, {' or '.join(BACKENDS)}")
    for backend in candidates:
        if not fault(backend):
            if backend != candidates[0]:
                lacks = f"{candidates[0]} does not render here ({fault(candidates[0])})"
                warnings.warn(f"{lacks}: {backend} does, its pixels differ", stacklevel=2)
            return backend
    why = ", ".join(f"{b} does not render here ({fault(b)})" for b in candidates)
    how = ", or ".join(f"apt-get install {PACKAGES[b]}" for b in candidates)
    raise InvalidInput("env.renderer", renderer, f"{why}; {how}")


@functools.cache
def fault(backend: Backend) -> str:
    """Why a process of its own cannot render with `backend`, in one line; "" if it can."""
    try:
        done = subprocess.run(
            [sys.executable, "-P", "-c", PROBE],
            env=os.environ | variables(backend),
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
            errors="replace",
            timeout=PROBE_SECONDS,
        )
    except subprocess.TimeoutExpired:
        return f"no frame within {PROBE_SECONDS} s"
    if done.returncode == 0:
        return ""
    said = done.stderr.strip().splitlines() or [f"exit code {done.returncode}"]
    return textwrap.shorten(said[-1], LONGEST)


def use(backend: Backend) -> None:
    """Has this process render with `backend`; to be called before it imports dm_control.

    Raises:
      InvalidInput: the process has another backend already.
    """
    present = loaded()
    if present not in (None, backend):
        remedy = f"this process has loaded {present!r} already; render in one of its own"
        raise InvalidInput("env.renderer", backend, remedy)
    os.environ.update(variables(backend))


def variables(backend: Backend) -> dict[str, str]:
    """What dm_control and PyOpenGL read at import.

    OSMesa would have a thread per context, which is for programs that render from several;
    EGL has none.
    """
    return {
        "MUJOCO_GL": backend,
        "PYOPENGL_PLATFORM": backend,
        "DISABLE_RENDER_THREAD_OFFLOADING": "1",
    }


def loaded() -> str | None:
    """The backend that dm_control or PyOpenGL has in this process; "off" is none for good."""
    if (render := sys.modules.get("dm_control._render")) is not None:
        return str(render.BACKEND)
    if (opengl := sys.modules.get("OpenGL.platform")) is not None:
        return type(opengl.PLATFORM).__name__.removesuffix("Platform").lower()
    return None
