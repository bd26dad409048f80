"""The example of value alignment in another world model."""

import ast
import importlib.util
import pathlib

import jax
import numpy as np
import pytest

PATH = pathlib.Path(__file__).parents[1] / "experiments" / "align_your_model.py"


@pytest.fixture(scope="module")
def example():
    spec = importlib.util.spec_from_file_location("align_your_model", PATH)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_printed_value_kl_falls_and_further_with_value_alignment(example, capsys):
    example.main()
    kl = {}
    for line in capsys.readouterr().out.splitlines():
        kl[line.split()[0]] = float(line.split("value KL")[1])
    assert kl["with"] < 0.7 * kl["before"]
    assert kl["with"] < 0.9 * kl["without"]


def test_no_gradient_of_value_alignment_reaches_the_critic(example):
    rng = np.random.default_rng(0)
    critic = rng.normal(size=example.SHAPES["critic"])
    h, z, prior = (rng.normal(size=(4, 3, n)) for n in (example.HIDDEN, *2 * [example.CLASSES]))

    def value_alignment(critic, *latents):
        return example.value_alignment({"critic": critic}, jax.random.key(0), *latents).mean()

    gradient = jax.jit(jax.grad(value_alignment, argnums=(0, 1, 2, 3)))
    to_critic, *to_latents = gradient(critic, h, z, prior)
    np.testing.assert_array_equal(to_critic, np.zeros_like(critic))
    for leaf in to_latents:
        assert (np.abs(leaf) > 0).all()


def test_of_ours_the_example_imports_the_losses_alone():
    imports = [
        n for n in ast.walk(ast.parse(PATH.read_text())) if isinstance(n, ast.ImportFrom)
    ]
    assert [(n.module, [a.name for a in n.names]) for n in imports] == [("vawm", ["losses"])]
