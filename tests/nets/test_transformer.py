"""STORM's layers: one step from a cache against the whole sequence, dropout, initial values."""

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from nets_twin import float64, noisy

from vawm import nets
from vawm.nets import transformer
from vawm.nets.relu import uniform_in

WIDTH, HEADS, POSITIONS = 8, 2, 9
NET = nets.Transformer(WIDTH, HEADS, 12, 2, POSITIONS, dropout=0.5)
BATCH, LENGTH = 3, 7


def sequence(seed=1):
    return jax.random.normal(jax.random.key(seed), (BATCH, LENGTH, WIDTH))


def make():
    variables = NET.init(jax.random.key(0), sequence(), nets.causal(LENGTH))
    return {"params": noisy(variables["params"])}


@pytest.mark.parametrize("seen", [1, 4])
def test_one_step_at_a_time_from_a_cache_equals_the_whole_sequence(seen):
    variables, x = make(), sequence()
    whole, _, _ = NET.apply(variables, x, nets.causal(LENGTH))
    _, keys, values = NET.apply(variables, x[:, :seen], nets.causal(seen))
    visible = jnp.ones((BATCH, seen), bool)
    cache = nets.fill(keys, values, visible, slots=LENGTH)
    step = jax.jit(lambda x, cache: NET.apply(variables, x, cache, method="step"))
    for t in range(seen, LENGTH):
        y, cache = step(x[:, t], cache)
        np.testing.assert_allclose(y, whole[:, t], atol=1e-5)
    assert cache.length == LENGTH


def cached(length, seed=2):
    rng = np.random.default_rng(seed)
    slots, count, size = 6, 5, 4
    query = rng.normal(size=(count, HEADS, size))
    keys, values = rng.normal(size=(2, slots, count, HEADS, size))
    visible = rng.random((slots, count)) < 0.6
    visible[0] = True
    return query, keys, values, visible, length


def slow_attention(query, keys, values, visible, length):
    """Attention by loops, in float64."""
    mixed = np.zeros_like(query)
    for n, head in np.ndindex(query.shape[:2]):
        seen = [s for s in range(length) if visible[s, n]]
        scores = [keys[s, n, head] @ query[n, head] / np.sqrt(query.shape[-1]) for s in seen]
        weights = np.exp(scores) / np.exp(scores).sum()
        mixed[n, head] = weights @ values[seen, n, head]
    return mixed


@pytest.mark.parametrize("length", [1, 4, 6])
@pytest.mark.parametrize("attend", ["attend_at_once", "attend_slot_by_slot"])
def test_cached_attention_reads_the_visible_slots_in_use_and_no_others(attend, length):
    arguments = cached(length)
    actual = jax.jit(getattr(transformer, attend))(
        *(jnp.asarray(x, jnp.float32) for x in arguments[:3]),
        jnp.asarray(arguments[3]),
        jnp.asarray(length),
    )
    np.testing.assert_allclose(actual, slow_attention(*arguments), atol=1e-6)


def test_large_scores_do_not_overflow():
    query, keys, values, visible, length = cached(6)
    arguments = [jnp.asarray(x, jnp.float32) for x in (300 * query, keys, values)]
    both = [
        attend(*arguments, jnp.asarray(visible), jnp.asarray(length))
        for attend in (transformer.attend_at_once, transformer.attend_slot_by_slot)
    ]
    assert all(np.isfinite(x).all() for x in both)
    np.testing.assert_allclose(*both, atol=1e-4)


def test_a_sequence_longer_than_there_are_positions_is_refused():
    x = jnp.zeros((1, POSITIONS + 1, WIDTH))
    with pytest.raises(ValueError, match=r"10 .*9"):
        NET.init(jax.random.key(0), x, nets.causal(POSITIONS + 1))


