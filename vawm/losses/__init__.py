"""The losses, arrays in and arrays out: no network, environment or configuration.

Equation numbers are the paper's. Every loss is per element; masks, weights and means are the
caller's.

    prediction_loss, symlog_mse, image_mse, continue_loss     Eq. 3a  what the heads predict
    dynamics_loss, batch_dynamics_loss, balanced_kl           Eq. 3b  prior and posterior
    value_alignment_loss                                      Eq. 4   values under both
    value_alignment_weight                                    Eq. 5   its adaptive weight
    critic_loss                                               Eq. 7   towards lambda-returns
    actor_loss, discount_weights                              Eq. 8   policy gradient

The family of value-aware losses, from the papers that their docstrings name:

    vagram_loss, vagram_taylor_loss                  weighted by the gradient of the value
    vagram_second_order_loss, vagram_joint_loss      and by its Hessian
"""

from vawm.losses.behaviour import actor_loss, critic_loss, discount_weights
from vawm.losses.likelihood import (
    PredictionLoss,
    balanced_kl,
    batch_dynamics_loss,
    continue_loss,
    dynamics_loss,
    image_mse,
    prediction_loss,
    symlog_mse,
)
from vawm.losses.vagram import (
    vagram_joint_loss,
    vagram_loss,
    vagram_second_order_loss,
    vagram_taylor_loss,
)
from vawm.losses.value_alignment import value_alignment_loss, value_alignment_weight

__all__ = [
    "PredictionLoss",
    "actor_loss",
    "balanced_kl",
    "batch_dynamics_loss",
    "continue_loss",
    "critic_loss",
    "discount_weights",
    "dynamics_loss",
    "image_mse",
    "prediction_loss",
    "symlog_mse",
    "vagram_joint_loss",
    "vagram_loss",
    "vagram_second_order_loss",
    "vagram_taylor_loss",
    "value_alignment_loss",
    "value_alignment_weight",
]
