"""VaGraM on latents: errors of the prior, weighted by how much the value depends on them."""

from __future__ import annotations

from collections.abc import Callable

import jax

from vawm import losses
from vawm.agent.actor_critic import Critic
from vawm.config import VagramConfig
from vawm.losses import transforms
from vawm.nets import distributions
from vawm.types import Array, Inference, Latent, PyTree, flat_stoch

FORMS = {
    "diagonal": losses.vagram_loss,
    "taylor": losses.vagram_taylor_loss,
    "second_order": losses.vagram_second_order_loss,
    "joint": losses.vagram_joint_loss,
}
"""Each `value_gradient_form` and its loss."""


def make_value_gradient_loss(
    critic: Critic, config: VagramConfig
) -> Callable[[PyTree, PyTree, Inference], Array]:
    """Build `value_gradient_loss(critic_params, slow_critic_params, inference) -> [B, T]`.

        L = scale * sum_j (dV/dz_j)^2 (z~_j - sg z_j)^2,    dV/dz at (h_t, z_t)

    (Voelcker et al., 2022, on latents: our reading), or another form of `vawm.losses.vagram`.
    z and z~ are the probabilities of the posterior and the prior, after unimix. V is the
    critic's mean, or its symlog. Each categorical of z sums to 1, so dV/dz is defined only up
    to a constant per categorical. We take the gradient, and the Hessian, with mean 0 over the
    classes, so that a critic that ignores z gives no loss.

    Gradients reach the world model through z~: the prior, and through the prior h_t. The
    parameters of both critics are stopped, and so are h_t and z where V is differentiated.
    """
    form = FORMS[config.value_gradient_form]

    def value_of(params: PyTree, deter: Array) -> Callable[[Array], Array]:
        def value(z: Array) -> Array:
            stoch = z.reshape(*z.shape[:-1], config.stoch, config.classes)
            stoch = distributions.on_simplex(stoch).astype(deter.dtype)
            mean = critic.code.mean(critic.logits(params, Latent(deter, stoch)))
            return transforms.symlog(mean) if config.value_gradient_unit == "symlog" else mean

        return value

    def probabilities(logits: Array) -> Array:
        return flat_stoch(distributions.probabilities(logits, unimix=config.unimix))

    def value_gradient_loss(online: PyTree, slow: PyTree, inference: Inference) -> Array:
        target = probabilities(inference.post_logits)
        prediction = probabilities(inference.prior_logits)
        deter = jax.lax.stop_gradient(inference.latent.deter)

        def loss(params: PyTree) -> Array:
            value = value_of(jax.lax.stop_gradient(params), deter)
            return config.value_gradient_scale * form(value, prediction, target)

        if config.value_gradient_critic == "both":
            return (loss(online) + loss(slow)) / 2
        return loss(online if config.value_gradient_critic == "online" else slow)

    return value_gradient_loss
