"""Learners for computing losses, without a state of an optimiser."""

import jax.numpy as jnp

from vawm.learning.state import Learner
from vawm.losses import returns


def learner(params, *, model_state=(), slow_critic=None, return_scale=None, step=0):
    """A learner with these `params`; the slow critic is by default the critic itself."""
    return Learner(
        step=jnp.asarray(step),
        params=params,
        model_state=model_state,
        slow_critic=params.critic if slow_critic is None else slow_critic,
        opt_state=(),
        return_scale=returns.init_return_scale() if return_scale is None else return_scale,
    )
