"""What suites on the host have in common."""

from __future__ import annotations

from collections.abc import Callable

from vawm.config import Config, HostEnvConfig
from vawm.envs.host.pool import Pool
from vawm.envs.host.simulator import Simulator


def pool(config: Config, env: HostEnvConfig, simulator: Callable[[], Simulator]) -> Pool:
    """The environments of a run, in processes that call `simulator` for each of them."""
    return Pool(
        simulator,
        task=config.task,
        num_envs=config.num_envs,
        action_repeat=config.action_repeat,
        workers=env.workers,
        timeout=env.timeout,
        on_failure=env.on_failure,
    )
