"""XLA compiles in less than half of the usual time; what comes out is slower, and as exact.

Most of the time of tests goes into compiling what is run once.
"""

import importlib.metadata
import os

FLAGS = ["--xla_backend_optimization_level=0", "--xla_llvm_disable_expensive_passes=true"]
if importlib.metadata.version("jaxlib").startswith("0.10."):  # an unknown flag is fatal
    FLAGS.append("--xla_cpu_use_fusion_emitters=false")
USUAL = os.environ.get("XLA_FLAGS", "")
"""What the caller has set."""


def hurry() -> None:
    """For this process, which has not compiled yet, and for those that it starts."""
    os.environ["XLA_FLAGS"] = " ".join([USUAL, *FLAGS])
