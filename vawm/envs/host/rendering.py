"""Rendering without a display: finds an OpenGL backend that works and selects it.

EGL draws on a GPU, or on the CPU with Mesa; OSMesa always draws on the CPU. dm_control and
PyOpenGL read their backend from environment variables at import, and a failed import leaves
PyOpenGL unusable. So a backend is tried in a separate process, and a process that renders
selects one before it imports dm_control. An existing MUJOCO_GL is ignored;
MUJOCO_EGL_DEVICE_ID selects the GPU for EGL.
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
"""Packages that a backend needs on Debian and Ubuntu. With an NVIDIA GPU, its driver replaces
libgl1-mesa-dri."""

PROBE = """
from dm_control import mujoco

model = "<mujoco><worldbody><geom size='1'/></worldbody></mujoco>"
assert mujoco.Physics.from_xml_string(model).render(8, 8).any(), "the frame is black"
"""
PROBE_SECONDS = 45
LONGEST = 160  # characters of an error that is quoted


def choose(renderer: str) -> Backend:
    """The backend to render with: `renderer`, or the first that works if it is "auto".

    Trying a backend takes about a second, once per process.

    Raises:
      InvalidInput: it does not work here; says why, and which packages it needs.
    """
    candidates = [backend for backend in BACKENDS if renderer in ("auto", backend)]
    if not candidates:
        raise InvalidInput("env.renderer", renderer, f"use auto, {' or '.join(BACKENDS)}")
    for backend in candidates:
        if not fault(backend):
            if backend != candidates[0]:
                broken = f"{candidates[0]} cannot render here ({fault(candidates[0])})"
                warning = f"{broken}; using {backend}, whose pixels differ slightly"
                warnings.warn(warning, stacklevel=2)
            return backend
    why = ", ".join(f"{b} cannot render here ({fault(b)})" for b in candidates)
    how = ", or ".join(f"apt-get install {PACKAGES[b]}" for b in candidates)
    raise InvalidInput("env.renderer", renderer, f"{why}; {how}")


@functools.cache
def fault(backend: Backend) -> str:
    """Tries `backend` in a new process; returns its error in one line, or "" if it works."""
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
    """Makes this process render with `backend`; call it before importing dm_control.

    Raises:
      InvalidInput: the process has already loaded another backend.
    """
    present = loaded()
    if present not in (None, backend):
        remedy = f"this process has already loaded {present!r}; render in a new process"
        raise InvalidInput("env.renderer", backend, remedy)
    os.environ.update(variables(backend))


def variables(backend: Backend) -> dict[str, str]:
    """Environment variables that dm_control and PyOpenGL read at import.

    By default OSMesa uses one thread per context, which only programs that render from
    several threads need; EGL uses none.
    """
    return {
        "MUJOCO_GL": backend,
        "PYOPENGL_PLATFORM": backend,
        "DISABLE_RENDER_THREAD_OFFLOADING": "1",
    }


def loaded() -> str | None:
    """The backend that this process has loaded; "off" if dm_control found none to load."""
    if (render := sys.modules.get("dm_control._render")) is not None:
        return str(render.BACKEND)
    if (opengl := sys.modules.get("OpenGL.platform")) is not None:
        return type(opengl.PLATFORM).__name__.removesuffix("Platform").lower()
    return None
