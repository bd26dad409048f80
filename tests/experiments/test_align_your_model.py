"""The example of value alignment in another world model."""

import ast
import importlib.util
import pathlib
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

PATH = pathlib.Path(__file__).parents[2] / "experiments" / "align_your_model.py"


@pytest.fixture(scope="module")
def example():
    spec = importlib.util.spec_from_file_location("align_your_model", PATH)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_printed_value_kl_falls_and_further_with_value_alignment(example, capsys):
    example.main()
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 3
    for seed, line in enumerate(lines):
        assert line.startswith(f"seed {seed}: ")
        before, without, aligned = map(float, re.findall(r"\d\.\d{3}", line))
        assert aligned < 0.7 * before
        assert aligned < 0.9 * without


def test_nothing_differs_before_the_warm_up_is_over(example):
    without, aligned = (example.train(0, steps) for steps in (example.STEPS, example.WARMUP))
    # Step WARMUP + 1 is the first to be aligned, which the next one sees.
    first = example.WARMUP + 2
    np.testing.assert_array_equal(without[:first], aligned[:first])
    assert without[first] != aligned[first]


def test_value_alignment_trains_the_latent_dynamics_and_neither_decoder_nor_critic(example):
    sizes = example.SIZES

    @jax.jit
    def gradient(warmup):
        keys = jax.random.split(jax.random.key(0), (1 + example.LENGTH, 2))
        params = {x: jnp.sin(jnp.arange(m * n).reshape(m, n)) for x, (m, n) in sizes.items()}
        return jax.grad(example.loss, has_aux=True)(params, keys, 5, warmup)[0]

    without, with_it = gradient(5), gradient(4)
    moved = {x: np.abs(with_it[x] - without[x]).max() for x in sizes}
    assert moved["obs"] == 0
    assert all(moved[x] > 0 for x in ("h", "post", "prior"))
    np.testing.assert_array_equal(with_it["value"], np.zeros(sizes["value"]))


def test_the_example_has_at_most_40_lines_of_code():
    """All but docstrings, comments, blank lines and imports."""
    text, left_out = PATH.read_text(), set()
    for node in ast.walk(ast.parse(text)):
        is_docstring = isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)
        if is_docstring or isinstance(node, ast.Import | ast.ImportFrom):
            left_out |= set(range(node.lineno, node.end_lineno + 1))
    lines = enumerate(text.splitlines(), 1)
    code = [line for n, line in lines if n not in left_out and re.match(r"\s*[^\s#]", line)]
    assert len(code) <= 40


def test_of_ours_the_example_imports_the_losses_alone():
    nodes = list(ast.walk(ast.parse(PATH.read_text())))
    plain = {a.name.split(".")[0] for n in nodes if isinstance(n, ast.Import) for a in n.names}
    assert plain == {"jax"}
    assert {n.module for n in nodes if isinstance(n, ast.ImportFrom)} == {"vawm.losses"}
