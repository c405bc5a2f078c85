"""rejax PPO on gymnax's CartPole-v1 to a mean return of 475, with the settings of rejax's own configs/gymnax/cartpole.yaml.

rejax logs no training episodes (its evaluation plays 128 episodes), so a wrapper adds two sums to the environment's state: returns and
number of finished episodes. Every 1,000 steps the host reads them: the mean is over the episodes of the last calls that hold 100 of them.
"""

import argparse

import gymnax
import jax
import jax.numpy as jnp
import rejax
from flax import struct
from measurement import cpu_seconds, now, report

CHUNK = 1_000
EPISODES = 100


def make_env():
    """gymnax's CartPole-v1 with the sums in its state."""

    @struct.dataclass
    class Counted:
        inner: object
        running: object
        return_sum: object
        episodes: object

    class CountingEnv:
        def __init__(self, inner):
            self.inner = inner

        def __getattr__(self, name):
            if name == "inner":  # asked for by copy.deepcopy before there is one
                raise AttributeError(name)
            return getattr(self.inner, name)

        def reset(self, key, params):
            obs, state = self.inner.reset(key, params)
            return obs, Counted(state, jnp.float32(0), jnp.float32(0), jnp.int32(0))

        def step(self, key, state, action, params):
            obs, inner, reward, done, info = self.inner.step(key, state.inner, action, params)
            running = state.running + reward
            return_sum = state.return_sum + running * done
            return obs, Counted(inner, running * (1 - done), return_sum, state.episodes + done), reward, done, info

    env, params = gymnax.make("CartPole-v1")
    return CountingEnv(env), params


def make_chunk():
    """A jitted function: training state -> training state after ``CHUNK`` environment steps, and the initial state."""
    env, params = make_env()
    ppo = (
        rejax.get_algo("ppo")
        .create(
            env=env,
            env_params=params,
            num_envs=5,
            num_steps=100,
            num_epochs=5,
            num_minibatches=5,
            learning_rate=7.5e-4,
            gamma=0.99,
            gae_lambda=0.95,
            clip_eps=0.2,
            ent_coef=0.01,
            vf_coef=0.5,
            max_grad_norm=0.5,
            agent_kwargs={"activation": "tanh"},
            total_timesteps=CHUNK,
            eval_freq=CHUNK,
            skip_initial_evaluation=True,
        )
        .replace(eval_callback=lambda algorithm, state, key: ())
    )
    return jax.jit(lambda state: ppo.train(train_state=state)[0]), jax.jit(ppo.init_state)


def recent_mean(totals: list[tuple[float, int]]) -> float | None:
    """Mean return over the fewest last chunks that hold 100 finished episodes; ``None`` before there are as many."""
    last_sum, last_count = totals[-1]
    for earlier_sum, earlier_count in reversed(totals):
        if last_count - earlier_count >= EPISODES:
            return (last_sum - earlier_sum) / (last_count - earlier_count)
    return None


def main() -> None:
    """Learn chunk by chunk until the threshold, at most ``--steps`` environment steps."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--steps", type=int, default=500_000)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    import_cpu_s = cpu_seconds()
    chunk, init = make_chunk()
    state = init(jax.random.PRNGKey(options.seed))
    totals, curve, reached = [(0.0, 0)], [], None
    for _ in range(options.steps // CHUNK):
        state = chunk(state)
        counted = jax.device_get(state.env_state)
        totals.append((float(counted.return_sum.sum()), int(counted.episodes.sum())))
        mean = recent_mean(totals)
        curve.append((int(state.global_step), mean))
        if mean is not None and mean >= 475.0:
            reached = now(int(state.global_step))
            break
    report(
        steps=curve[-1][0],
        reached=reached is not None,
        cpu_s=None if reached is None else reached.cpu,
        reached_at=None if reached is None else reached.wall,
        curve=curve[:: max(len(curve) // 50, 1)],
        import_cpu_s=import_cpu_s,
    )


if __name__ == "__main__":
    main()
