"""Measures the speed of an update, on a synthetic batch, with and without value alignment.

    python experiments/benchmark.py --size 1m --json
    python experiments/benchmark.py --size 1m --obs pixels --json
    python experiments/benchmark.py --agent storm --obs pixels --json

Prints medians over repeated updates after a warm-up. Absolute times depend on the machine; only
ratios within one run are reliable. "off" removes value alignment and its metrics from the
compiled function, which leaves plain DreamerV3 or plain STORM. From pixels, collection is timed
with environments that dm_control renders in 1 to 4 processes.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import json
import os
import statistics
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np

from vawm import envs
from vawm.agent import make_agent, parameter_count, registry
from vawm.cli import flags
from vawm.cli.command_line import guard
from vawm.config import (
    CUSTOM,
    AgentName,
    Config,
    ValueAlignmentConfig,
    VisionConfig,
)
from vawm.envs.protocol import check_image_size, check_positive
from vawm.errors import InvalidInput
from vawm.learning import from_replay, train
from vawm.learning.collector import make_collect
from vawm.learning.from_replay import Draw
from vawm.learning.state import init_learner
from vawm.learning.update import make_update
from vawm.process import huge_pages
from vawm.runs import budget, validate
from vawm.runs.suites import dmc_vision
from vawm.sweep.overhead import peak_process_bytes, percent_more, quartiles
from vawm.types import Batch, EnvSpec, Trajectory, image, vector


@dataclass(frozen=True)
class Benchmark:
    """Time the update, its compilation, and stepping environments with the policy."""

    agent: AgentName = "dreamerv3"
    """storm: Table 14, imagination from 1024 separate contexts"""
    size: str | None = None
    """model size; default 16m for storm, the smallest for other agents"""
    batch_size: int = 16
    """sequences in a batch"""
    batch_length: int = 64
    """steps of each"""
    obs: Literal["vector", "pixels"] = "vector"
    """pixels: RGB images, and 18 discrete actions as in Atari"""
    observations: int = 24
    """width of the vector"""
    actions: int = 6
    """continuous actions with a vector"""
    image_size: int = 64
    """pixels a side, with --obs pixels"""
    repeats: int = 16
    """timed updates of each kind"""
    compute_dtype: Literal["auto", "float32", "bfloat16"] = "auto"
    """auto: bfloat16 on GPU and TPU, float32 on CPU"""
    task: str = "cartpole_swingup"
    """environment for env_steps_per_s"""
    num_envs: int = 16
    """environments side by side for env_steps_per_s"""
    env_calls: int = 100
    """steps of every environment in the timed collection"""
    fast_rendering: bool = False
    """without shadows, reflections and anti-aliasing"""
    json: bool = False
    """print only one JSON object"""


def check(options: Benchmark) -> None:
    """Refuses impossible options, before anything is compiled."""
    validate.check_choice("agent", options.agent, registry.names())
    validate.check_choice("size", size_of(options), [*sizes_of(options), CUSTOM])
    registry.kind(options.agent).check(make_config(options))
    envs.check_task(options.task)
    check_image_size("image_size", options.image_size)
    for field in dataclasses.fields(options):
        value = getattr(options, field.name)
        if field.type == "int":
            check_positive(field.name, value)
            if value >= validate.INT32:
                raise InvalidInput(field.name, value, f"use a number below {validate.INT32}")


def sizes_of(options: Benchmark) -> Sequence[str]:
    return list(registry.kind(options.agent).sizes)


def size_of(options: Benchmark) -> str:
    """The size in the options; default 16m for storm, the smallest for other agents."""
    if options.size is not None:
        return options.size
    return "16m" if options.agent == "storm" else next(iter(sizes_of(options)), CUSTOM)


def paper_of(agent: str) -> Config:
    """The paper's preset of an agent, for the proprio tasks if there is one."""
    of_suites = registry.kind(agent).presets.values()
    papers = [named["paper"] for named in of_suites if "paper" in named]
    return papers[0] if papers else next(iter(next(iter(of_suites)).values()))


def make_config(options: Benchmark) -> Config:
    paper, size = paper_of(options.agent), size_of(options)
    return dataclasses.replace(
        paper if size == CUSTOM else registry.with_size(paper, size),
        compute_dtype=options.compute_dtype,
        num_envs=options.num_envs,
        action_repeat=1,
        env_steps=options.num_envs * options.env_calls,
        collect_steps=options.env_calls,
        replay=dataclasses.replace(
            paper.replay, batch_size=options.batch_size, batch_length=options.batch_length
        ),
        value_alignment=ValueAlignmentConfig(warmup_steps=0),
    )


