"""The restart with huge pages, each in its own process."""

import os
import subprocess
import sys

import pytest

from vawm.process import huge_pages

PROGRAM = """
import os, sys
from vawm.process.huge_pages import use_huge_pages
use_huge_pages()
print(os.environ.get("GLIBC_TUNABLES"), sys.argv[1:])
"""


def run(tmp_path, text=PROGRAM, **environment):
    program = tmp_path / "program.py"
    program.write_text(text)
    clean = {name: value for name, value in os.environ.items() if name != "GLIBC_TUNABLES"}
    return subprocess.run(
        [sys.executable, str(program), "--flag", "a b"],
        env=clean | environment,
        capture_output=True,
        text=True,
        check=True,
        timeout=60,
    ).stdout


needs_huge_pages = pytest.mark.skipif(
    not huge_pages.offered(), reason="this system does not offer huge pages on request"
)


@needs_huge_pages
def test_a_program_restarts_once_with_the_same_arguments(tmp_path):
    setting = ":".join(huge_pages.TUNABLES)
    assert run(tmp_path) == f"{setting} ['--flag', 'a b']\n"


@needs_huge_pages
def test_other_tunables_are_kept(tmp_path):
    out = run(tmp_path, GLIBC_TUNABLES="glibc.rtld.nns=4")
    assert out.startswith("glibc.rtld.nns=4:glibc.malloc.hugetlb=1:")


@needs_huge_pages
def test_jax_computes_where_memory_is_kept(tmp_path):
    """Only in a program that has restarted itself."""
    shown = "import jax; print(jax.config._read('jax_cpu_enable_async_dispatch'))"
    program = f"{PROGRAM}\n{shown}\n"
    assert run(tmp_path, program).endswith("False\n")
    assert run(tmp_path, program, VAWM_HUGE_PAGES="0").endswith("True\n")


def test_it_can_be_turned_off(tmp_path):
    assert run(tmp_path, VAWM_HUGE_PAGES="0") == "None ['--flag', 'a b']\n"


def test_the_users_own_malloc_setting_is_kept(tmp_path):
    out = run(tmp_path, GLIBC_TUNABLES="glibc.malloc.hugetlb=0")
    assert out.startswith("glibc.malloc.hugetlb=0 ")
