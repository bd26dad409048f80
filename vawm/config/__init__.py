"""Every choice of a run, as frozen dataclasses; `vawm.config.presets` has sets of
values.

Numbers are those of the paper, Table 15 for DreamerV3 and Tables 7-14 for STORM, unless their
comment names another source. Nothing here imports the rest of the package. Factories read
these; losses only ever receive numbers.
"""

from __future__ import annotations

import dataclasses
import functools
import typing
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal, NamedTuple

Network = Literal["dreamerv3", "storm"]
"""Hidden layers. dreamerv3: bias, RMSNorm, SiLU; storm: no bias, LayerNorm, ReLU."""
Bins = Literal["symexp", "symlog"]
"""Bins of a two-hot code: values spaced by symexp, or evenly spaced values of symlog."""


@dataclass(frozen=True)
class WorldModelConfig:
    """What every world model has. Derive the config of your own world model from this."""

    deter: int
    """width of h"""
    stoch: int
    """number of categoricals in z"""
    classes: int
    """classes of each categorical"""
    units: int
    """width of the hidden layers of encoder, decoder, reward and continue heads"""
    depth: int = 16
    """scales the channels of the image encoder and decoder"""
    bins: int = 255
    """bins of the two-hot reward"""
    bin_spacing: Bins = "symexp"
    """symexp: values spaced by symexp; symlog: evenly spaced symlogs, whose mean is decoded"""
    unimix: float = 0.01
    """uniform share mixed into prior and posterior"""
    free_nats: float = 1.0
    """KL below which the dynamics loss has no gradient"""
    free_nats_of: Literal["state", "batch"] = "state"
    """state: applies to the KL of each state; batch: to the mean KL of the batch, so that below
    it no state has a gradient"""
    continue_target: Literal["discounted", "plain"] = "discounted"
    """target of the continue head inside an episode: gamma (discounted) or 1 (plain)"""
    reconstruction_scale: float = 1.0
    """weight of the reconstruction loss"""
    dynamics_scale: float = 1.0
    """weight of KL[sg q || p], which trains the prior"""
    representation_scale: float = 0.1
    """weight of KL[q || sg p], which trains the posterior"""


@dataclass(frozen=True)
class HeadsConfig(WorldModelConfig):
    """A world model with the encoder, decoder, reward and continue heads of DreamerV3."""

    encoder_layers: int = 3
    """hidden layers of the encoder of vectors"""
    decoder_layers: int = 3
    """hidden layers of the decoder of vectors"""
    reward_layers: int = 1
    """hidden layers of the reward head"""
    continue_layers: int = 1
    """hidden layers of the continue head"""
    blocks: int = 8
    """blocks of the layer that the image decoder starts with; of an RSSM also of its GRU"""


@dataclass(frozen=True)
class RSSMConfig(HeadsConfig):
    """RSSM of DreamerV3 with block GRU; widths default to size 12m."""

    deter: int = 2048
    stoch: int = 32
    classes: int = 16
    units: int = 256
    depth: int = 16
    """the stages of the image encoder have 2, 3, 4 and 4 times this many channels"""
    hidden: int = 256
    """width of the layers around h"""
    prior_layers: int = 2
    """hidden layers from h to the prior"""
    reconstruction_gradient: bool = True
    """whether the reconstruction loss trains the latents, or the decoder alone"""


@dataclass(frozen=True)
class VagramConfig(RSSMConfig):
    """A deterministic RSSM trained by the value's gradient (VaGraM) instead of the KL.

    z holds probabilities instead of samples. VaGraM trains the prior. VaGraM, the reward,
    continue and replay value losses train the latents.
    """

    dynamics_scale: float = 0.0
    """of the KL, off because VaGraM replaces it"""
    representation_scale: float = 0.0
    """of the KL, off because VaGraM replaces it"""
    reconstruction_gradient: bool = False
    value_gradient_scale: float = 1.0
    """weight of VaGraM's loss"""
    value_gradient_form: Literal["diagonal", "taylor", "second_order", "joint"] = "diagonal"
    """of the error e = z~ - z. diagonal: sum_j (dV/dz_j e_j)^2, the official form; taylor:
    (dV/dz . e)^2; second_order and joint: taylor and diagonal with the Hessian of V"""
    value_gradient_critic: Literal["online", "slow", "both"] = "both"
    """which critic's gradient; both: the mean of two losses, as in the official code"""
    value_gradient_unit: Literal["symlog", "raw"] = "symlog"
    """symlog: gradient of symlog V, which does not grow with the scale of rewards; raw: of V"""


