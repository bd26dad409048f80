"""The kinds of agents: one row for each, and everything the package asks about it.

    import vawm.agent

    vawm.agent.register("gru", GRUConfig, gru)

A row says which config a world model has and how it is built; the rest has defaults. Training,
`--resume`, evaluation, export, analysis and sweeps look rows up here by `Config.agent`, and ask
nothing else about the kind of a world model. Our own rows are in `vawm.agent.kinds`.

Rows of other packages are registered when their module is imported. A program imports the
modules that `--plugin` or the environment variable `VAWM_PLUGINS` names, `vawm.agent.plugins`.
"""

from __future__ import annotations

import dataclasses
import pathlib
import re
import sys
import typing
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

from vawm.agent import plugins
from vawm.config import (
    CUSTOM,
    Config,
    LaPropConfig,
    OptimizerConfig,
    WorldModelConfig,
    kinds,
    presets,
    with_widths,
)
from vawm.errors import InvalidInput, Rule
from vawm.world_model.protocol import WorldModel


class Activations(NamedTuple):
    """How many float32 numbers an update keeps for its gradient; `runs.budget` adds them up."""

    observed: int  # per replayed step, apart from images
    cache: int = 0  # of all imagined sequences together, such as keys and values
    maps: int = 0  # in the encoder's and decoder's maps, for the images of one step


def default_activations(config: Config, image_size: int | None) -> Activations:
    """A rough upper bound for an encoder, a recurrence and heads of `units` width."""
    model, critic = config.world_model, config.critic
    feature = model.deter + model.stoch * model.classes
    layers = 12 * model.units + config.actor.layers * config.actor.units
    observed = 8 * feature + 4 * (layers + critic.layers * critic.units + 4 * critic.bins)
    size = image_size or 0
    return Activations(observed, maps=2 * size * size * (3 + 4 * model.depth))


def accept(config: Config) -> None:
    """Refuses nothing."""


class AgentKind(NamedTuple):
    """One row.

    Attributes:
      world_model: config class of the world model; every field has a default.
      make: `(config.world_model, spec, *, dtype, noise) -> WorldModel`.
      optimizer: `LaPropConfig` for one gradient of one summed loss, `AdamConfig` for the world
        model first and then actor and critic.
      sizes: name -> field of the world model's config -> width; what `--size` offers. If there
        are none, the only size is custom.
      presets: suite -> name -> config; what `--preset` offers. If there are none, the presets
        of dreamerv3 with the defaults of this world model.
      rules: field of the world model's config -> what its number must be; positive if not here.
      check: `(config) -> None`; raises `InvalidInput` for what cannot run.
      activations: `(config, image_size) -> Activations`; `image_size` is None without images.
      context_limited: whether the world model knows only as many positions as a training
        sequence has, so that nothing longer can be imagined.
      samples_latents: whether z and z~ are sampled, so that their noise is a choice.
      make_latent_losses: `(critic, config.world_model) -> losses(critic_params,
        slow_critic_params, inference) -> {name: [B, T]}`, further losses of the world model;
        None for none.
    """

    world_model: type[WorldModelConfig]
    make: Callable[..., WorldModel]
    optimizer: type[OptimizerConfig] = LaPropConfig
    sizes: Mapping[str, Mapping[str, int]] = {}
    presets: Mapping[str, Mapping[str, Config]] = {}
    rules: Mapping[str, Rule] = {}
    check: Callable[[Config], None] = accept
    activations: Callable[[Config, int | None], Activations] = default_activations
    context_limited: bool = False
    samples_latents: bool = True
    make_latent_losses: Callable[..., Callable[..., Any]] | None = None


class UnknownAgent(InvalidInput):
    """An agent that no module in this process has registered."""

    def __init__(self, name: object):
        remedy = (
            f"is not registered; use one of {', '.join(_ROWS)}, import the module that "
            f"registers it, or give a program --plugin FILE.py (or {plugins.VARIABLE}=FILE.py)"
        )
        super().__init__("agent", name, remedy)


_ROWS: dict[str, AgentKind] = {}


