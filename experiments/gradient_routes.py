"""Measures the gradient of value alignment, and the effect of its noise, before training.

    python experiments/gradient_routes.py

Prints the two tables at the end of `docs/paper.md`, for STORM's `paper` preset at its initial
parameters, on random pixels and actions. Each cell is the range over seeds. The last column of
the first table is the gradient of a critic without stopped parameters.
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import jax
import jax.numpy as jnp
import optax

from vawm import losses, presets
from vawm.agent import Agent, make_agent
from vawm.cli import command_line, flags
from vawm.config import Config, ValueAlignmentConfig
from vawm.envs.protocol import check_positive
from vawm.learning.alignment import make_value_alignment
from vawm.losses import transforms
from vawm.nets import distributions
from vawm.process import cache
from vawm.sweep.results import line
from vawm.types import Array, Batch, EnvSpec, Inference, Key, Latent, PyTree, Trajectory, image

SPEC = EnvSpec("synthetic", image(64), 18, True, 1, 1, None)
CONFIG = dataclasses.replace(presets.STORM, compute_dtype="float32")
TERMS = {"KL(sg V(s), V(s~))": (1.0, 0.0), "KL(V(s), sg V(s~))": (0.0, 1.0)}
DETER: dict[Literal["live", "stop"], str] = {"live": "h live", "stop": "h stopped"}
MIXER = "transformer", "mix_in", "mix_in_norm", "mix_out", "mix_out_norm"
PARTS = {
    "prior head": ("storm", ("prior_out",)),
    "transformer and mixer": ("storm", MIXER),
    "posterior head": ("storm", ("posterior_out",)),
    "encoder": ("encoder", None),
}
FACTORS = 1, 2, 4, 16


@dataclass(frozen=True)
class Options:
    """The size of the measurement."""

    seeds: int = 3
    """initial parameters and batches to measure"""
    batch_size: int = 2
    """sequences in a batch"""
    batch_length: int = 16
    """steps of each"""
    states: int = 4096
    """states to compare values of"""


def random_batch(spec: EnvSpec, key: Key, shape: tuple[int, int]) -> Batch:
    """A batch of random pixels and actions."""
    key_obs, key_action = jax.random.split(key)
    chosen = jax.random.randint(key_action, shape, 0, spec.action_size)
    never = jnp.zeros(shape, bool)
    steps = Trajectory(
        obs=jax.random.randint(key_obs, (*shape, *spec.obs.shape), 0, 256).astype(jnp.uint8),
        reward=jnp.zeros(shape),
        is_first=never,
        is_last=never,
        is_terminal=never,
        action=jax.nn.one_hot(chosen, spec.action_size),
    )
    return Batch(steps, ())


def routes(agent: Agent, config: Config, options: Options) -> dict[str, list[list[float]]]:
    """Term -> gradient norm of each part of the world model and of the critic, by seed."""

    def norms(seed: Array, alignment: ValueAlignmentConfig) -> list[Array]:
        key_init, key_batch, key_explain = jax.random.split(jax.random.key(seed), 3)
        params, model_state = agent.init(key_init)
        shape = options.batch_size, options.batch_length + 1
        batch = random_batch(agent.spec, key_batch, shape)
        aligned = make_value_alignment(
            agent, dataclasses.replace(config, value_alignment=alignment)
        )

        def explain(world_model: PyTree) -> Inference:
            return agent.world_model.explain(world_model, model_state, key_explain, batch)[
                0
            ].inference

        def loss(inference: Inference) -> Array:
            kl = jnp.ones(inference.post_logits.shape[:2])
            return aligned(params.critic, inference, kl, jnp.asarray(1)).loss.mean()

        def loss_of_critic(critic: PyTree) -> Array:
            pair = inference.latent, inference.prior_latent
            return losses.value_alignment_loss(
                *(agent.critic.logits(critic, latent) for latent in pair),
                dynamics_scale=alignment.dynamics_scale,
                representation_scale=alignment.representation_scale,
            ).mean()

        inference, to_world_model = jax.vjp(explain, params.world_model)
        (gradient,) = to_world_model(jax.grad(loss)(inference))
        found = [
            gradient[module] if names is None else {n: gradient[module][n] for n in names}
            for module, names in PARTS.values()
        ]
        return [optax.tree.norm(x) for x in (*found, jax.grad(loss_of_critic)(params.critic))]

    rows = {}
    for (term, scales), deter in itertools.product(TERMS.items(), DETER):
        alignment = ValueAlignmentConfig(
            dynamics_scale=scales[0], representation_scale=scales[1], deter_gradient=deter
        )
        run = jax.jit(functools.partial(norms, alignment=alignment))
        by_seed = [map(float, run(seed)) for seed in range(options.seeds)]
        parts = zip(*by_seed, strict=True)
        rows[f"{term}, {DETER[deter]}"] = [list(part) for part in parts]
    return rows


def noise(agent: Agent, config: Config, options: Options) -> dict[str, list[list[float]]]:
    """Kind of noise -> KL of values for each factor, by seed.

    The prior logits are the factor times the posterior logits.
    """
    model = config.world_model

    @jax.jit
    def kls(seed: Array) -> dict[str, list[Array]]:
        keys = jax.random.split(jax.random.key(seed), 5)
        critic = agent.init(keys[0])[0].critic
        deter = jax.random.normal(keys[1], (options.states, model.deter))
        logits = jax.random.normal(keys[2], (options.states, model.stoch, model.classes))
        shared, other = (jax.random.uniform(key, logits.shape[:-1]) for key in keys[3:])

        def values(logits: Array, uniform: Array) -> Array:
            stoch = distributions.sample_one_hot(logits, uniform, unimix=model.unimix)
            return agent.critic.logits(critic, Latent(deter, stoch))

        def kl(factor: float, uniform: Array) -> Array:
            predicted = values(factor * logits, uniform)
            return transforms.categorical_kl(values(logits, shared), predicted).mean()

        draws = {"independent": other, "shared": shared}
        return {name: [kl(f, uniform) for f in FACTORS] for name, uniform in draws.items()}

    by_seed = [kls(seed) for seed in range(options.seeds)]
    return {
        name: [[float(found[name][i]) for found in by_seed] for i in range(len(FACTORS))]
        for name in by_seed[0]
    }


def table(head: Sequence[str], rows: dict[str, list[list[float]]]) -> str:
    """A table in Markdown; every cell has the lowest and the highest number."""
    lines = [line(head), line(["---"] * len(head))]
    for name, cells in rows.items():
        ends = ([f"{end(cell):.2g}" for end in (min, max)] for cell in cells)
        lines.append(line([name, *(" to ".join(dict.fromkeys(pair)) for pair in ends)]))
    return "\n".join(lines)


def main(argv: Sequence[str] | None = None) -> int:
    """Prints both tables."""
    options = flags.read(Options, argv, description=__doc__)
    for field in dataclasses.fields(options):
        check_positive(field.name, getattr(options, field.name))
    cache.enable()
    agent = make_agent(CONFIG, SPEC)
    print(table(["term", *PARTS, "critic"], routes(agent, CONFIG, options)), end="\n\n")
    print(table(["factor", *map(str, FACTORS)], noise(agent, CONFIG, options)))
    return 0


if __name__ == "__main__":
    sys.exit(command_line.guard(main))
