"""Saliency: the parts of an observation that a latent and its value depend on; Figs 3 and 13.

Three maps with the shape of the observation, at an inferred state s = (h, z):

    sensitivity      sqrt(sum_j (d o_i / d z_j)^2)        how strongly o_i changes with z
    value            |sum_j d o_i / d z_j * dV / d z_j|   how o_i changes as V rises
    observed         |dV / d x_i|                         how V depends on the input x_i

o is the decoded observation at (h, z), and x the observation that z was inferred from. The
paper calls the second map value-gradient weighting and gives no formula: we push dV/dz
through the decoder's Jacobian.

For the first two maps, decoder and critic are differentiated at the sampled one-hot z as if it
were any vector, with h fixed, along directions that keep the sum of each categorical. J and
dV/dz are centred accordingly, so a decoder or a critic that ignores z has empty maps. The third
map differentiates through encoder and posterior of the last step, and through the sample of z
by the straight-through gradient of the probabilities; h does not depend on x. If z is not
sampled, it is the exact gradient.

V is the critic's mean, or its symlog. Images are in [0, 1], decoded vectors in symlog. A map
has one number per pixel, the Euclidean norm over its colours (the absolute value if there is
only one).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from vawm.agent import Agent, make_agent
from vawm.analysis import inference
from vawm.analysis.episodes import Episodes, windows
from vawm.envs.protocol import check_positive
from vawm.errors import InvalidInput
from vawm.losses import transforms
from vawm.nets.distributions import on_simplex
from vawm.policy import Policy
from vawm.types import Array, Batch, Key, Latent, Params, PyTree, is_image

Unit = Literal["symlog", "raw"]
MAPS = ("sensitivity", "value", "observed")


class Saliency(NamedTuple):
    """Maps of F states; every field but the last has the tree of an observation.

    Maps of images are `[F, H, W]`, of vectors `[F, D]`; `decoded` is the decoder's output.
    """

    decoded: PyTree
    sensitivity: PyTree
    value: PyTree
    observed: PyTree
    states: Array  # [F] V of the states


def make_saliency(
    agent: Agent, *, unit: Unit = "symlog", probes: int = 128
) -> Callable[[Params, PyTree, Key, Batch], Saliency]:
    """Builds `saliency(params, model_state, key, batch) -> Saliency`, of each row's last step.

    Args:
      agent: the agent.
      unit: of V.
      probes: number of random sign vectors v that estimate the squared sensitivity as the
        mean of (J v)^2, with J = d o / d z. Unbiased, with a relative standard error of at
        most sqrt(2 / probes) per entry. No Jacobian is built.
    """
    world_model = agent.world_model
    value = make_value(agent, unit=unit)

    def saliency(params: Params, model_state: PyTree, key: Key, batch: Batch) -> Saliency:
        key_follow, key_probe = jax.random.split(key)
        model = params.world_model

        def infer(obs: PyTree) -> Latent:
            """The state after the last step, with `obs` as its observation."""
            joined = jax.tree.map(
                lambda past, last: jnp.concatenate([past[:, :-1], last[:, None]], axis=1),
                batch.trajectory.obs,
                obs,
            )
            seen = batch._replace(trajectory=batch.trajectory._replace(obs=joined))
            inferred, _ = world_model.follow(model, model_state, key_follow, seen, horizon=1)
            return jax.tree.map(lambda x: x[:, -1], inferred)

        def value_after(obs: PyTree) -> tuple[Array, Latent]:
            latent = infer(obs)
            return value(params, latent).sum(), latent

        last = jax.tree.map(lambda x: x[:, -1], batch.trajectory.obs)
        observed, latent = gradient(value_after, last)

        def probe(total: PyTree, key: Key):
            sign = jax.random.rademacher(key, latent.stoch.shape, latent.stoch.dtype)
            return jax.tree.map(lambda t, x: t + jnp.square(x), total, push(sign)), None

        decoded, push, slope = around(agent, value, params, model_state, latent)
        zero = jax.tree.map(jnp.zeros_like, decoded)
        squares, _ = jax.lax.scan(probe, zero, jax.random.split(key_probe, probes))
        return Saliency(
            decoded=decoded,
            sensitivity=norms(jax.tree.map(lambda x: jnp.sqrt(x / probes), squares), last),
            value=norms(push(slope), last),
            observed=norms(observed, last),
            states=value(params, latent),
        )

    return saliency


def make_value(agent: Agent, *, unit: Unit) -> Callable[[Params, Latent], Array]:
    """Builds `value(params, latent) -> V` in `unit`, for latents of any leading dims."""
    critic = agent.critic

    def value(params: Params, latent: Latent) -> Array:
        mean = critic.code.mean(critic.logits(params.critic, latent))
        return transforms.symlog(mean) if unit == "symlog" else mean

    return value


def around(
    agent: Agent,
    value: Callable[[Params, Latent], Array],
    params: Params,
    model_state: PyTree,
    latent: Latent,
) -> tuple[PyTree, Callable[[Array], PyTree], Array]:
    """Linearises decoder and value at F states, along the simplex of z.

    Returns:
      The decoded observation, `push(v) = J v` with J = d o / d z, and dV/dz `[F, S, K]`.
    """
    deter, stoch = latent

    def decode(stoch: Array) -> PyTree:
        on_it = Latent(deter, on_simplex(stoch))
        predictions = agent.world_model.predict(params.world_model, model_state, on_it)
        return inference.reconstruction(predictions.obs)

    # No network mixes rows, so the gradient of the sum contains that of each row.
    slope = jax.grad(lambda z: value(params, Latent(deter, on_simplex(z))).sum())(stoch)
    return *forward(decode, stoch), slope


def value_map(
    agent: Agent, *, unit: Unit = "symlog"
) -> Callable[[Params, PyTree, Latent, PyTree], tuple[PyTree, PyTree]]:
    """Builds `maps(params, model_state, latent, like) -> (decoded, value)` for any F states.

    Args:
      agent: the agent.
      unit: the unit of V.

    Returns:
      A function of F imagined or inferred states and of F observations `like`, which only say
      what is an image. It returns `Saliency.decoded` and `Saliency.value` of the states.
    """
    value = make_value(agent, unit=unit)

    def maps(
        params: Params, model_state: PyTree, latent: Latent, like: PyTree
    ) -> tuple[PyTree, PyTree]:
        decoded, push, slope = around(agent, value, params, model_state, latent)
        return decoded, norms(push(slope), like)

    return maps


def forward(
    function: Callable[[Array], PyTree], x: Array
) -> tuple[PyTree, Callable[[Array], PyTree]]:
    """`function(x)`, and its directional derivative there, v -> J v.

    Transposes u -> J^T u, which is linear in u, because some convolutions only define their
    reverse derivative.
    """
    y, pull = jax.vjp(function, x)
    _, push = jax.vjp(lambda u: pull(u)[0], jax.tree.map(jnp.zeros_like, y))
    return y, lambda v: push(v)[0]


def gradient(
    function: Callable[[PyTree], tuple[Array, PyTree]], obs: PyTree
) -> tuple[PyTree, PyTree]:
    """The gradient of the scalar that `function` returns first, and its second output.

    uint8 has no gradient: `function` gets pixels as floats from 0 to 255, and the gradient is
    with respect to pixels in [0, 1], the decoder's unit.
    """
    units = jax.tree.map(lambda x: 255.0 if is_image(x) else 1.0, obs)

    def of_units(scaled: PyTree) -> tuple[Array, PyTree]:
        return function(jax.tree.map(jnp.multiply, scaled, units))

    return jax.grad(of_units, has_aux=True)(jax.tree.map(jnp.divide, obs, units))


def norms(changes: PyTree, obs: PyTree) -> PyTree:
    """Euclidean norm over the colours of images, absolute value for vectors."""

    def norm(like: Array, change: Array) -> Array:
        return jnp.sqrt(jnp.square(change).sum(-1)) if is_image(like) else jnp.abs(change)

    return jax.tree.map(norm, obs, changes)


class Look(NamedTuple):
    """The saliency of F states of one episode; numpy.

    Attributes:
      step: `[F]` steps of the episode.
      truth: observations there, `[F, ...]`.
      saliency: of these states.
      unit: of V.
    """

    step: np.ndarray
    truth: PyTree
    saliency: Saliency
    unit: Unit


def look(
    policy: Policy,
    episodes: Episodes,
    *,
    context: int,
    frames: int,
    seed: int,
    unit: Unit = "symlog",
) -> Look:
    """Computes maps of `frames` states, evenly spaced over the first episode.

    Every state is inferred from the `context` steps that end there; the first of these only
    gives context. So the first state is at step `context - 1`.

    Raises:
      InvalidInput: an impossible number, or an episode shorter than the context.
    """
    inference.check(policy.config, context=context, depth=1)
    check_positive("frames", frames)
    length = int(np.asarray(episodes.length)[0])
    if length < context:
        remedy = f"use at most {length}, the steps of the first episode"
        raise InvalidInput("context", context, remedy)
    step = np.unique(np.linspace(context - 1, length - 1, frames).round().astype(int))
    batch = windows(episodes, np.zeros_like(step), step - (context - 1), length=context)
    agent = make_agent(policy.config, policy.spec)
    maps = jax.jit(make_saliency(agent, unit=unit))(
        policy.params, policy.model_state, jax.random.key(seed), batch
    )
    truth = jax.tree.map(lambda x: x[:, -1], batch.trajectory.obs)
    return Look(step, jax.device_get(truth), jax.device_get(maps), unit)


def images(like: PyTree, maps: PyTree) -> np.ndarray | None:
    """The maps of all images side by side, `[F, H, W]`; None if there are none."""
    pairs = zip(jax.tree.leaves(like), _leaves(maps), strict=True)
    found = [x for truth, x in pairs if is_image(truth) and x is not None]
    return np.concatenate(found, -1) if found else None


def coordinates(like: PyTree, maps: PyTree) -> np.ndarray | None:
    """The maps of all vectors, concatenated, `[F, D]`; None if there are none."""
    pairs = zip(jax.tree.leaves(like), _leaves(maps), strict=True)
    found = [x for truth, x in pairs if not is_image(truth) and x is not None]
    return np.concatenate(found, -1) if found else None


def _leaves(maps: PyTree) -> list[Any]:
    return jax.tree.leaves(maps, is_leaf=lambda x: x is None)


def concentration(maps: np.ndarray) -> float:
    """Share of a map's sum in its strongest tenth of entries, mean over `[F, ...]`.

    0.1 for a uniform map, 1 if one tenth has everything, NaN if all maps are 0.
    """
    flat = np.sort(np.asarray(maps, np.float64).reshape(len(maps), -1), axis=1)[:, ::-1]
    total = flat.sum(1)
    strongest = flat[:, : -(-flat.shape[1] // 10)].sum(1)
    shares = strongest[total > 0] / total[total > 0]
    return float(shares.mean()) if len(shares) else float("nan")


def rows(name: str, look: Look) -> list[dict[str, Any]]:
    """Rows for a CSV: the concentration of maps of images, and vectors by coordinate."""
    result = []
    for kind in MAPS:
        maps = getattr(look.saliency, kind)
        pixels, vector = images(look.truth, maps), coordinates(look.truth, maps)
        if pixels is not None:
            entry = {"run": name, "map": kind, "what": "concentration"}
            result.append(entry | {"value": concentration(pixels)})
        for i, mean in enumerate([] if vector is None else vector.mean(0)):
            entry = {"run": name, "map": kind, "what": f"coordinate {i}"}
            result.append(entry | {"value": float(mean)})
    return result