@dataclass(frozen=True)
class StormConfig(WorldModelConfig):
    """The transformer world model of STORM: Tables 7-14, else the official code."""

    deter: int = 512
    """width of the transformer, whose output is h"""
    stoch: int = 32
    classes: int = 32
    units: int = 512
    depth: int = 32
    """the stages of the image encoder have 1, 2, 4 and 8 times this many channels"""
    bin_spacing: Bins = "symlog"
    free_nats_of: Literal["state", "batch"] = "batch"
    """batch: as the official code; state: as DreamerV3"""
    continue_target: Literal["discounted", "plain"] = "plain"
    dynamics_scale: float = 0.5
    blocks: int = 2
    """transformer blocks"""
    heads: int = 8
    """attention heads of a block"""
    feedforward: int = 1024
    """hidden width of a block's feed-forward layer"""
    dropout: float = 0.1
    """share of activations that training sets to 0 in the transformer"""
    positions: int = 64
    """number of learned positions; no sequence can be longer"""
    vector_layers: int = 2
    """hidden layers of the encoder and decoder of vectors; the paper uses images only"""
    head_layers: int = 2
    """hidden layers of the reward and continue heads"""
    act_context: int = 16
    """steps that the agent remembers while it acts"""
    act_latent: Literal["prior", "posterior"] = "prior"
    """prior: the policy reads the prediction made before the observation arrives, as in the
    official code; posterior: it reads the latent inferred from the observation"""
    clear_context: bool = False
    """whether attention stops at the start of an episode, in training, imagination and acting;
    in the official code it does not"""


@dataclass(frozen=True)
class ActorConfig:
    layers: int = 3
    """hidden layers"""
    units: int = 256
    """width of the hidden layers"""
    network: Network = "dreamerv3"
    """hidden layers. dreamerv3: bias, RMSNorm, SiLU; storm: no bias, LayerNorm, ReLU"""
    unimix: float = 0.01
    """uniform share mixed into a discrete policy"""
    min_std: float = 0.1
    """smallest standard deviation of a continuous policy"""
    max_std: float = 1.0
    """largest standard deviation of a continuous policy"""
    scale: float = 1.0
    """weight of the actor's loss"""
    entropy_scale: float = 1e-3
    """Table 15; public DreamerV3 codes use 3e-4"""
    collect_temperature: float = 1.0
    """divides the logits of a discrete policy while it collects, never in a loss; IRIS and the
    paper use 0.01 on Freeway"""


@dataclass(frozen=True)
class CriticConfig:
    layers: int = 3
    """hidden layers"""
    units: int = 256
    """width of the hidden layers"""
    network: Network = "dreamerv3"
    """hidden layers, as for the actor; dreamerv3 initially predicts 0, storm does not"""
    bins: int = 255
    """bins of the two-hot value"""
    bin_spacing: Bins = "symexp"
    """symexp: values spaced by symexp; symlog: evenly spaced symlogs, whose mean is decoded"""
    scale: float = 1.0
    """weight of the critic's loss on imagined states"""
    slow_rate: float = 0.02
    """1 - EMA decay of the slow critic"""
    slow_scale: float = 1.0
    """weight of the slow critic's target"""
    slow_target: Literal["value", "returns"] = "value"
    """second target. value: the slow critic's value, as in DreamerV3; returns: lambda-returns
    of its values, as in STORM's official code"""
    replay_scale: float = 0.3
    """weight of the replay value loss"""
    replay_gradient: bool = True
    """whether the replay value loss trains the world model, as in the official code"""


