"""The RSSM against a float64 recursion in numpy."""

import jax
import jax.numpy as jnp
import numpy as np
import tiny
from nets_twin import block_gru_twin, float64, layer, noisy

from vawm.types import Batch, EnvSpec, Trajectory, vector
from vawm.world_model.packing import pack
from vawm.world_model.rssm import rssm

CONFIG = tiny.CONFIG.world_model
SPEC = EnvSpec("test", vector(5), 3, False, 2, 1, None)
BATCH, LENGTH = 3, 6


def make(noise="independent"):
    model = rssm(CONFIG, SPEC, noise=noise)
    params, model_state = model.init(jax.random.key(0))
    assert not jax.tree.leaves(model_state)  # nothing is carried
    return model, noisy(params), model_state


def experience():
    keys = jax.random.split(jax.random.key(1), 2)
    obs = 3 * jax.random.normal(keys[0], (BATCH, LENGTH, 5))
    prev_action = 2 * jax.random.normal(keys[1], (BATCH, LENGTH, 3))
    is_first = jnp.zeros((BATCH, LENGTH), bool).at[1, 3].set(True).at[2, 0].set(True)
    return obs, prev_action, is_first


def batch(carry, obs, prev_action, is_first):
    """A `Batch` of these steps after `carry`; of its first step only the action is read."""

    def join(before, x):
        return jnp.concatenate([jnp.full_like(x[:, :1], before), x], axis=1)

    last = jnp.full_like(prev_action[:, :1], 0.5)  # leads beyond the batch
    action = jnp.concatenate([prev_action, last], axis=1)
    reward = join(jnp.nan, obs[..., 0])
    flags = join(True, is_first)
    trajectory = Trajectory(join(jnp.nan, obs), reward, flags, flags, flags, action)
    return Batch(trajectory, pack(carry))


def explain(model, params, model_state, *, key=2):
    """What `model` makes of `experience()`."""
    data = batch(start(model), *experience())
    explanation, after = model.explain(params, model_state, jax.random.key(key), data)
    assert jax.tree.structure(after) == jax.tree.structure(model_state)
    return explanation


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


def test_what_is_inferred_matches_the_recursion_given_its_samples():
    model, params, model_state = make()
    obs, prev_action, is_first = experience()
    inference = explain(model, params, model_state).inference
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


def test_the_heads_read_what_is_inferred_at_the_steps_after_the_first():
    model, params, model_state = make()
    inference, predictions, targets, further = explain(model, params, model_state)
    assert further == {}
    jax.tree.map(
        np.testing.assert_array_equal,
        predictions,
        model.predict(params, model_state, inference.latent),
    )
    obs, _, is_first = experience()
    np.testing.assert_array_equal(targets.obs, obs)
    np.testing.assert_array_equal(targets.reward, obs[..., 0])
    np.testing.assert_array_equal(targets.is_terminal, is_first)


def test_filtering_one_step_is_explaining_a_sequence_of_one():
    model, params, model_state = make()
    one_step = jax.tree.map(lambda x: x[:, 2:3], experience())
    data = batch(start(model), *one_step)
    explanation, _ = model.explain(params, model_state, jax.random.key(2), data)
    now = jax.tree.map(lambda x: x[:, 0], one_step)
    carry, latent = model.filter(params, model_state, jax.random.key(2), start(model), *now)
    expected = jax.tree.map(lambda x: x[:, 0], explanation.inference.latent)
    jax.tree.map(np.testing.assert_array_equal, latent, expected)
    jax.tree.map(np.testing.assert_array_equal, model.memory(carry), pack(latent))
    jax.tree.map(np.testing.assert_array_equal, carry, latent)


def test_filtering_goes_on_from_what_it_remembers():
    model, params, model_state = make()
    inference = explain(model, params, model_state).inference
    carry = start(model)
    for t in range(LENGTH):
        now = jax.tree.map(lambda x, t=t: x[:, t], experience())
        _, latent = model.filter(params, model_state, jax.random.key(t), carry, *now)
        np.testing.assert_allclose(latent.deter, inference.latent.deter[:, t], atol=1e-6)
        carry = jax.tree.map(lambda x, t=t: x[:, t], inference.latent)


def test_prior_and_posterior_share_h_and_are_one_hot():
    model, params, model_state = make()
    inference = explain(model, params, model_state).inference
    np.testing.assert_array_equal(inference.latent.deter, inference.prior_latent.deter)
    for stoch in (inference.latent.stoch, inference.prior_latent.stoch):
        np.testing.assert_array_equal(np.sort(stoch, -1)[..., -1], 1.0)
        np.testing.assert_array_equal(np.sort(stoch, -1)[..., :-1], 0.0)