def synthetic_batch(options: Benchmark, shape: tuple[int, int], context, seed: int) -> Batch:
    """Random experience of `shape` (sequences, steps)."""
    key_obs, key_action, key_reward = jax.random.split(jax.random.key(seed), 3)
    flags = jnp.zeros(shape, bool)
    spec = make_spec(options)
    if options.obs == "pixels":
        obs = jax.random.randint(key_obs, (*shape, *spec.obs.shape), 0, 256).astype(jnp.uint8)
        chosen = jax.random.randint(key_action, shape, 0, spec.action_size)
        action = jax.nn.one_hot(chosen, spec.action_size)
    else:
        obs = jax.random.normal(key_obs, (*shape, *spec.obs.shape))
        action = jax.random.normal(key_action, (*shape, spec.action_size))
    trajectory = Trajectory(
        obs=obs,
        reward=jax.random.uniform(key_reward, shape),
        is_first=flags,
        is_last=flags,
        is_terminal=flags,
        action=action,
    )
    return Batch(trajectory, context)


def make_spec(options: Benchmark) -> EnvSpec:
    """The environment spec of a synthetic batch."""
    if options.obs == "pixels":
        return EnvSpec("synthetic", image(options.image_size), 18, True, 1, 1, None)
    obs = vector(options.observations)
    return EnvSpec("synthetic", obs, options.actions, False, 1, 1, None)


class TimedUpdate:
    """One compiled variant of the update, with its learner."""

    def __init__(self, agent, config: Config, batch: Draw, aligned: bool):
        update = make_update(agent, config)

        def step(learner, batch, key):
            step = jnp.ones((), jnp.int32)
            learner, latent, metrics = update(learner, batch.batch, batch.contexts, key, step)
            kept = {k: v for k, v in metrics.items() if aligned or "alignment" not in k}
            return learner, latent, kept

        self.batch, self.key = batch, jax.random.key(1)
        self.seconds: list[float] = []
        init = jax.jit(lambda key: init_learner(agent, config, key))
        self.learner = init(jax.random.key(0))
        begin = time.perf_counter()
        self.step = (
            jax.jit(step, donate_argnums=0).lower(self.learner, batch, self.key).compile()
        )
        self.compile_seconds = time.perf_counter() - begin

    def run(self) -> None:
        begin = time.perf_counter()
        self.learner, _, metrics = self.step(self.learner, self.batch, self.key)
        jax.block_until_ready((self.learner, metrics))
        self.seconds.append(time.perf_counter() - begin)


def product_gflop_per_s(side: int = 2048, repeats: int = 9) -> float:
    """Speed of a product of large float32 matrices, as a reference for this machine."""
    matrix = jax.random.normal(jax.random.key(0), (side, side))
    product = jax.jit(jnp.matmul)
    seconds = []
    for _ in range(repeats + 1):
        begin = time.perf_counter()
        product(matrix, matrix).block_until_ready()
        seconds.append(time.perf_counter() - begin)
    return 2e-9 * side**3 / statistics.median(seconds[1:])


def env_steps_per_s(options: Benchmark, config: Config) -> float:
    """Control steps per second of collection: acting, physics and storing, no learning."""
    env = envs.make(options.task, num_envs=options.num_envs, action_repeat=1)
    agent = make_agent(config, env.spec)
    state = train.init(env, agent, config, jax.random.key(0))
    collect = jax.jit(make_collect(env, agent, config))
    acting, seconds = (state.learner.params, state.learner.model_state), []
    for _ in range(4):
        begin = time.perf_counter()
        jax.block_until_ready(collect(*acting, state.collector, state.replay, state.key))
        seconds.append(time.perf_counter() - begin)
    return options.num_envs * options.env_calls / statistics.median(seconds[1:])


