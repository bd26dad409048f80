"""The losses import nothing else of the package."""

import pathlib
import shutil
import subprocess
import sys

from vawm import losses

HEAVY = {"flax", "distrax", "optax", "gymnasium", "mujoco", "dm_control", "orbax", "tyro"}


def imported(code, **where):
    """The names of the modules that a new process has loaded after `code`."""
    done = subprocess.run(
        [sys.executable, "-c", f"{code}; import sys; print(*sys.modules)"],
        capture_output=True,
        text=True,
        check=True,
        **where,
    )
    return done.stdout.split()


def test_the_losses_import_no_networks_no_environments_and_no_other_room():
    modules = imported("import vawm.losses")
    assert "vawm.losses.vagram" in modules
    assert not HEAVY & {name.split(".")[0] for name in modules}
    assert {name.split(".")[1] for name in modules if name.startswith("vawm.")} == {"losses"}


def test_the_losses_can_be_lifted_out_of_the_package_as_a_folder(tmp_path):
    shutil.copytree(pathlib.Path(losses.__file__).parent, tmp_path / "lifted")
    modules = imported("from lifted import value_alignment_loss", cwd=tmp_path)
    assert "lifted.value_alignment" in modules
    assert not {name for name in modules if name.split(".")[0] == "vawm"}
