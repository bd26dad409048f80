"""Trained policies: loading, playing, and published scores."""

from vawm.policy.policy import Policy, load

__all__ = ["Policy", "load"]
