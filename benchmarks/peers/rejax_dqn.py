"""rejax DQN on gymnax's CartPole-v1 or Breakout-MinAtar, the settings of tasks ``dqn`` and ``minatar_dqn``.

Compilation and the warm-up without learning are ahead of the window.
rejax 0.1.3 always builds 64x64 Q-networks, so the 120-84 network of task ``dqn`` is put in its place.
"""

import argparse

import jax
import rejax
from flax import linen as nn
from measurement import cpu_seconds, now, report, window
from rejax.networks import DiscreteQNetwork, EpsilonGreedyPolicy

NUM_ENVS = 10
NETWORKS = {"CartPole-v1": ((120, 84), 2), "Breakout-MinAtar": ((64, 64), 3)}
"""Environment -> widths of the hidden layers, number of actions."""


def make_chunk(environment: str, steps: int):
    """A jitted function: training state -> training state after ``steps`` environment steps, and the initial state."""
    hidden, actions = NETWORKS[environment]
    network = EpsilonGreedyPolicy(DiscreteQNetwork)(hidden_layer_sizes=hidden, action_dim=actions, activation=nn.relu)
    dqn = (
        rejax.get_algo("dqn")
        .create(
            env=environment,
            num_envs=NUM_ENVS,
            buffer_size=10_000,
            fill_buffer=1_000,
            batch_size=128,
            num_epochs=1,
            learning_rate=2.5e-4,
            gamma=0.99,
            max_grad_norm=10.0,
            target_update_freq=500,
            polyak=0.0,
            ddqn=False,
            eps_start=1.0,
            eps_end=0.05,
            exploration_fraction=0.5,
            total_timesteps=steps,
            eval_freq=steps,
            skip_initial_evaluation=True,
        )
        .replace(agent=network, eval_callback=lambda algorithm, state, key: ())
    )
    return jax.jit(lambda state: dqn.train(train_state=state)[0]), jax.jit(dqn.init_state)


def main() -> None:
    """Warm up one chunk, measure ``--steps`` in one call."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--steps", type=int, default=100_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--environment", choices=NETWORKS, default="CartPole-v1")
    options = parser.parse_args()
    import_cpu_s = cpu_seconds()
    chunk, init = make_chunk(options.environment, options.steps)
    before = now()
    state = jax.block_until_ready(init(jax.random.PRNGKey(options.seed)))
    compiled = chunk.lower(state).compile()
    compile_s = now().cpu - before.cpu
    state = jax.block_until_ready(compiled(state))
    start = now(int(state.global_step))
    state = jax.block_until_ready(compiled(state))
    end = now(int(state.global_step))
    report(**window(start, end), compile_s=compile_s, import_cpu_s=import_cpu_s)


if __name__ == "__main__":
    main()