@dataclass(frozen=True)
class ImaginationConfig:
    horizon: int = 15
    """imagined steps"""
    starts: Literal["posteriors", "contexts"] = "posteriors"
    """posteriors: imagination starts at every inferred state of the batch; contexts: at the
    states predicted after separately drawn contexts"""
    batch_size: int = 1024
    """contexts drawn for one update"""
    context_length: int = 8
    """steps of a context"""
    value_index: Literal["next", "current"] = "next"
    """lambda-returns mix in the value of s_{t+1} (next, Eq. 7) or of s_t (current, STORM's
    official code)"""
    continuation: Literal["probability", "threshold"] = "probability"
    """how the continue head is read: as its probability, or as 0 below one half and 1 above"""
    reach_weights: bool = True
    """whether imagined states are weighted by the probability of reaching them"""
    lambda_: float = 0.95
    """mixes lambda-returns: 0 bootstraps after one step, 1 only at the horizon"""
    discount_horizon: float = 333.0
    """gamma = 1 - 1 / discount_horizon"""
    return_scale_decay: float = 0.99
    """decay of the running scale of returns, which advantages are divided by"""
    return_scale_limit: float = 1.0
    """smallest scale of returns, so that small returns are not enlarged"""
    return_scale_low: float = 0.05
    """lower quantile of returns that their scale is measured from"""
    return_scale_high: float = 0.95
    """upper quantile of returns that their scale is measured to"""


@dataclass(frozen=True)
class ValueAlignmentConfig:
    """L_var, Eq. 4 and Eq. 5. The loss and its weight are logged even when off."""

    weight: Literal["adaptive", "static", "off"] = "adaptive"
    """weight of L_var; adaptive: 1 / max(1, KL) of each state, Eq. 5; off: plain DreamerV3 or
    STORM"""
    static_weight: float = 0.5
    """the weight after the warm-up with weight="static"; Table 3"""
    warmup_steps: int = 10_000
    """the weight is 0 up to and including this step; small presets scale it with --env-steps"""
    warmup_unit: Literal["env_steps", "updates"] = "env_steps"
    """what warmup_steps counts"""
    dynamics_scale: float = 0.5
    """on KL[sg V(s) || V(s~)]"""
    representation_scale: float = 0.1
    """on KL[V(s) || sg V(s~)]; 0 gives the gradient of Eq. 4 as printed"""
    critic: Literal["online", "slow"] = "online"
    """the critic that L_var uses, with stopped parameters"""
    deter_gradient: Literal["live", "stop"] = "live"
    """whether L_var has a gradient to h_t through the critic's input"""
    noise: Literal["independent", "shared"] = "independent"
    """whether z~ is sampled with its own noise or with the noise of z"""


@dataclass(frozen=True)
class OptimizerConfig:
    """How parameters follow gradients; each agent has its own kind."""


@dataclass(frozen=True)
class LaPropConfig(OptimizerConfig):
    """LaProp after per-tensor adaptive gradient clipping, for all parameters at once."""

    learning_rate: float = 4e-5
    """of all parameters, after the warm-up"""
    warmup_updates: int = 1000
    """updates over which the learning rate grows from 0"""
    agc: float = 0.3
    """largest norm of a tensor's gradient, as a share of the norm of its parameters"""
    agc_floor: float = 1e-3
    """smallest parameter norm that AGC assumes"""
    beta1: float = 0.9
    """decay of the mean of updates"""
    beta2: float = 0.999
    """decay of the mean of squared gradients"""
    epsilon: float = 1e-20
    """added to the root of squared gradients"""


@dataclass(frozen=True)
class AdamConfig(OptimizerConfig):
    """Two Adams: one for the world model, then one for actor and critic in the new world model.

    Each clips by the global norm of its gradient first. Numbers of Table 14; both epsilons are
    the official code's.
    """

    learning_rate: float = 1e-4
    """of the world model"""
    clip: float = 1000.0
    """largest norm of the world model's gradient"""
    epsilon: float = 1e-8
    """added to the root of squared gradients, for the world model"""
    behaviour_learning_rate: float = 3e-5
    """of actor and critic together"""
    behaviour_clip: float = 100.0
    """largest norm of the gradient of actor and critic"""
    behaviour_epsilon: float = 1e-5
    """added to the root of squared gradients, for actor and critic"""
    beta1: float = 0.9
    """decay of the mean of gradients"""
    beta2: float = 0.999
    """decay of the mean of squared gradients"""


