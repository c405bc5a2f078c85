"""A network of your own: two pure functions. Here policy and value share one body, which PPO's own network does not do.

python examples/own_network.py
"""

import math

import jax
import jax.numpy as jnp

import thorndike as td

WIDTH = 64


def shared_body(spec, outputs):
    """Two layers for both heads. ``outputs`` is what the policy needs: an action's logits, or means and log deviations."""
    inputs = math.prod(spec.observation_space.shape)

    def init(key, obs):
        sizes = ((inputs, WIDTH), (WIDTH, WIDTH), (WIDTH, outputs + 1))
        keys = jax.random.split(key, len(sizes))
        scales = (1.0, 1.0, 0.01)
        return [
            {"weight": scale * jax.random.normal(k, size) / math.sqrt(size[0]), "bias": jnp.zeros(size[1])}
            for k, size, scale in zip(keys, sizes, scales, strict=True)
        ]

    def apply(params, obs):
        x = obs.reshape(obs.shape[0], -1)
        *body, head = params
        for layer in body:
            x = jnp.tanh(x @ layer["weight"] + layer["bias"])
        x = x @ head["weight"] + head["bias"]
        return x[:, :-1], x[:, -1]

    return td.Network(init, apply)


def main(steps=50_000, seeds=4, output="runs"):
    agent = td.PPO("CartPole-v1", seeds=seeds, network=shared_body, output=output)
    found = agent.learn(steps).evaluate(episodes=20)
    print(f"mean return {found.mean:.1f}, worst seed {found.min:.1f}")
    return found


if __name__ == "__main__":
    main()
