"""STORM's image networks against 4 x 4 convolutions of stride 2 written out in numpy."""

import functools

import flax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from vawm.nets import strided
from vawm.nets.strided import StridedDecoder, StridedEncoder

SIZE, CHANNELS, DEPTH, FEATURES = 32, 3, 16, 7


def halve(x, kernel):
    """Coarse pixel i sees fine pixel 2 i + t - 1 through tap t, zeros outside."""
    count, height, width, _ = x.shape
    padded = np.pad(x, ((0, 0), (1, 1), (1, 1), (0, 0)))
    result = np.zeros((count, height // 2, width // 2, kernel.shape[-1]))
    for s, t in np.ndindex(4, 4):
        seen = padded[:, s : s + height - 1 : 2, t : t + width - 1 : 2]
        result += seen @ kernel[s, t]
    return result


def double(x, kernel):
    """Coarse pixel i adds to fine pixel 2 i + t - 1 through tap t."""
    count, height, width, _ = x.shape
    padded = np.zeros((count, 2 * height + 2, 2 * width + 2, kernel.shape[-1]))
    for s, t in np.ndindex(4, 4):
        padded[:, s : s + 2 * height : 2, t : t + 2 * width : 2] += x @ kernel[s, t]
    return padded[:, 1:-1, 1:-1]


TWINS = {strided.halve: halve, strided.double: double}
PLAIN = {strided.halve: strided.plain_halve, strided.double: strided.plain_double}
PRODUCTS = {
    strided.halve: strided.halve_by_products,
    strided.double: strided.double_by_products,
}
# (convolution, count, height and width of the input, inputs, outputs): nine products, or
# written out for few fine channels or an odd coarse side; also more images than at once.
SHAPES = [
    (strided.halve, 2, 8, 12, 16, 5),
    (strided.halve, 2, 8, 12, 3, 5),
    (strided.halve, 2, 2, 6, 16, 5),
    (strided.halve, 67, 4, 4, 16, 2),
    (strided.halve, 64, 4, 4, 2, 2),
    (strided.double, 2, 4, 6, 5, 16),
    (strided.double, 2, 4, 6, 5, 3),
    (strided.double, 2, 1, 3, 5, 16),
    (strided.double, 67, 2, 2, 2, 16),
    (strided.double, 64, 2, 2, 2, 2),
]
each_shape = pytest.mark.parametrize(
    ("convolution", "count", "height", "width", "inputs", "outputs"),
    SHAPES,
    ids=lambda value: getattr(value, "__name__", None),
)


def image_and_kernel(count, height, width, inputs, outputs):
    keys = jax.random.split(jax.random.key(0))
    x = jax.random.normal(keys[0], (count, height, width, inputs))
    return x, jax.random.normal(keys[1], (4, 4, inputs, outputs)) / np.sqrt(16 * inputs)


def float64(tree):
    return jax.tree.map(lambda x: np.asarray(x, np.float64), tree)


def close(actual, expected, tolerance=1e-5):
    actual, expected = jax.tree.leaves(actual), jax.tree.leaves(expected)
    for a, b in zip(actual, expected, strict=True):
        np.testing.assert_allclose(a, b, atol=tolerance * max(1, np.abs(b).max()))


@each_shape
def test_convolutions_equal_their_definitions_tap_by_tap(
    convolution, count, height, width, inputs, outputs
):
    inputs = image_and_kernel(count, height, width, inputs, outputs)
    expected = TWINS[convolution](*float64(inputs))
    for function in (convolution, PRODUCTS[convolution], PLAIN[convolution]):
        close(jax.jit(function)(*inputs), expected)


@each_shape
def test_gradients_equal_those_of_xla_s_convolutions(
    convolution, count, height, width, inputs, outputs
):
    inputs = image_and_kernel(count, height, width, inputs, outputs)

    def gradients(convolution):
        loss = lambda x, kernel: jnp.sin(convolution(x, kernel)).sum()  # noqa: E731
        return jax.jit(jax.grad(loss, (0, 1)))(*inputs)

    close(gradients(convolution), gradients(PLAIN[convolution]))


@pytest.mark.parametrize("scheme", [strided.SAVING, strided.WRITTEN_OUT])
def test_to_and_of_are_transposes_of_each_other(scheme):
    """<of(x), m> = <x, to(m)>, of the fine image, the coarse one and the kernel."""
    fine, kernel = image_and_kernel(2, 8, 12, 16, 5)
    coarse = jax.random.normal(jax.random.key(1), (2, 4, 6, 5))
    pairs = [
        (scheme.of_fine, lambda m: scheme.to_fine(m, 2, 4, 6), fine),
        (scheme.of_coarse, lambda m: scheme.to_coarse(m, 2, 4, 6), coarse),
        (scheme.of_kernel, scheme.to_kernel, kernel),
    ]
    for apart, together, x in pairs:
        matrices = apart(x)
        keys = jax.random.split(jax.random.key(2), len(matrices))
        others = [jax.random.normal(k, m.shape) for k, m in zip(keys, matrices, strict=True)]
        left = sum((a * b).sum() for a, b in zip(matrices, others, strict=True))
        assert float(left) == pytest.approx(float((x * together(others)).sum()), abs=1e-2)


def test_a_double_is_the_gradient_of_a_halve():
    x, kernel = image_and_kernel(2, 8, 8, 16, 5)
    y, pull = jax.vjp(lambda x: strided.halve(x, kernel), x)
    close(strided.double(y, kernel.swapaxes(2, 3)), pull(y)[0])


def encoder(count=3, dtype=jnp.float32):
    module = StridedEncoder(CHANNELS, DEPTH, dtype)
    x = jax.random.randint(jax.random.key(2), (count, SIZE, SIZE, CHANNELS), 0, 256)
    x = x.astype(jnp.uint8)
    return module, uneven(init(module, x[:1])), x


def decoder(count=3, dtype=jnp.float32):
    module = StridedDecoder(FEATURES, SIZE, CHANNELS, DEPTH, dtype)
    z = jax.random.normal(jax.random.key(3), (count, FEATURES))
    return module, uneven(init(module, z[:1])), z


@functools.partial(jax.jit, static_argnums=0)
def init(module, x):
    return module.init(jax.random.key(0), x, train=False)


@functools.partial(jax.jit, static_argnums=0, static_argnames="train")
def apply(module, variables, x, *, train):
    return module.apply(variables, x, train=train, mutable=["statistics"])


def uneven(variables):
    """Scales, biases and running statistics that are not trivial; variances stay positive."""

    def moved(factor, leaf):
        leaf = np.asarray(leaf)
        return jnp.asarray(leaf * factor if leaf.ndim > 1 else (leaf + 0.2) * factor - 0.2)

    leaves, tree = jax.tree.flatten(variables)
    rng = np.random.default_rng(1)
    factors = [rng.uniform(0.5, 1.5, leaf.shape).astype(np.float32) for leaf in leaves]
    return jax.tree.unflatten(tree, map(moved, factors, leaves))


class Twin:
    """Both networks in float64; collects the running statistics after a batch."""

    def __init__(self, variables, train):
        self.params, self.statistics = (float64(variables[k]) for k in ("params", "statistics"))
        self.train = train

    def norm(self, x, params, statistics):
        mean, var = statistics["mean"], statistics["var"]
        if self.train:
            flat = x.reshape(-1, x.shape[-1])
            mean, var = flat.mean(0), flat.var(0)
            statistics["mean"] = 0.9 * statistics["mean"] + 0.1 * mean
            statistics["var"] = 0.9 * statistics["var"] + 0.1 * flat.var(0, ddof=1)
        x = (x - mean) / np.sqrt(var + 1e-5) * params["scale"] + params["bias"]
        return np.maximum(x, 0)

    def stages(self, convolve, x):
        for name in sorted(name for name in self.params if name.startswith("stages")):
            params, statistics = self.params[name], self.statistics[name]
            x = self.norm(convolve(x, params["kernel"]), params["norm"], statistics["norm"])
        return x

    def encode(self, x):
        return self.stages(halve, np.asarray(x, np.float64) / 255).reshape(len(x), -1)

    def decode(self, z):
        x = np.tensordot(np.asarray(z, np.float64), self.params["kernel"], 1)
        x = self.norm(x, self.params["norm"], self.statistics["norm"])
        x = double(self.stages(double, x), self.params["out_kernel"])
        return x + self.params["out_bias"]


NETWORKS = {"encoder": (encoder, Twin.encode), "decoder": (decoder, Twin.decode)}
each_network = pytest.mark.parametrize("name", NETWORKS)


@each_network
@pytest.mark.parametrize("train", [False, True])
def test_networks_equal_their_definitions(name, train):
    """In training they also compute the running statistics of torch."""
    build, twin_of = NETWORKS[name]
    module, variables, x = build()
    twin = Twin(variables, train)
    expected = twin_of(twin, x)
    actual, updated = apply(module, variables, x, train=train)
    close(actual, expected, 2e-5)
    close(updated["statistics"], twin.statistics)


@each_network
@pytest.mark.parametrize("count", [64, 67])
def test_a_large_batch_gives_the_same_as_single_images(name, count):
    """With running statistics. A CPU processes 32 images at a time, then the rest."""
    module, variables, x = NETWORKS[name][0](count)
    together, _ = apply(module, variables, x, train=False)
    assert len(together) == count
    close(together[:3], apply(module, variables, x[:3], train=False)[0])
    close(together[-3:], apply(module, variables, x[-3:], train=False)[0])


@each_network
def test_networks_give_the_same_without_jit(name):
    module, variables, x = NETWORKS[name][0]()
    close(module.apply(variables, x, train=False), apply(module, variables, x, train=False)[0])


@each_network
@pytest.mark.parametrize("train", [False, True])
def test_gradients_reach_inputs_and_all_parameters(name, train):
    """Compared with a difference along the gradient; pixels in units of 255."""
    module, variables, x = NETWORKS[name][0]()
    unit = 255 if name == "encoder" else 1

    @jax.jit
    def loss(params, x):
        variables_ = {"params": params, "statistics": variables["statistics"]}
        y, _ = apply(module, variables_, unit * x, train=train)
        return jnp.sin(y).mean()

    inputs = (variables["params"], x / unit)
    gradients = jax.jit(jax.grad(loss, (0, 1)))(*inputs)
    assert all(leaf.any() for leaf in jax.tree.leaves(gradients))
    squares = sum((leaf**2).sum() for leaf in jax.tree.leaves(gradients))
    step = 1e-2 / jnp.sqrt(squares) / 10
    ahead, behind = (
        loss(*jax.tree.map(lambda v, g, s=sign: v + s * step * g, inputs, gradients))
        for sign in (1, -1)
    )
    assert (ahead - behind) / (2 * step * squares) == pytest.approx(1, rel=0.05)


def test_parameters_at_full_size_are_storm_s():
    images, z = jnp.zeros((1, 64, 64, 3)), jnp.zeros((1, 1024))
    key = jax.random.key(0)

    def sizes(module, x):
        variables = jax.eval_shape(lambda: module.init(key, x, train=False))
        return {
            collection: sum(leaf.size for leaf in jax.tree.leaves(tree))
            for collection, tree in variables.items()
        }

    encoder, decoder = StridedEncoder(3), StridedDecoder(1024, 64, 3)
    kernels = 16 * (3 * 32 + 32 * 64 + 64 * 128 + 128 * 256)
    norms = 2 * (32 + 64 + 128 + 256)
    assert sizes(encoder, images) == {"params": kernels + norms, "statistics": norms}
    assert kernels + norms == 690_624
    everything = 1024 * 4 * 4 * 256 + norms + kernels + 3
    assert sizes(decoder, z) == {"params": everything, "statistics": norms}


def test_kernels_start_within_torchs_bounds():
    """1 / sqrt(fan-in); torch's fan-in of a transposed convolution counts its outputs."""
    encoder, decoder = StridedEncoder(3, 8), StridedDecoder(512, 16, 3, 8)
    params = init(encoder, jnp.zeros((1, 16, 16, 3)))["params"]
    bounds = [(params[f"stages_{i}"]["kernel"], 16 * n) for i, n in enumerate((3, 8, 16, 32))]
    params = init(decoder, jnp.zeros((1, 512)))["params"]
    bounds += [(params[f"stages_{i}"]["kernel"], 16 * n) for i, n in enumerate((32, 16, 8))]
    bounds += [(params["kernel"], 512), (params["out_kernel"], 16 * 3)]
    for kernel, fan_in in bounds:
        bound = 1 / np.sqrt(fan_in)
        assert 0.98 * bound < abs(kernel).max() <= bound
        assert np.asarray(kernel).std() == pytest.approx(bound / np.sqrt(3), rel=0.1)
    assert abs(params["out_bias"]).max() <= 1 / np.sqrt(16 * 3)


@each_network
def test_bfloat16_products_keep_float32_parameters_and_statistics(name):
    build, _ = NETWORKS[name]
    module, variables, x = build(dtype=jnp.bfloat16)
    assert all(leaf.dtype == jnp.float32 for leaf in jax.tree.leaves(variables))
    y, updated = apply(module, variables, x, train=True)
    assert y.dtype == jnp.bfloat16
    assert all(leaf.dtype == jnp.float32 for leaf in jax.tree.leaves(updated))
    frozen, _ = apply(module, variables, x, train=False)
    assert frozen.dtype == jnp.bfloat16
    wide, _ = apply(build()[0], variables, x, train=False)
    close(frozen.astype(jnp.float32), wide, 0.1)


@pytest.mark.parametrize("size", [0, 8, 40])
def test_sides_that_four_halvings_do_not_divide_are_refused(size):
    with pytest.raises(ValueError, match=rf"16.*{size}"):
        init(StridedDecoder(FEATURES, size, CHANNELS), jnp.zeros((1, FEATURES)))
    with pytest.raises(ValueError, match=rf"16.*{size}"):
        init(StridedEncoder(CHANNELS), jnp.zeros((1, 16, size, CHANNELS)))


def test_in_training_statistics_have_to_be_mutable():
    module, variables, x = encoder()
    with pytest.raises(flax.errors.ModifyScopeVariableError):
        module.apply(variables, x, train=True)
