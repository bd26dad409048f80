"""Latents as replay keeps them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from vawm.types import Latent
from vawm.world_model.packing import pack, unpack


@pytest.mark.parametrize("classes", [2, 4, 256])
@pytest.mark.parametrize("dtype", [jnp.float32, jnp.bfloat16])
def test_packing_is_exact_and_keeps_the_dtype(classes, dtype):
    index = jax.random.randint(jax.random.key(0), (3, 5, 7), 0, classes)
    deter = jax.random.normal(jax.random.key(1), (3, 5, 2)).astype(dtype)
    latent = Latent(deter, jax.nn.one_hot(index, classes, dtype=dtype))
    packed = pack(latent)
    assert packed.stoch.dtype == jnp.uint8
    np.testing.assert_array_equal(packed.stoch, index)
    again = unpack(packed, classes)
    assert again.stoch.dtype == dtype
    jax.tree.map(np.testing.assert_array_equal, again, latent)
