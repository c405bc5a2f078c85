"""Normal noise with a memory: successive numbers are correlated, so that exploration goes somewhere.

Eberhard et al. 2023, "Pink Noise Is All You Need: Colored Noise Exploration in Deep Reinforcement Learning" (ICLR); made as in Timmer and
Koenig 1995, "On generating power law noise".
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key


def coloured_noise(key: Key[Array, ""], steps: int, shape: tuple[int, ...], color: float) -> Float[Array, "{steps} ..."]:
    """Noise ``[steps, *shape]``, each number standard normal, whose spectrum over the steps falls as ``1 / f^color``.

    0 is white (independent), 1 pink, 2 red. Consumes the key. Steps drawn by different calls are independent.
    """
    white = jax.random.normal(key, (steps, *shape))
    if color == 0.0 or steps < 2:
        return white
    frequency = np.fft.rfftfreq(steps)
    # The constant part is as loud as the slowest wave; zero frequency would have infinite power.
    frequency[0] = frequency[1]
    gain = frequency ** (-0.5 * color)
    # How often each frequency of the half spectrum stands in the whole one.
    twice = np.full(gain.shape, 2.0)
    twice[0] = 1.0
    if steps % 2 == 0:
        twice[-1] = 1.0
    gain = gain / np.sqrt(np.sum(twice * gain**2) / steps)
    spectrum = jnp.fft.rfft(white, axis=0) * jnp.asarray(gain, jnp.float32).reshape((-1,) + (1,) * len(shape))
    return jnp.fft.irfft(spectrum, n=steps, axis=0)
