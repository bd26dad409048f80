"""The RSSM against a float64 recursion in numpy."""

import jax
import jax.numpy as jnp
import numpy as np
import tiny
from test_nets import block_gru_twin, float64, layer, noisy

from vawm.types import EnvSpec, Trajectory, vector
from vawm.world_model.rssm import rssm

CONFIG = tiny.CONFIG.world_model
SPEC = EnvSpec("test", vector(5), 3, False, 2, 1, None)
BATCH, LENGTH = 3, 6


def make(noise="independent"):
    model = rssm(CONFIG, SPEC, noise=noise)
    return model, noisy(model.init(jax.random.key(0)))


def experience():
    keys = jax.random.split(jax.random.key(1), 2)
    obs = 3 * jax.random.normal(keys[0], (BATCH, LENGTH, 5))
    prev_action = 2 * jax.random.normal(keys[1], (BATCH, LENGTH, 3))
    is_first = jnp.zeros((BATCH, LENGTH), bool).at[1, 3].set(True).at[2, 0].set(True)
    return obs, prev_action, is_first


def start(model):
    carry = model.initial(BATCH)
    stoch = jax.nn.one_hot(jnp.full(carry.stoch.shape[:-1], 1), CONFIG.classes)
    return carry._replace(deter=carry.deter + 0.3, stoch=stoch)


def symlog(x):
    return np.sign(x) * np.log1p(np.abs(x))


def mlp(params, x):
    hidden = sorted(name for name in params if name.startswith("hidden"))
    for name in hidden:
        x = layer(params[name], x)
    if "heads_0" in params:
        x = x @ params["heads_0"]["kernel"] + params["heads_0"]["bias"]
    return x


def logits(params, x):
    return x.reshape(*x.shape[:-1], CONFIG.stoch, CONFIG.classes)


def test_observe_matches_the_recursion_given_its_samples():
    model, params = make()
    obs, prev_action, is_first = experience()
    carry, inference = model.observe(
        params, jax.random.key(2), start(model), obs, prev_action, is_first, train=True
    )
    p, rssm_p = float64(params), float64(params["rssm"])
    tokens = mlp(p["encoder"]["vector"], symlog(np.asarray(obs, np.float64)))
    deter, stoch = (np.asarray(x, np.float64) for x in start(model))
    for t in range(LENGTH):
        keep = 1.0 - np.asarray(is_first)[:, t, None]
        action = np.asarray(prev_action, np.float64)[:, t] * keep
        flat = stoch.reshape(BATCH, -1) * keep
        deter = block_gru_twin(rssm_p["gru"], deter * keep, flat, action, CONFIG.blocks)
        np.testing.assert_allclose(inference.latent.deter[:, t], deter, atol=1e-5)
        hidden = layer(rssm_p["posterior_layer"], np.concatenate([deter, tokens[:, t]], -1))
        out = rssm_p["posterior_out"]
        post = logits(p, hidden @ out["kernel"] + out["bias"])
        np.testing.assert_allclose(inference.post_logits[:, t], post, atol=1e-5)
        prior = logits(p, mlp(rssm_p["prior_net"], deter))
        np.testing.assert_allclose(inference.prior_logits[:, t], prior, atol=1e-5)
        stoch = np.asarray(inference.latent.stoch, np.float64)[:, t]
    np.testing.assert_array_equal(carry.deter, inference.latent.deter[:, -1])
    np.testing.assert_array_equal(carry.stoch, inference.latent.stoch[:, -1])
    assert inference.has_prior.all()


def test_prior_and_posterior_share_h_and_are_one_hot():
    model, params = make()
    _, inference = model.observe(
        params, jax.random.key(2), start(model), *experience(), train=True
    )
    np.testing.assert_array_equal(inference.latent.deter, inference.prior_latent.deter)
    for stoch in (inference.latent.stoch, inference.prior_latent.stoch):
        np.testing.assert_array_equal(np.sort(stoch, -1)[..., -1], 1.0)
        np.testing.assert_array_equal(np.sort(stoch, -1)[..., :-1], 0.0)


