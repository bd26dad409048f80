"""An agent: a world model, an actor and a critic, as pure functions."""

from vawm.agent.agent import Agent, PolicyCarry, make_agent, parameter_count, resolve_dtype

__all__ = ["Agent", "PolicyCarry", "make_agent", "parameter_count", "resolve_dtype"]
