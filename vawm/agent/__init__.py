"""An agent as pure functions: a world model, an actor and a critic; and the kinds of agents."""

from vawm.agent.agent import Agent, PolicyCarry, make_agent, parameter_count, resolve_dtype
from vawm.agent.kinds import register_all
from vawm.agent.registry import Activations, AgentKind, register, with_size

__all__ = [
    "Activations",
    "Agent",
    "AgentKind",
    "PolicyCarry",
    "make_agent",
    "parameter_count",
    "register",
    "resolve_dtype",
    "with_size",
]

register_all()
