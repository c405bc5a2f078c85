"""A frozen lake of 8 x 8 cells, with and without a hint: reward shaping that cannot change which policy is best (Ng et al. 1999).

The only reward is 1 at the goal, and a random walk falls into a hole 500 times before it gets there. The potential is how near the goal
is: ``potential_shaping`` adds ``gamma Phi(s') - Phi(s)`` to each reward, so that every step in the right direction is felt at once.

python examples/reward_shaping.py
"""

import jax.numpy as jnp

import thorndike as td

GAMMA = 0.99
SIZE = 8


def nearness(obs):
    """1 at the goal, 0 in the opposite corner ``[B]``. An observation is the number of a cell, row by row."""
    row, column = obs // SIZE, obs % SIZE
    return (row + column).astype(jnp.float32) / (2 * SIZE - 2)


def train(wrappers, steps, seeds, output):
    agent = td.QLearning(
        "FrozenLake8x8-v1",
        env_kwargs={"is_slippery": False},
        wrappers=wrappers,
        seeds=seeds,
        gamma=GAMMA,
        exploration_final_eps=0.1,
        output=output,
    )
    return agent.learn(steps).evaluate(episodes=20)


def main(steps=20_000, seeds=8, output="runs"):
    plain = train([], steps, seeds, output)
    shaped = train([td.wrappers.potential_shaping(nearness, GAMMA)], steps, seeds, output)
    print(f"share of episodes that reach the goal: {plain.mean:.2f} without the hint, {shaped.mean:.2f} with it")
    return plain, shaped


if __name__ == "__main__":
    main()
