"""What a run is, in two lines, for callers without a text of their own."""

from __future__ import annotations

from vawm.config import Config


def text(config: Config, task: str) -> str:
    """Agent, preset, size and length, and from when on value alignment is active.

    Args:
      config: of the run.
      task: that of its environments, which may be the caller's own.
    """
    alignment = config.value_alignment
    active = "off"
    if alignment.weight != "off":
        unit = alignment.warmup_unit.replace("_", " ")
        active = f"{alignment.weight}, active after {alignment.warmup_steps:,} {unit}"
    return (
        f"{config.agent}, preset {config.preset}: {task}, {config.env_steps:,} env steps, "
        f"size {config.size}, seed {config.seed}\n"
        f"  value alignment: {active}"
    )
