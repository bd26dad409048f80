"""The losses alone: what a fresh process has imported once it can use them."""

import subprocess
import sys

HEAVY = {"flax", "distrax", "optax", "gymnasium", "mujoco", "dm_control", "orbax", "tyro"}


def test_the_losses_import_no_networks_no_environments_and_no_other_room():
    code = "import sys, vawm.losses; print(*sys.modules)"
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    modules = done.stdout.split()
    assert "vawm.losses.vagram" in modules
    assert not HEAVY & {name.split(".")[0] for name in modules}
    rooms = {name.split(".")[1] for name in modules if name.startswith("vawm.")}
    assert rooms == {"losses", "returns", "transforms"}
