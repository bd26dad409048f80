"""Makes XLA compile in less than half of the usual time; the code is slower, and as exact.

Tests spend most of their time compiling functions that they run once.
"""

import importlib.metadata
import os

FLAGS = ["--xla_backend_optimization_level=0", "--xla_llvm_disable_expensive_passes=true"]
if importlib.metadata.version("jaxlib").startswith("0.10."):  # an unknown flag is fatal
    FLAGS.append("--xla_cpu_use_fusion_emitters=false")
USUAL = os.environ.get("XLA_FLAGS", "")
"""The flags that the caller has set."""


def hurry() -> None:
    """Sets the flags for this process, before it compiles anything, and for its children."""
    os.environ["XLA_FLAGS"] = " ".join([USUAL, *FLAGS])
