"""The DeepMind Control Suite's proprio tasks on MJX, one module per domain."""

import contextlib
import io

# On import, mjx prints that its optional CUDA backend is missing. Keep that out of stdout.
with contextlib.redirect_stdout(io.StringIO()):
    import mujoco.mjx  # noqa: F401