@dataclass(frozen=True)
class ReplayConfig:
    capacity: int = 5_000_000
    """steps of all environments together; a short run allocates only what it collects"""
    batch_size: int = 16
    """sequences in a batch"""
    batch_length: int = 64
    """steps of each"""
    images: Literal["device", "host"] = "device"
    """which memory keeps the images, as bytes; the rest of replay is on the device"""

    @property
    def batch_steps(self) -> int:
        """Steps that one update replays."""
        return self.batch_size * self.batch_length


@dataclass(frozen=True)
class VideoConfig:
    """Videos of episodes and of open-loop predictions, for observations with images."""

    every: int = 0
    """env steps between videos; 0 for none"""
    sequences: int = 4
    """replayed sequences side by side in a video of open-loop prediction"""
    context: int = 5
    """steps that the world model sees before it has to predict the rest of the sequence"""
    episode_steps: int = 1_000
    """longest video of an episode, in steps"""


@dataclass(frozen=True)
class EnvConfig:
    """What a suite lets one choose of its environments: nothing, for the tasks on MJX."""


@dataclass(frozen=True)
class HostEnvConfig(EnvConfig):
    """Environments outside of the device, stepped side by side in processes of their own."""

    workers: int = 0
    """processes; 0 for one per environment, but not more than there are cores"""
    timeout: float = 60.0
    """seconds that one step, or one reset, of an environment may take"""
    on_failure: Literal["raise", "restart"] = "raise"
    """when an environment raises, dies or hangs: end the run, or begin a new episode in it"""


@dataclass(frozen=True)
class AtariConfig(HostEnvConfig):
    """Atari 100k as DreamerV3 plays it; the frame skip is `action_repeat`."""

    image_size: int = 64
    """pixels a side, RGB"""
    resize: Literal["bilinear", "area"] = "bilinear"
    """bilinear: Pillow's, as in DreamerV3; area: OpenCV's, as in IRIS, STORM and ALE's own"""
    pooling: int = 2
    """frames at the end of a skip of which the maximum is seen"""
    noops: int = 30
    """random number of no-ops, up to this, that an episode begins with"""
    sticky: float = 0.0
    """probability that a frame repeats the action before instead; 0.25 in ALE's v5"""
    life_loss: Literal["ignore", "terminal", "end"] = "ignore"
    """terminal: the step and the return end there, the episode goes on; end: the episode ends
    too, and a new game begins"""
    clip_reward: bool = False
    """to its sign"""
    max_frames: int = 108_000
    """of a game, which then is cut short and not terminal"""
    full_action_set: bool = False
    """all 18 actions instead of those that do something in the game"""


@dataclass(frozen=True)
class VisionConfig(HostEnvConfig):
    """DeepMind Control from pixels, rendered by dm_control."""

    image_size: int = 64
    """pixels a side, RGB"""
    camera: int = -1
    """-1 for the usual one: 2 for quadruped, 0 for all others"""
    renderer: Literal["auto", "egl", "osmesa"] = "auto"
    """auto: EGL where it works, else OSMesa"""
    fast_rendering: bool = False
    """no shadows, reflections and anti-aliasing: other pixels, several times as fast"""


@dataclass(frozen=True)
class GymnasiumConfig(HostEnvConfig):
    """Any registered Gymnasium environment; the task is its id."""

    time_limit: int = 0
    """steps after which an episode is truncated; 0 for the environment's own limit"""
    image_size: int = 64
    """pixels a side to which pictures are resized, by Pillow's bilinear filter as for Atari"""


AgentName = Annotated[str, "a name in vawm.agent.registry"]
"""Which agent: the programs offer those that are registered."""


