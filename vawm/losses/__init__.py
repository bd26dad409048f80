"""Losses as functions of arrays, without networks, environments or configuration.

Losses are per element; the caller applies masks, weights and means. Exceptions, where they are
part of the definition: `batch_dynamics_loss`, losses along an unrolled model, and TEMPO. Losses
that need derivatives of a model or a critic take it as a function. Equation numbers are the
paper's.

    prediction_loss, symlog_mse, image_mse, continue_loss     Eq. 3a  predictions of the heads
    dynamics_loss, batch_dynamics_loss, balanced_kl           Eq. 3b  prior and posterior
    value_alignment_loss                                      Eq. 4   values under both
    value_alignment_weight                                    Eq. 5   its adaptive weight
    critic_loss                                               Eq. 7   lambda-returns
    actor_loss, discount_weights                              Eq. 8   policy gradient

Their parts, from `vawm.losses.returns` and `vawm.losses.transforms`:

    lambda_returns, replay_returns                            Eq. 7   targets of the critic
    ReturnScale, init_return_scale, update_return_scale, return_scale
                                                              Eq. 9   units of the advantage
    make_two_hot, two_hot_cross_entropy, categorical_kl, symlog, symexp

The value-aware family:

    vaml_loss                               VAML      error of the worst critic
    iter_vaml_loss                          IterVAML  squared error of the mean value
    categorical_iter_vaml_loss              MAD-TD    cross-entropy of value distributions
    cvaml_loss                              CVAML     squared error without sampling bias
    vagram_loss                             VaGraM    errors weighted by the value's gradient
    vagram_taylor_loss                                the first-order error that it bounds
    vagram_second_order_loss, vagram_joint_loss       with the value's curvature
    lambda_ac_loss, latent_consistency_loss lambda-AC IterVAML over several steps in latents
    muzero_value_loss, n_step_returns, scale_gradient
                                            MuZero    model and critic, towards returns
    tempo_meta_gradient                     TEMPO     weights of the samples of a likelihood

The caller stops the critic's parameters, except for `muzero_value_loss`, which trains the
critic, and `tempo_meta_gradient`, which differentiates only with respect to the weights.

References. Equation numbers are those of the value-alignment paper; equations of the methods
below are in our notation, not as printed there.

    Farahmand et al., 2017      Value-Aware Loss Function for Model-based Reinforcement Learning
    Farahmand, 2018             Iterative Value-Aware Model Learning
    Schrittwieser et al., 2020  Mastering Atari, Go, chess and shogi by planning with a learned
                                model
    Voelcker et al., 2022       Value Gradient weighted Model-Based Reinforcement Learning
    Voelcker et al., 2023       lambda-models: Effective Decision-Aware Reinforcement Learning
                                with Latent Models, arXiv 2306.17366
    Yuan et al., 2023           Task-aware world model learning with meta weighting via bi-level
                                optimization
    Hafner et al., 2025         Mastering diverse control tasks through world models
    Voelcker et al., 2025a      MAD-TD: Model-Augmented Data stabilizes High Update Ratio RL,
                                arXiv 2410.08896
    Voelcker et al., 2025b      Calibrated Value-Aware Model Learning with Probabilistic
                                Environment Models, arXiv 2505.22772
"""

from .behaviour import actor_loss, critic_loss, discount_weights
from .likelihood import (
    PredictionLoss,
    balanced_kl,
    batch_dynamics_loss,
    continue_loss,
    dynamics_loss,
    image_mse,
    prediction_loss,
    symlog_mse,
)
from .multi_step import (
    lambda_ac_loss,
    latent_consistency_loss,
    muzero_value_loss,
    n_step_returns,
    scale_gradient,
)
from .returns import (
    ReturnScale,
    init_return_scale,
    lambda_returns,
    replay_returns,
    return_scale,
    update_return_scale,
)
from .tempo import tempo_meta_gradient
from .transforms import (
    categorical_kl,
    make_two_hot,
    symexp,
    symlog,
    two_hot_cross_entropy,
)
from .vagram import (
    vagram_joint_loss,
    vagram_loss,
    vagram_second_order_loss,
    vagram_taylor_loss,
)
from .value_alignment import value_alignment_loss, value_alignment_weight
from .value_aware import (
    categorical_iter_vaml_loss,
    cvaml_loss,
    iter_vaml_loss,
    vaml_loss,
)

__all__ = [
    "PredictionLoss",
    "ReturnScale",
    "actor_loss",
    "balanced_kl",
    "batch_dynamics_loss",
    "categorical_iter_vaml_loss",
    "categorical_kl",
    "continue_loss",
    "critic_loss",
    "cvaml_loss",
    "discount_weights",
    "dynamics_loss",
    "image_mse",
    "init_return_scale",
    "iter_vaml_loss",
    "lambda_ac_loss",
    "lambda_returns",
    "latent_consistency_loss",
    "make_two_hot",
    "muzero_value_loss",
    "n_step_returns",
    "prediction_loss",
    "replay_returns",
    "return_scale",
    "scale_gradient",
    "symexp",
    "symlog",
    "symlog_mse",
    "tempo_meta_gradient",
    "two_hot_cross_entropy",
    "update_return_scale",
    "vagram_joint_loss",
    "vagram_loss",
    "vagram_second_order_loss",
    "vagram_taylor_loss",
    "value_alignment_loss",
    "value_alignment_weight",
    "vaml_loss",
]
