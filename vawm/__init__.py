"""Value-aligned world models in JAX."""