def test_shared_noise_gives_equal_samples_where_prior_equals_posterior():
    for noise, equal in (("shared", True), ("independent", False)):
        model, params, model_state = make(noise)
        params["rssm"]["posterior_out"] = jax.tree.map(
            jnp.zeros_like, params["rssm"]["posterior_out"]
        )
        prior_out = params["rssm"]["prior_net"]["heads_0"]
        params["rssm"]["prior_net"]["heads_0"] = jax.tree.map(jnp.zeros_like, prior_out)
        inference = explain(model, params, model_state).inference
        same = (inference.latent.stoch == inference.prior_latent.stoch).all()
        assert same == equal


def test_imagination_follows_the_same_recursion_as_observation():
    model, params, model_state = make()
    inference = explain(model, params, model_state).inference
    carry, latent = model.starts(params, model_state, inference)
    assert latent.deter.shape == (BATCH * LENGTH, CONFIG.deter)
    np.testing.assert_array_equal(latent.deter[LENGTH], inference.latent.deter[1, 0])
    np.testing.assert_array_equal(latent.stoch[LENGTH], inference.latent.stoch[1, 0])
    action = jax.random.normal(jax.random.key(4), (BATCH * LENGTH, 3))
    _, after = model.imagine(params, model_state, jax.random.key(5), carry, action)
    np.testing.assert_allclose(after.deter, advanced(params, latent, action), atol=1e-5)


def advanced(params, latent, action):
    """h in float64 after `latent` and `action`."""
    return block_gru_twin(
        float64(params["rssm"]["gru"]),
        *float64((latent.deter,)),
        np.asarray(latent.stoch, np.float64).reshape(len(action), -1),
        np.asarray(action, np.float64),
        CONFIG.blocks,
    )


def test_following_infers_and_then_predicts_what_the_last_action_leads_to():
    model, params, model_state = make()
    data = batch(start(model), *experience())
    inferred, (carry, latent) = model.follow(
        params, model_state, jax.random.key(2), data, horizon=3
    )
    key = jax.random.split(jax.random.key(2))[0]
    explanation, _ = model.explain(params, model_state, key, data)
    jax.tree.map(np.testing.assert_array_equal, inferred, explanation.inference.latent)
    last, action = jax.tree.map(lambda x: x[:, -1], (inferred, data.trajectory.action))
    np.testing.assert_allclose(latent.deter, advanced(params, last, action), atol=1e-5)
    _, after = model.imagine(params, model_state, jax.random.key(3), carry, action)
    np.testing.assert_allclose(after.deter, advanced(params, latent, action), atol=1e-5)


def test_imagination_starts_carry_no_gradient():
    model, params, model_state = make()

    def loss(params):
        inference = explain(model, params, model_state).inference
        _, latent = model.starts(params, model_state, inference)
        return latent.deter.sum() + (latent.stoch**2).sum()

    gradient = jax.grad(loss)(params)
    assert all((g == 0).all() for g in jax.tree.leaves(gradient))


def test_a_zero_initialised_reward_head_predicts_the_same_logits_everywhere():
    model = rssm(CONFIG, SPEC)
    params, model_state = model.init(jax.random.key(0))
    latent = start(model)
    predictions = model.predict(params, model_state, latent)
    np.testing.assert_array_equal(predictions.reward, 0.0)
    assert predictions.obs.shape == (BATCH, 5)
    assert predictions.cont.shape == (BATCH,)
    assert (predictions.cont != 0).any()


def test_jit_equals_eager():
    model, params, model_state = make()

    def infer(params):
        return explain(model, params, model_state)

    eager, jitted = infer(params), jax.jit(infer)(params)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-5), eager, jitted)


def test_bfloat16_products_keep_float32_parameters_and_logits():
    model = rssm(CONFIG, SPEC, dtype=jnp.bfloat16)
    params, model_state = model.init(jax.random.key(0))
    assert all(x.dtype == jnp.float32 for x in jax.tree.leaves(params))
    carry = model.initial(BATCH)
    explanation, _ = model.explain(
        params, model_state, jax.random.key(2), batch(carry, *experience())
    )
    inference, predictions = explanation.inference, explanation.predictions
    now = jax.tree.map(lambda x: x[:, 0], experience())
    carry, _ = model.filter(params, model_state, jax.random.key(2), carry, *now)
    for latent in (carry, inference.latent, inference.prior_latent):
        assert latent.deter.dtype == latent.stoch.dtype == jnp.bfloat16
    assert all(x.dtype == jnp.float32 for x in jax.tree.leaves(predictions))
    assert inference.post_logits.dtype == inference.prior_logits.dtype == jnp.float32