def register(
    name: str,
    world_model: type[WorldModelConfig],
    make: Callable[..., WorldModel],
    **choices: Any,
) -> None:
    """Adds a kind of agent; all arguments but the name are attributes of `AgentKind`.

    Running a module or a cell of a notebook again replaces the row of the same class. A name
    that another module has taken is refused.

    Raises:
      InvalidInput: a name that is taken or cannot be a name, or a config class that cannot be
        saved: not a frozen dataclass, a field without default or of another type than a number,
        a bool, a text or a `Literal`.
    """
    if not re.fullmatch(r"[a-z0-9][a-z0-9_-]{0,39}", name):
        remedy = "use up to 40 small letters, digits, '-' and '_', a letter or digit first"
        raise InvalidInput("agent", name, remedy)
    _check_class(world_model)
    if name in _ROWS and _origin(_ROWS[name].world_model) != _origin(world_model):
        where, other = _origin(_ROWS[name].world_model)
        raise InvalidInput("agent", name, f"{other} of {where} has this name; use another one")
    row = AgentKind(world_model, make, **choices)
    if not row.presets:
        row = row._replace(presets=_presets_like_dreamerv3(name, row))
    _ROWS[name] = row


def _origin(cls: type) -> tuple[str, str]:
    """Where a class is written: the same for a file that is imported under another name."""
    module = sys.modules.get(cls.__module__)
    return getattr(module, "__file__", None) or cls.__module__, cls.__qualname__


def _check_class(cls: type[WorldModelConfig]) -> None:
    if not (isinstance(cls, type) and issubclass(cls, WorldModelConfig)):
        raise InvalidInput("world_model", cls, "derive it from vawm.config.WorldModelConfig")
    name = cls.__name__
    if "__dataclass_params__" not in vars(cls) or not vars(cls)["__dataclass_params__"].frozen:
        raise InvalidInput("world_model", name, "decorate it with @dataclass(frozen=True)")
    types = kinds(cls)  # type: ignore[arg-type]
    for field in dataclasses.fields(cls):
        if field.default is dataclasses.MISSING:
            raise InvalidInput(f"{name}.{field.name}", None, "has no default; give it one")
        kind = types[field.name]
        if (
            kind not in (int, float, bool, str)
            and typing.get_origin(kind) is not typing.Literal
        ):
            remedy = "use int, float, bool, str or a Literal, which can be a flag and be saved"
            raise InvalidInput(f"{name}.{field.name}", kind, remedy)


def _presets_like_dreamerv3(name: str, row: AgentKind) -> Mapping[str, Mapping[str, Config]]:
    """The runs of dreamerv3's presets, with another world model, of its first size."""
    model = row.world_model()  # type: ignore[call-arg]

    def like(config: Config) -> Config:
        config = dataclasses.replace(config, agent=name, size=CUSTOM, world_model=model)
        if not row.sizes:
            return config
        size = next(iter(row.sizes))
        return with_widths(config, size, row.sizes[size])

    return {
        suite: {preset: like(config) for preset, config in named.items()}
        for suite, named in presets.DREAMERV3.items()
    }


def names() -> tuple[str, ...]:
    """All agents that are registered."""
    plugins.load_named()
    return tuple(_ROWS)


def kind(name: str) -> AgentKind:
    """The row of an agent.

    Raises:
      UnknownAgent: nothing has registered it.
    """
    if name not in names():
        raise UnknownAgent(name)
    return _ROWS[name]


def plugin_of(name: str) -> str | None:
    """The file that other programs need as `--plugin`; None for our own agents.

    Relative to the working directory if it is below; the module's name where there is no file.
    """
    cls = kind(name).world_model
    if cls.__module__.split(".")[0] == "vawm":
        return None
    path, here = pathlib.Path(_origin(cls)[0]), pathlib.Path.cwd()
    return str(path.relative_to(here) if path.is_relative_to(here) else path)


def presets_of(config: Config) -> Mapping[str, Config]:
    """The presets of this agent in this suite, by name; none if it has none."""
    return kind(config.agent).presets.get(config.suite, {})


def with_size(config: Config, size: str) -> Config:
    """`config` with the widths that its agent has at this size."""
    return with_widths(config, size, kind(config.agent).sizes[size])