def test_shared_noise_gives_equal_samples_where_prior_equals_posterior():
    for noise, equal in (("shared", True), ("independent", False)):
        model, params = make(noise)
        params["rssm"]["posterior_out"] = jax.tree.map(
            jnp.zeros_like, params["rssm"]["posterior_out"]
        )
        prior_out = params["rssm"]["prior_net"]["heads_0"]
        params["rssm"]["prior_net"]["heads_0"] = jax.tree.map(jnp.zeros_like, prior_out)
        _, inference = model.observe(
            params, jax.random.key(2), start(model), *experience(), train=True
        )
        same = (inference.latent.stoch == inference.prior_latent.stoch).all()
        assert same == equal


def test_imagination_follows_the_same_recursion_as_observation():
    model, params = make()
    obs, prev_action, is_first = experience()
    _, inference = model.observe(
        params, jax.random.key(2), start(model), obs, prev_action, is_first, train=True
    )
    trajectory = Trajectory(obs, *[is_first] * 4, prev_action)
    carry, latent = model.starts(params, jax.random.key(3), trajectory, inference)
    assert latent.deter.shape == (BATCH * LENGTH, CONFIG.deter)
    np.testing.assert_array_equal(latent.deter[LENGTH], inference.latent.deter[1, 0])
    action = jax.random.normal(jax.random.key(4), (BATCH * LENGTH, 3))
    _, after = model.imagine(params, jax.random.key(5), carry, action)
    flat = np.asarray(latent.stoch, np.float64).reshape(BATCH * LENGTH, -1)
    expected = block_gru_twin(
        float64(params["rssm"]["gru"]),
        *float64((latent.deter,)),
        flat,
        np.asarray(action, np.float64),
        CONFIG.blocks,
    )
    np.testing.assert_allclose(after.deter, expected, atol=1e-5)


def test_imagination_starts_carry_no_gradient():
    model, params = make()
    obs, prev_action, is_first = experience()

    def loss(params):
        _, inference = model.observe(
            params, jax.random.key(2), start(model), obs, prev_action, is_first, train=True
        )
        trajectory = Trajectory(obs, *[is_first] * 4, prev_action)
        _, latent = model.starts(params, jax.random.key(3), trajectory, inference)
        return latent.deter.sum() + (latent.stoch**2).sum()

    gradient = jax.grad(loss)(params)
    assert all((g == 0).all() for g in jax.tree.leaves(gradient))


def test_a_zero_initialised_reward_head_predicts_the_same_logits_everywhere():
    model = rssm(CONFIG, SPEC)
    params = model.init(jax.random.key(0))
    latent = start(model)
    predictions = model.predict(params, latent)
    np.testing.assert_array_equal(predictions.reward, 0.0)
    assert predictions.obs.shape == (BATCH, 5)
    assert predictions.cont.shape == (BATCH,)
    assert (predictions.cont != 0).any()


def test_jit_equals_eager():
    model, params = make()

    def infer(params):
        return model.observe(params, jax.random.key(2), start(model), *experience(), train=True)

    eager, jitted = infer(params), jax.jit(infer)(params)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-5), eager, jitted)


def test_bfloat16_products_keep_float32_parameters_and_logits():
    model = rssm(CONFIG, SPEC, dtype=jnp.bfloat16)
    params = model.init(jax.random.key(0))
    assert all(x.dtype == jnp.float32 for x in jax.tree.leaves(params))
    carry, inference = model.observe(
        params, jax.random.key(2), model.initial(BATCH), *experience(), train=True
    )
    assert carry.deter.dtype == carry.stoch.dtype == jnp.bfloat16
    assert inference.post_logits.dtype == inference.prior_logits.dtype == jnp.float32
