"""A miniature `TrainState`, for tests of code that runs on the host."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from vawm.types import EnvSpec, Params, vector

SPEC = EnvSpec("toy", vector(3), 1, False, 2, 1, None)


class Learner(NamedTuple):
    params: Params
    opt_state: Any
    model_state: Any = ()


class State(NamedTuple):
    learner: Learner
    replay: Any
    key: jax.Array
    env_steps: jax.Array
    collector: Any = ()


def state(seed=0, width=3):
    """A state with every kind of leaf that a checkpoint can hold."""
    rng = np.random.default_rng(seed)

    def normal(*shape):
        return jnp.asarray(rng.normal(size=shape), jnp.float32)

    params = Params(
        world_model={"a/b": {"kernel": normal(2, width)}, "scale": normal(width)},
        actor={"bias": normal(1)},
        critic={"bias": normal(1)},
    )
    return State(
        learner=Learner(params, opt_state=(normal(4).astype(jnp.bfloat16), jnp.int32(seed))),
        replay={
            "image": jnp.asarray(rng.integers(0, 255, (2, 4)), jnp.uint8),
            "flag": jnp.array([True, False]),
            "empty": jnp.zeros((2, 0)),
            "nan": jnp.array([jnp.nan, jnp.inf]),
        },
        key=jax.random.split(jax.random.key(seed), 2),
        env_steps=jnp.zeros((), jnp.int32),
    )


def assert_equal(actual, expected):
    """Compares bit for bit: structure, shapes, dtypes and values, keys and NaN included."""
    assert jax.tree.structure(actual) == jax.tree.structure(expected)
    for (path, a), e in zip(
        jax.tree_util.tree_leaves_with_path(actual), jax.tree.leaves(expected), strict=True
    ):
        assert (a.shape, a.dtype) == (e.shape, e.dtype), path
        assert plain(a).tobytes() == plain(e).tobytes(), path


def plain(leaf):
    if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key):
        leaf = jax.random.key_data(leaf)
    return np.asarray(leaf)
