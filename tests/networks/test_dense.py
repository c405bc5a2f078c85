"""Dense layers with a gradient of their own form: the same numbers as the plain product's."""

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from thorndike.networks.dense import dense, product


def data(inputs: int, outputs: int, leading: tuple[int, ...]) -> tuple:
    keys = jax.random.split(jax.random.key(0), 3)
    x = jax.random.normal(keys[0], (*leading, inputs))
    return x, jax.random.normal(keys[1], (inputs, outputs)), jax.random.normal(keys[2], (*leading, outputs))


@pytest.mark.parametrize("leading", [(7,), (3, 5), ()])
@pytest.mark.parametrize("outputs", [1, 2, 40])
def test_value_and_gradients_are_those_of_the_plain_product(outputs, leading):
    x, kernel, weight = data(4, outputs, leading)
    value, pull = jax.vjp(product, x, kernel)
    by_input, by_kernel = pull(weight)
    rows, columns = np.asarray(x).reshape(-1, 4), np.asarray(weight).reshape(-1, outputs)
    np.testing.assert_allclose(value, np.asarray(x) @ np.asarray(kernel), rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(by_input, np.asarray(weight) @ np.asarray(kernel).T, rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(
        by_kernel, sum(np.outer(row, column) for row, column in zip(rows, columns, strict=True)), rtol=1e-5, atol=1e-5
    )


def test_a_batch_of_products_has_the_gradients_of_each():
    x, kernel, weight = data(4, 3, (2, 5))
    kernels = jnp.stack([kernel, 2 * kernel])

    def by_kernel(x, kernel, weight):
        return jax.vjp(product, x, kernel)[1](weight)[1]

    each = [by_kernel(x[i], kernels[i], weight[i]) for i in range(2)]
    np.testing.assert_allclose(jax.vmap(by_kernel)(x, kernels, weight), jnp.stack(each), rtol=1e-5, atol=1e-5)


def test_forward_over_reverse_differentiates_it_twice():
    x, kernel, _ = data(4, 3, (5,))

    def loss(kernel, dot):
        return jnp.sum(jnp.tanh(dot(x, kernel)) ** 2)

    def curvature(dot):
        return jax.jvp(jax.grad(lambda kernel: loss(kernel, dot)), (kernel,), (jnp.ones_like(kernel),))[1]

    np.testing.assert_allclose(curvature(product), curvature(jnp.matmul), rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("width", [8, 200])
def test_a_layer_has_the_parameters_and_outputs_of_the_library_it_comes_from(width):
    x = jax.random.normal(jax.random.key(1), (6, 4))
    ours, theirs = dense(width, nn.initializers.lecun_normal()), nn.Dense(width, kernel_init=nn.initializers.lecun_normal())
    params = ours.init(jax.random.key(2), x)
    jax.tree.map(np.testing.assert_array_equal, params, theirs.init(jax.random.key(2), x))
    np.testing.assert_allclose(ours.apply(params, x), theirs.apply(params, x), rtol=1e-6)
