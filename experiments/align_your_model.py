"""Value alignment in another world model: 40 lines of code, including model and data.

    python experiments/align_your_model.py

The model is recurrent, in plain JAX, with a categorical latent: h_t depends on the past, z_t on
h_t and the observation (posterior) or on h_t alone (prior). It learns the position of a point
that is pushed along a line and slips. Any critic works; here it is a layer of random weights.
For each seed, the model is trained twice from the same start and on the same data: with a
warm-up of value alignment that never ends, and with one that does. Prints the KL between the
values under posterior and prior: in the first step, and the mean over the last 50.
"""

import jax
import jax.numpy as jnp

from vawm.losses import balanced_kl, value_alignment_loss, value_alignment_weight

BATCH, LENGTH, STEPS, WARMUP = 32, 16, 500, 100
# Inputs and outputs of each layer: h has 32 numbers, z 8 classes, the critic 21 bins.
SIZES = {"h": (41, 32), "post": (33, 8), "prior": (32, 8), "obs": (40, 1), "value": (40, 21)}


def sample(key, logits):
    """A one-hot sample with the gradient of the probabilities (straight-through)."""
    probs = jax.nn.softmax(logits)
    one_hot = jax.nn.one_hot(jax.random.categorical(key, logits), logits.shape[-1])
    return one_hot + probs - jax.lax.stop_gradient(probs)


def loss(params, keys, step, warmup_steps):
    """The loss of the model plus L_var, and the value KL."""
    push, slip = jax.random.normal(keys[0, 0], (2, LENGTH, BATCH, 1))
    obs = 0.4 * jnp.cumsum(push + slip, axis=0)
    critic = 5.0 * jax.lax.stop_gradient(params["value"])  # or it would learn to ignore z

    def cell(latent, inputs):
        push, obs, (key_post, key_prior) = inputs
        h = jnp.tanh(jnp.hstack([*latent, push]) @ params["h"])
        post, prior = jnp.hstack([h, obs]) @ params["post"], h @ params["prior"]
        z, z_prior = sample(key_post, post), sample(key_prior, prior)
        error = jnp.square(jnp.hstack([h, z]) @ params["obs"] - obs).sum(-1)
        kl, kl_post = balanced_kl(post[:, None], prior[:, None], unimix=0.01)
        values = jnp.hstack([h, z]) @ critic, jnp.hstack([h, z_prior]) @ critic
        aligned = value_alignment_loss(*values, dynamics_scale=0.5, representation_scale=0.1)
        weight = value_alignment_weight(kl, step, warmup_steps=warmup_steps)
        total = error + kl + 0.1 * kl_post + weight * aligned
        # Both terms of L_var equal the KL in value; they differ in their gradients.
        return (h, z), (total, aligned / 0.6)

    start = jnp.zeros((BATCH, 32)), jnp.zeros((BATCH, 8))
    _, (total, value_kl) = jax.lax.scan(cell, start, (push, obs, keys[1:]))
    return total.mean(), value_kl.mean()


@jax.jit
def train(seed, warmup_steps):
    """Value KL `[STEPS]` over gradient steps, each on new data."""

    def update(params, inputs):
        slope, value_kl = jax.grad(loss, has_aux=True)(params, *inputs, warmup_steps)
        return jax.tree.map(lambda p, g: p - 0.1 * g, params, slope), value_kl

    keys = jax.random.split(jax.random.key(seed), (STEPS + len(SIZES), 1 + LENGTH, 2))
    params = {x: jax.random.normal(keys[~i, 0, 0], SIZES[x]) / 6 for i, x in enumerate(SIZES)}
    return jax.lax.scan(update, params, (keys[:STEPS], jnp.arange(STEPS)))[1]


def main():
    for seed in range(3):
        without, aligned = train(seed, STEPS), train(seed, WARMUP)
        kl = without[0], without[-50:].mean(), aligned[-50:].mean()
        print("seed {}: value KL {:.3f} before, {:.3f} without, {:.3f} with".format(seed, *kl))


if __name__ == "__main__":
    main()