def frames_per_s(options: Benchmark, config: Config) -> dict[str, float]:
    """Rendered steps per second of all environments, with acting, by number of workers."""
    choices = VisionConfig(image_size=options.image_size, fast_rendering=options.fast_rendering)
    config = dataclasses.replace(config, suite="dmc_vision", task=options.task)
    act, measured = None, {}
    for workers in (1, 2, 3, 4):
        many = dataclasses.replace(choices, workers=workers)
        with contextlib.closing(dmc_vision.make(config, many)) as environments:
            timestep = environments.reset(0)
            agent = make_agent(config, environments.spec)
            acting, carry = agent.init(jax.random.key(0)), agent.initial(options.num_envs)
            act = act or jax.jit(agent.act)
            seconds = []
            for _ in range(options.env_calls + 2):
                begin = time.perf_counter()
                carry, action = act(*acting, jax.random.key(0), carry, timestep)
                environments.send(np.asarray(action))
                timestep = environments.receive()
                seconds.append(time.perf_counter() - begin)
        measured[str(workers)] = options.num_envs / statistics.median(seconds[2:])
    return measured


def check_memory(agent, config: Config) -> None:
    """Refuses sizes that do not fit into memory: two learners, and most of one update."""
    init = functools.partial(init_learner, agent, config)
    learner = jax.eval_shape(init, jax.random.key(0))
    state, params = budget.nbytes(learner), budget.nbytes(learner.params)
    needed = (
        2 * (state + params) + budget.working_bytes(agent.spec, config) + budget.process_bytes()
    )
    available = budget.available_bytes()
    if available is not None and needed > available:
        remedy = (
            f"needs {budget.readable(needed)}, but {budget.readable(available)} are free; "
            "use a smaller size or batch"
        )
        raise InvalidInput("size", config.size, remedy)


def run(options: Benchmark) -> dict:
    config = make_config(options)
    agent = make_agent(config, make_spec(options))
    check_memory(agent, config)
    shapes = from_replay.shapes(config)
    remembered = agent.world_model.initial(options.batch_size)
    context = agent.world_model.memory(remembered)
    batch = Draw(synthetic_batch(options, shapes.batch, context, seed=0), ())
    if from_replay.has_contexts(config):
        contexts = synthetic_batch(options, shapes.contexts, (), seed=1)
        batch = batch._replace(contexts=contexts)
    plain = dataclasses.replace(
        config, value_alignment=dataclasses.replace(config.value_alignment, weight="off")
    )
    on = TimedUpdate(agent, config, batch, aligned=True)
    for _ in range(2):
        on.run()
    peak_rss_gb = peak_process_bytes() / 2**30
    off = TimedUpdate(agent, plain, batch, aligned=False)
    for _ in range(2):
        off.run()
    on.seconds, off.seconds = [], []
    for _ in range(options.repeats):
        on.run()
        off.run()
    overheads = percent_more(on.seconds, off.seconds)
    products = product_gflop_per_s()
    if options.obs == "pixels":
        collected: dict = {"frames_per_s_by_workers": frames_per_s(options, config)}
        collected["fast_rendering"] = options.fast_rendering
    else:
        collected = {"env_steps_per_s": env_steps_per_s(options, config)}
    return {
        "agent": options.agent,
        "size": size_of(options),
        "obs": options.obs,
        "image_size": options.image_size if options.obs == "pixels" else None,
        "params": parameter_count(on.learner.params),
        "device": jax.devices()[0].device_kind,
        "cores": os.cpu_count(),
        "jax": jax.__version__,
        "batch": [options.batch_size, options.batch_length],
        "repeats": options.repeats,
        "update_s_median": statistics.median(on.seconds),
        "update_s_min": min(on.seconds),
        "update_s_median_off": statistics.median(off.seconds),
        "overhead_percent": statistics.median(overheads),
        "overhead_percent_quartiles": quartiles(overheads),
        "product_gflop_per_s": products,
        "compile_s": on.compile_seconds,
        "peak_rss_gb": peak_rss_gb,
        **collected,
        "env_task": options.task,
        "num_envs": options.num_envs,
    }


def main(argv: Sequence[str] | None = None) -> int:
    """Prints the measurements; returns the exit code."""
    options = flags.read(Benchmark, argv, description=__doc__)
    check(options)
    jax.config.update("jax_enable_compilation_cache", False)  # compile_s is without a cache
    result = run(options)
    if options.json:
        print(json.dumps(result))
    else:
        for name, value in result.items():
            print(f"{name:>20}  {value}")
    return 0


if __name__ == "__main__":
    huge_pages.use_huge_pages()
    sys.exit(guard(main))
