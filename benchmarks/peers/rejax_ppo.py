"""rejax PPO on gymnax's CartPole-v1 or Breakout-MinAtar, the settings of tasks ``ppo`` and ``minatar_ppo``. Compilation is one call ahead.

``agent_kwargs`` reaches the networks here; the chunk is one jitted ``train`` call without rejax's evaluation of 128 episodes.
"""

import argparse

import jax
import rejax
from measurement import cpu_seconds, now, report, window

NUM_ENVS = {"CartPole-v1": 4, "Breakout-MinAtar": 64}


def make_chunk(environment: str, steps: int):
    """A jitted function: training state -> training state after ``steps`` environment steps, and the initial state."""
    ppo = (
        rejax.get_algo("ppo")
        .create(
            env=environment,
            num_envs=NUM_ENVS[environment],
            num_steps=128,
            num_epochs=4,
            num_minibatches=4,
            learning_rate=2.5e-4,
            gamma=0.99,
            gae_lambda=0.95,
            clip_eps=0.2,
            ent_coef=0.01,
            vf_coef=0.5,
            max_grad_norm=0.5,
            agent_kwargs={"hidden_layer_sizes": (64, 64), "activation": "tanh"},
            total_timesteps=steps,
            eval_freq=steps,
            skip_initial_evaluation=True,
        )
        .replace(eval_callback=lambda algorithm, state, key: ())
    )
    if (ppo.actor.hidden_layer_sizes, ppo.critic.hidden_layer_sizes) != ((64, 64), (64, 64)):
        raise ValueError(f"expected 64x64 networks, rejax built {ppo.actor}")
    return jax.jit(lambda state: ppo.train(train_state=state)[0]), jax.jit(ppo.init_state)


def main() -> None:
    """Warm up one chunk, measure ``--steps`` in chunks."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--steps", type=int, default=500_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--environment", choices=NUM_ENVS, default="CartPole-v1")
    options = parser.parse_args()
    import_cpu_s = cpu_seconds()
    iteration = NUM_ENVS[options.environment] * 128
    steps = max(options.steps // iteration, 1) * iteration
    chunk, init = make_chunk(options.environment, steps)
    before = now()
    state = jax.block_until_ready(init(jax.random.PRNGKey(options.seed)))
    compiled = chunk.lower(state).compile()
    compile_s = now().cpu - before.cpu
    start = now()
    state = jax.block_until_ready(compiled(state))
    end = now(int(state.global_step))
    report(**window(start, end), compile_s=compile_s, import_cpu_s=import_cpu_s)


if __name__ == "__main__":
    main()