@dataclass(frozen=True)
class Config:
    """One run. `env_steps` counts control steps, action repeat included."""

    suite: str = "dmc_proprio"
    """suite of the task, such as dmc_vision; see `vawm.runs.suites`"""
    task: str = "cartpole_swingup"
    """name of the environment in its suite"""
    agent: AgentName = "dreamerv3"
    """the world model; recurrent (dreamerv3), a transformer (storm), recurrent without noise
    (vagram), or one that was registered"""
    preset: str = "paper"
    """set of defaults for the other numbers; custom: all set by flags"""
    size: str = "12m"
    """set of widths of the networks; custom: widths set by flags"""
    seed: int = 0
    """of parameters, environments and everything that is sampled"""
    env_steps: int = 500_000
    """length of the run in control steps, of all environments together"""
    num_envs: int = 16
    """environments side by side"""
    action_repeat: int = 2
    """control steps for which an action is repeated"""
    train_ratio: int = 512
    """replayed steps per collected step; updates = train_ratio / (batch_size * batch_length)"""
    random_steps: int = 0
    """env steps at the beginning with uniformly random actions"""
    collect_steps: int = 1
    """steps of every environment between updates, in one jitted call"""
    compute_dtype: Literal["auto", "float32", "bfloat16"] = "auto"
    """auto: bfloat16 on GPU and TPU, float32 on CPU"""
    tracker: Literal["none", "wandb", "trackio"] = "none"
    """where metrics and videos go in addition to metrics.jsonl and TensorBoard"""
    tracker_project: str = "vawm"
    """name of the project at the tracker"""
    tracker_group: str = ""
    """runs with the same group stand together at the tracker"""
    tracker_tags: str = ""
    """tags of the run at the tracker, with commas between them"""
    log_every: int = 2_000
    """env steps between lines of metrics.jsonl"""
    save_every: int = 50_000
    """env steps between checkpoints"""
    save_minutes: float = 10.0
    """minutes after which a checkpoint is saved as well; 0 for never"""
    keep_checkpoints: int = 2
    """how many of the newest checkpoints are kept"""
    world_model: WorldModelConfig = field(default_factory=RSSMConfig)
    actor: ActorConfig = field(default_factory=ActorConfig)
    critic: CriticConfig = field(default_factory=CriticConfig)
    imagination: ImaginationConfig = field(default_factory=ImaginationConfig)
    value_alignment: ValueAlignmentConfig = field(default_factory=ValueAlignmentConfig)
    optimizer: OptimizerConfig = field(default_factory=LaPropConfig)
    replay: ReplayConfig = field(default_factory=ReplayConfig)
    video: VideoConfig = field(default_factory=VideoConfig)
    env: EnvConfig = field(default_factory=EnvConfig)


CUSTOM = "custom"
"""Name of the preset or size of a run with numbers of its own."""


class RSSMSize(NamedTuple):
    """Widths of one size of DreamerV3; the other numbers do not change with size."""

    deter: int
    hidden: int
    classes: int
    units: int
    depth: int


class StormSize(NamedTuple):
    """Widths of one size of STORM."""

    deter: int
    feedforward: int
    heads: int
    classes: int
    units: int
    depth: int


RSSM_SIZES = {
    "1m": RSSMSize(deter=512, hidden=64, classes=4, units=64, depth=4),
    "12m": RSSMSize(deter=2048, hidden=256, classes=16, units=256, depth=16),
    "25m": RSSMSize(deter=3072, hidden=384, classes=24, units=384, depth=24),
    "50m": RSSMSize(deter=4096, hidden=512, classes=32, units=512, depth=32),
    "100m": RSSMSize(deter=6144, hidden=768, classes=48, units=768, depth=48),
    "200m": RSSMSize(deter=8192, hidden=1024, classes=64, units=1024, depth=64),
    "400m": RSSMSize(deter=12288, hidden=1536, classes=96, units=1536, depth=96),
}

STORM_SIZES = {
    "1m": StormSize(deter=128, feedforward=256, heads=4, classes=8, units=128, depth=8),
    "16m": StormSize(deter=512, feedforward=1024, heads=8, classes=32, units=512, depth=32),
}
"""The official size is 16m, named after its world model."""


def with_widths(config: Config, size: str, widths: Mapping[str, int]) -> Config:
    """`config` with these widths of the world model, whose size they are.

    Actor and critic get the world model's `units`, where that is among them.
    """
    changed: dict[str, Any] = dict(widths)
    units = {"units": changed["units"]} if "units" in changed else {}
    return dataclasses.replace(
        config,
        size=size,
        world_model=dataclasses.replace(config.world_model, **changed),
        actor=dataclasses.replace(config.actor, **units),
        critic=dataclasses.replace(config.critic, **units),
    )


@functools.cache
def kinds(cls: type) -> dict[str, Any]:
    """Field -> its type, of a dataclass of choices; not to be changed."""
    return typing.get_type_hints(cls)


def as_dict(config: Config) -> dict[str, Any]:
    """Plain nested dict, ready for JSON."""
    return dataclasses.asdict(config)
