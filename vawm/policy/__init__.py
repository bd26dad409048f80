"""Trained policies: loading them, playing with them, published scores."""

from vawm.policy.policy import Policy, load

__all__ = ["Policy", "load"]