def test_dropout_is_applied_only_if_not_deterministic():
    variables, x = make(), sequence()

    def run(key, deterministic):
        rngs = {"dropout": jax.random.key(key)}
        return NET.apply(variables, x, nets.causal(LENGTH), deterministic, rngs=rngs)[0]

    np.testing.assert_array_equal(run(0, True), run(1, True))
    assert (run(0, False) != run(1, False)).any()


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.bfloat16])
def test_layer_norm_equals_its_formula(dtype):
    x = (5 + 3 * jax.random.normal(jax.random.key(0), (4, 6))).astype(dtype)
    norm = nets.LayerNorm(6)
    params = noisy(norm.init(jax.random.key(1), x)["params"])
    y = norm.apply({"params": params}, x)
    p, wide = float64(params), np.asarray(x, np.float64)
    centred = wide - wide.mean(-1, keepdims=True)
    expected = centred / np.sqrt((centred**2).mean(-1, keepdims=True) + 1e-5)
    tolerance = 1e-5 if dtype == jnp.float32 else 0.05
    np.testing.assert_allclose(
        np.asarray(y, np.float64), expected * p["scale"] + p["bias"], atol=tolerance
    )
    assert y.dtype == dtype


def test_relu_layers_equal_their_formula_and_take_concatenations_in_parts():
    net = nets.ReluMLP(5, layers=2, units=4, outputs=(3, 2))
    x = jax.random.normal(jax.random.key(0), (7, 5))
    params = noisy(net.init(jax.random.key(1), x)["params"])
    whole, parts = (
        net.apply({"params": params}, *inputs) for inputs in ((x,), (x[:, :2], x[:, 2:]))
    )
    p, y = float64(params), np.asarray(x, np.float64)
    for i in range(2):
        assert "bias" not in p[f"hidden_{i}"]
        y = y @ p[f"hidden_{i}"]["kernel"]
        y = y - y.mean(-1, keepdims=True)
        y = y / np.sqrt((y**2).mean(-1, keepdims=True) + 1e-5)
        y = np.maximum(y * p[f"norm_{i}"]["scale"] + p[f"norm_{i}"]["bias"], 0)
    for i, (a, b) in enumerate(zip(whole, parts, strict=True)):
        expected = y @ p[f"heads_{i}"]["kernel"] + p[f"heads_{i}"]["bias"]
        np.testing.assert_allclose(a, expected, atol=1e-5)
        np.testing.assert_allclose(a, b, atol=1e-6)
    with pytest.raises(ValueError, match="takes 5 features, got 4"):
        net.apply({"params": params}, x[:, :4])


def test_initial_values_are_uniform_within_one_over_the_root_of_the_inputs():
    values = uniform_in(16)(jax.random.key(0), (16, 1000))
    assert np.abs(values).max() == pytest.approx(0.25, rel=0.01)
    assert float(values.std()) == pytest.approx(0.25 / np.sqrt(3), rel=0.02)


def test_dropout_is_on_attention_on_its_output_and_on_the_feed_forward():
    variables, x, seen, inside = make(), sequence(), [], []

    def spy(run, args, kwargs, context):
        if not isinstance(context.module, nn.Dropout) or context.method_name != "__call__":
            return run(*args, **kwargs)
        inside.append(context.module)
        y = run(*args, **kwargs)
        inside.pop()
        if not inside:  # our class calls that of Flax
            seen.append((args[0].shape, np.asarray((y == 0) & (args[0] != 0))))
        return y

    with nn.intercept_methods(spy):
        key = {"dropout": jax.random.key(0)}
        NET.apply(variables, x, nets.causal(LENGTH), deterministic=False, rngs=key)
    weights, outputs = (BATCH, HEADS, LENGTH, LENGTH), (BATCH, LENGTH, WIDTH)
    assert [shape for shape, _ in seen] == 2 * [weights, outputs, outputs]
    assert all(0.2 < hit.mean() < 0.6 for _, hit in seen)
    assert (seen[1][1] != seen[2][1]).any()
    assert (seen[1][1] != seen[4][1]).any()
