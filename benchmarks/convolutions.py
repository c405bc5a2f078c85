"""How long the network of Mnih et al. 2015 takes on one core, inside a compiled loop, by four ways to convolve.

    taskset -c 0 env NPROC=1 .venv/bin/python benchmarks/convolutions.py --batch 256

``xla``: XLA's convolution both ways. ``space to depth``: the same on blocks of pixels turned into channels. ``hybrid``: XLA's forward,
patches and matrix products backward. ``patches``: these both ways, as ``networks/convolution.py`` does on a CPU. CPU-milliseconds of the
whole process, the best of three loops; compiled with the options that a training run has.
"""

import argparse
import time
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from thorndike.networks.convolution import by_patches

LAYERS = ((8, 4, 32, 4), (4, 32, 64, 2), (3, 64, 64, 1))
"""Size, channels in, channels out, stride."""
OPTIONS = {"xla_backend_optimization_level": "1", "xla_cpu_parallel_codegen_split_count": "1"}
Convolve = Callable[[jax.Array, jax.Array, int], jax.Array]


def xla(image: jax.Array, kernel: jax.Array, stride: int) -> jax.Array:
    return jax.lax.conv_general_dilated(image, kernel, (stride, stride), "VALID", dimension_numbers=("NHWC", "HWIO", "NHWC"))


def space_to_depth(image: jax.Array, kernel: jax.Array, stride: int) -> jax.Array:
    size = kernel.shape[0]
    if stride == 1 or size % stride:
        return xla(image, kernel, stride)
    count, side, depth = image.shape[0], image.shape[1] // stride, image.shape[3]
    blocks = image.reshape(count, side, stride, side, stride, depth).transpose(0, 1, 3, 2, 4, 5).reshape(count, side, side, -1)
    wide = kernel.reshape(size // stride, stride, size // stride, stride, depth, -1).transpose(0, 2, 1, 3, 4, 5)
    return xla(blocks, wide.reshape(size // stride, size // stride, -1, kernel.shape[3]), 1)


def hybrid(image: jax.Array, kernel: jax.Array, stride: int) -> jax.Array:
    @jax.custom_vjp
    def convolve(image: jax.Array, kernel: jax.Array) -> jax.Array:
        return xla(image, kernel, stride)

    def backward(given: tuple[jax.Array, jax.Array], weight: jax.Array) -> tuple[jax.Array, ...]:
        return jax.vjp(lambda image, kernel: by_patches(image, kernel, stride), *given)[1](weight)

    convolve.defvjp(lambda image, kernel: (convolve(image, kernel), (image, kernel)), backward)
    return convolve(image, kernel)


WAYS: dict[str, Convolve] = {"xla": xla, "space to depth": space_to_depth, "hybrid": hybrid, "patches": by_patches}


def outputs(convolve: Convolve, weights: list[jax.Array], images: jax.Array) -> jax.Array:
    x = images.astype(jnp.float32) / 255
    for kernel, (_, _, _, stride) in zip(weights[:3], LAYERS, strict=True):
        x = jax.nn.relu(convolve(x, kernel, stride))
    return jax.nn.relu(x.reshape(x.shape[0], -1) @ weights[3]) @ weights[4]


def milliseconds(loop: Callable, weights: list[jax.Array], images: jax.Array, times: int) -> float:
    """CPU-milliseconds of one pass."""
    program = jax.jit(loop).lower(weights, images, 1).compile(OPTIONS)
    jax.block_until_ready(program(weights, images, 1))
    spent = []
    for _ in range(3):
        began = time.process_time()
        jax.block_until_ready(program(weights, images, times))
        spent.append((time.process_time() - began) / times)
    return 1e3 * min(spent)


def main() -> None:
    """Print a line a way."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--batch", type=int, default=256)
    parser.add_argument("--times", type=int, default=3)
    options = parser.parse_args()
    keys = jax.random.split(jax.random.key(0), 5)
    shapes = [*((size, size, before, after) for size, before, after, _ in LAYERS), (3136, 512), (512, 7)]
    weights = [0.05 * jax.random.normal(key, shape) for key, shape in zip(keys, shapes, strict=True)]
    images = jnp.asarray(np.random.default_rng(0).integers(0, 256, (options.batch, 84, 84, 4), dtype=np.uint8))
    for name, convolve in WAYS.items():

        def forward(weights: list[jax.Array], images: jax.Array, n: int, convolve: Convolve = convolve) -> jax.Array:
            # Each pass depends on the last one's result, so that none is left out.
            def one(i: int, total: jax.Array) -> jax.Array:
                return total + jnp.sum(outputs(convolve, [w + 1e-9 * total for w in weights], images))

            return jax.lax.fori_loop(0, n, one, jnp.zeros(()))

        def descend(weights: list[jax.Array], images: jax.Array, n: int, convolve: Convolve = convolve) -> list[jax.Array]:
            gradient = jax.grad(lambda weights: jnp.mean(jnp.square(outputs(convolve, weights, images))))
            return jax.lax.fori_loop(0, n, lambda i, weights: jax.tree.map(lambda w, g: w - 1e-3 * g, weights, gradient(weights)), weights)

        spent = [milliseconds(loop, weights, images, options.times) for loop in (forward, descend)]
        print(f"{name}: forward {spent[0]:.1f} ms, with its gradient {spent[1]:.1f} ms", flush=True)


if __name__ == "__main__":
    main()
