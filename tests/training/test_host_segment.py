"""Learning beside a host engine."""

import gymnasium
import jax
import jax.numpy as jnp
import pytest
from gymnasium import spaces
from jaxtyping import PyTree

from thorndike.algorithms import dqn, sac
from thorndike.environments import wrappers
from thorndike.environments.host.gymnasium_engine import LoopEngine
from thorndike.training.host_segment import learning_of_one
from thorndike.training.host_source import host_source
from thorndike.training.runner import runner
from thorndike.types import EnvSpec, Rollout, Step

BUFFER = 50_000
BOX, DISCRETE = spaces.Box(-1.0, 1.0, (17,)), spaces.Discrete(3)


@pytest.mark.parametrize(
    ("make", "action_space"),
    [
        (
            lambda spec: sac.sac(sac.Config(buffer_size=BUFFER, learning_starts=10, batch_size=32, net_arch=(8,)), spec),
            spaces.Box(-1.0, 1.0, (6,)),
        ),
        (lambda spec: dqn.dqn(dqn.Config(buffer_size=BUFFER, learning_starts=10, batch_size=32, net_arch=(8,)), spec), DISCRETE),
    ],
    ids=["sac", "dqn"],
)
def test_a_step_beside_a_host_engine_does_not_copy_the_memory_of_transitions(make, action_space):
    algorithm = make(EnvSpec("x", BOX, action_space, 1, engine="gymnasium"))
    state = jax.eval_shape(algorithm.init, jax.random.key(0))
    length = algorithm.needs.rollout_length
    one = jax.eval_shape(lambda: _rollouts(action_space, length))
    program = learning_of_one(algorithm.update).lower(state, one, jax.random.split(jax.random.key(0), 1), jnp.int32(0)).compile()
    replay = sum(x.size * x.dtype.itemsize for x in jax.tree.leaves(state.replay))
    assert replay > BUFFER * 17 * 4 * 2
    assert program.memory_analysis().temp_size_in_bytes < replay / 10


def test_a_segment_of_one_seed_leaves_the_memory_of_transitions_where_it_is():
    engine = LoopEngine([lambda: gymnasium.make("Pendulum-v1")], "Pendulum-v1", 200)
    algorithm = sac.sac(sac.Config(buffer_size=BUFFER, learning_starts=10, batch_size=32, net_arch=(8,)), engine.spec)
    program = runner(algorithm, host_source(engine, algorithm, wrappers.chain(), 0, [0], 100), 0, [0])
    carry, _ = program.advance(program.init(), 0, 20)
    before = _addresses(carry.learner.replay)
    carry, _ = program.advance(carry, 20, 5)
    assert before and _addresses(carry.learner.replay) == before


def _addresses(replay: PyTree) -> list[int]:
    return [x.unsafe_buffer_pointer() for x in jax.tree.leaves(replay) if x.size >= BUFFER]


def _rollouts(action_space: spaces.Space, length: int) -> Rollout:
    batch = (1, length, 1)
    number, flag, obs = jnp.zeros(batch), jnp.zeros(batch, bool), jnp.zeros((*batch, 17))
    action = jnp.zeros((*batch, *action_space.shape), jnp.int32 if isinstance(action_space, spaces.Discrete) else jnp.float32)
    return Rollout(obs, action, {}, Step(obs, obs, number, number, flag, flag, flag), ())
