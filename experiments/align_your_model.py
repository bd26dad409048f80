"""Value alignment in somebody else's world model; `value_alignment` is all that it takes.

    python experiments/align_your_model.py

The model is a GRU with one categorical latent, in plain JAX. It learns sequences of a point
that is pushed along a circle and slips. The critic is anybody's: here one of random weights.
The model is trained without value alignment and with it, from the same start and on the same
sequences; printed are means over the first step, and over the last 50.
"""

import jax
import jax.numpy as jnp

from vawm import losses

BATCH, LENGTH, HIDDEN, CLASSES, STEPS, RATE = 32, 16, 32, 8, 500, 0.1
SHAPES = {
    "gates": (HIDDEN + CLASSES + 1, 2 * HIDDEN),
    "candidate": (HIDDEN + CLASSES + 1, HIDDEN),
    "posterior": (HIDDEN + 2, CLASSES),
    "prior": (HIDDEN, CLASSES),
    "decoder": (HIDDEN + CLASSES, 2),
    "critic": (HIDDEN + CLASSES, 21),
}


def join(*parts):
    return jnp.concatenate(parts, -1)


def sequences(key):
    """`[T, B, 2]` where the point is, `[T, B, 1]` the pushes that led there."""
    key_push, key_slip = jax.random.split(key)
    push = jax.random.rademacher(key_push, (LENGTH, BATCH, 1), float)
    angle = 0.4 * jnp.cumsum(push + jax.random.normal(key_slip, push.shape), axis=0)
    return join(jnp.cos(angle), jnp.sin(angle)), push


def sample(key, logits):
    """One-hot, with the gradient of the probabilities."""
    probs = jax.nn.softmax(logits)
    one_hot = jax.nn.one_hot(jax.random.categorical(key, logits), CLASSES)
    return one_hot + probs - jax.lax.stop_gradient(probs)


def observe(params, key, obs, push):
    """`[T, B, ...]` h_t, z_t, and the logits of its posterior and its prior."""

    def step(carry, inputs):
        (h, z), (obs, push, key) = carry, inputs
        update, reset = jnp.split(jax.nn.sigmoid(join(h, z, push) @ params["gates"]), 2, -1)
        candidate = jnp.tanh(join(reset * h, z, push) @ params["candidate"])
        h = (1 - update) * h + update * candidate
        logits = join(h, obs) @ params["posterior"]
        z = sample(key, logits)
        return (h, z), (h, z, logits)

    start = jnp.zeros((BATCH, HIDDEN)), jnp.zeros((BATCH, CLASSES))
    _, (h, z, logits) = jax.lax.scan(step, start, (obs, push, jax.random.split(key, LENGTH)))
    return h, z, logits, h @ params["prior"]


def value_alignment(params, key, h, z, prior):
    """`[T, B]` L_var; the critic is frozen, or it would learn to be indifferent instead."""
    critic = jax.lax.stop_gradient(params["critic"])
    value_logits, prior_value_logits = join(h, z) @ critic, join(h, sample(key, prior)) @ critic
    return losses.value_alignment_loss(
        value_logits, prior_value_logits, dynamics_scale=0.5, representation_scale=0.1
    )


def loss(params, key, batch, scale):
    """The model's own loss with value alignment added, and what is printed of it.

    In an agent, `losses.value_alignment_weight` takes the place of `scale`.
    """
    (obs, push), (key_post, key_prior) = batch, jax.random.split(key)
    h, z, post, prior = observe(params, key_post, obs, push)
    reconstruction = jnp.square(join(h, z) @ params["decoder"] - obs).sum(-1)
    kl = losses.balanced_kl(post[..., None, :], prior[..., None, :], unimix=0.01)
    aligned = value_alignment(params, key_prior, h, z, prior)
    total = reconstruction + 1.0 * kl[0] + 0.1 * kl[1] + scale * aligned
    # Both terms of L_var have the value of the KL; they differ in their gradients.
    printed = {"reconstruction": reconstruction, "latent KL": kl[0], "value KL": aligned / 0.6}
    return total.mean(), jax.tree.map(jnp.mean, printed)


@jax.jit
def train(params, scale):
    """`[STEPS]` of all that is printed, each at new sequences, along as many gradient steps."""

    def step(params, key):
        key_batch, key_loss = jax.random.split(key)
        slope, printed = jax.grad(loss, has_aux=True)(
            params, key_loss, sequences(key_batch), scale
        )
        return jax.tree.map(lambda p, g: p - RATE * g, params, slope), printed

    return jax.lax.scan(step, params, jax.random.split(jax.random.key(1), STEPS))[1]


def init(key):
    keys = zip(SHAPES.items(), jax.random.split(key, len(SHAPES)), strict=True)
    params = {name: jax.random.normal(key, size) / size[0] ** 0.5 for (name, size), key in keys}
    return params | {"critic": 5.0 * params["critic"]}


def main():
    params = init(jax.random.key(0))
    without, aligned = train(params, 0.0), train(params, 1.0)
    for stage, printed, steps in [
        ("before", without, slice(1)),
        ("without", without, slice(-50, None)),
        ("with", aligned, slice(-50, None)),
    ]:
        print(f"{stage:8}", *(f" {name} {x[steps].mean():.4f}" for name, x in printed.items()))


if __name__ == "__main__":
    main()
