"""Acting with a policy: one observation or a batch, best or drawn actions, memory, the environment's own units."""

import gymnasium.spaces as spaces
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from thorndike.algorithms import dqn, ppo, q_learning
from thorndike.environments import wrappers
from thorndike.errors import UserError
from thorndike.training.policy import Policy
from thorndike.types import EnvSpec

pytestmark = pytest.mark.usefixtures("quick_compile")
SEEDS, NUM_ENVS = 3, 2
ROW, TWO = spaces.Box(-1, 1, (3,)), spaces.Discrete(2)
OBS = np.random.default_rng(0).normal(size=(5, 3)).astype(np.float32)


def policy_of(observations: spaces.Space, actions: spaces.Space, *parts, algorithm: str = "ppo", best: int = 0) -> Policy:
    """An untrained policy of three seeds."""
    wrapper, spec = wrappers.chain(*parts), EnvSpec("e", observations, actions, NUM_ENVS)
    seen = wrapper.spec(spec)
    if algorithm == "ppo":
        learner = ppo.ppo(ppo.Config(n_steps=8, batch_size=8, net_arch=(8,)), seen)
    elif algorithm == "dqn":
        learner = dqn.dqn(dqn.Config(net_arch=(8,), buffer_size=8, exploration_initial_eps=1.0), seen)
    else:
        learner = q_learning.q_learning(q_learning.Config(total_steps=10), seen)
    actors = jax.vmap(lambda key: learner.actor(learner.init(key)))(jax.random.split(jax.random.key(0), SEEDS))
    statistics = jax.tree.map(lambda x: jnp.broadcast_to(x, (SEEDS, *jnp.shape(x))), wrapper.statistics(spec))
    return Policy(learner, wrapper, spec, actors, statistics, best)


@pytest.fixture(scope="module")
def policy(quick_compile) -> Policy:
    return policy_of(ROW, TWO, best=1)


def test_one_observation_gives_one_action_and_a_batch_a_batch(policy):
    batch, _ = policy.predict(OBS)
    assert batch.shape == (5,)
    singles = [policy.predict(obs)[0] for obs in OBS]
    assert all(action.shape == () for action in singles)
    np.testing.assert_array_equal(batch, singles)
    assert policy.predict(OBS[:1])[0].shape == (1,)


def test_values_are_the_learners_own(policy):
    actor = jax.tree.map(lambda leaf: leaf[1], policy.actors)
    np.testing.assert_allclose(policy.value(OBS), policy.algorithm.value(actor, jnp.asarray(OBS)), rtol=1e-5)
    assert policy.value(OBS[0]).shape == ()
    np.testing.assert_allclose(policy.value(OBS[0]), policy.value(OBS)[0], rtol=1e-5)


def test_deterministic_actions_repeat_and_drawn_ones_vary(policy):
    np.testing.assert_array_equal(policy.predict(OBS)[0], policy.predict(OBS)[0])
    drawn = np.array([policy.predict(OBS, deterministic=False)[0] for _ in range(40)])
    assert 0.2 < drawn.mean() < 0.8, "a new policy is nearly even between two actions"
    assert (drawn.min(axis=0) < drawn.max(axis=0)).all()


def test_rows_of_a_batch_draw_apart(policy):
    actions = policy.predict(np.tile(OBS[:1], (200, 1)), deterministic=False)[0]
    assert 40 < actions.sum() < 160


def test_each_seed_is_a_policy_of_its_own_and_the_best_is_the_default(policy):
    assert policy.number_of_seeds == SEEDS == len(policy.seeds)
    np.testing.assert_allclose(policy.seeds[1].value(OBS), policy.value(OBS), rtol=1e-6)
    assert not np.allclose(policy.seeds[0].value(OBS), policy.value(OBS))
    assert all(seed.number_of_seeds == 1 for seed in policy.seeds)


@pytest.mark.parametrize("obs", [np.zeros(4), np.zeros((2, 4)), np.zeros((2, 2, 3)), 1.0, {"a": np.zeros(3)}, None])
def test_an_observation_of_another_shape_is_refused_in_one_line(policy, obs):
    with pytest.raises(UserError, match="this policy takes one observation of Box") as error:
        policy.predict(obs)
    assert "\n" not in str(error.value)


def test_observations_of_other_dtypes_and_lists_are_taken(policy):
    np.testing.assert_array_equal(policy.predict(OBS.astype(np.float64))[0], policy.predict(OBS)[0])
    np.testing.assert_array_equal(policy.predict(OBS.tolist())[0], policy.predict(OBS)[0])


NESTED = spaces.Dict({"n": spaces.Discrete(4), "t": spaces.Tuple([spaces.Box(0, 255, (2, 2), np.uint8), spaces.MultiBinary(2)])})


def test_dict_and_tuple_observations_come_single_and_in_batches():
    policy = policy_of(NESTED, TWO)
    one = {"n": 3, "t": (np.full((2, 2), 9, np.uint8), np.array([0, 1], np.int8))}
    many = {"n": np.array([3, 0, 1]), "t": (np.full((3, 2, 2), 9, np.uint8), np.array([[0, 1]] * 3, np.int8))}
    assert policy.predict(one)[0].shape == ()
    assert policy.predict(many)[0].shape == (3,)
    np.testing.assert_allclose(policy.value(many)[0], policy.value(one), rtol=1e-5)
    for wrong in ({"n": 3}, one | {"t": (one["t"][0],)}, one | {"more": 1}):
        with pytest.raises(UserError, match="this policy takes one observation of "):
            policy.predict(wrong)


def test_half_a_batch_is_refused():
    policy = policy_of(NESTED, TWO)
    mixed = {"n": np.array([3, 0, 1]), "t": (np.full((2, 2), 9, np.uint8), np.array([0, 1], np.int8))}
    with pytest.raises(UserError, match="this policy takes one observation of Dict"):
        policy.predict(mixed)


def test_box_actions_are_in_the_environments_units():
    low, high = np.array([-2, 0], np.float32), np.array([2, 10], np.float32)
    policy = policy_of(ROW, spaces.Box(low, high))
    actions = np.concatenate([policy.predict(OBS, deterministic=False)[0] for _ in range(40)])
    assert actions.shape == (200, 2)
    assert (actions >= low).all() and (actions <= high).all()
    assert (actions.max(0) == high).all() and (actions.min(0) == low).all(), "a wide Gaussian reaches the bounds"
    # A new policy's mean is near 0 of [-1, 1]: the middle of the bounds.
    np.testing.assert_allclose(policy.predict(OBS)[0], np.tile([0, 5], (5, 1)), atol=0.3)


@pytest.mark.parametrize("algorithm", ["ppo", "dqn", "q_learning"])
def test_discrete_actions_count_from_the_spaces_start(algorithm):
    observations = spaces.Discrete(4) if algorithm == "q_learning" else ROW
    policy = policy_of(observations, spaces.Discrete(2, start=7), algorithm=algorithm)
    obs = np.zeros((64,), np.int32) if algorithm == "q_learning" else np.zeros((64, 3), np.float32)
    assert set(policy.predict(obs, deterministic=False)[0].tolist()) == {7, 8}
    assert set(policy.predict(obs)[0].tolist()) <= {7, 8}


def test_several_discrete_actions_count_from_their_starts():
    policy = policy_of(ROW, spaces.MultiDiscrete([2, 3], start=[5, -1]))
    drawn = policy.predict(np.zeros((200, 3), np.float32), deterministic=False)[0]
    assert set(drawn[:, 0].tolist()) == {5, 6}
    assert set(drawn[:, 1].tolist()) == {-1, 0, 1}


def test_memory_carries_frames_through_an_episode_and_none_starts_one():
    policy = policy_of(ROW, TWO, wrappers.frame_stack(2))
    seen = []
    greedy = policy.algorithm.greedy
    policy.algorithm = policy.algorithm._replace(
        greedy=lambda a, m, obs, n: (jax.debug.callback(seen.append, obs), greedy(a, m, obs, n))[1]
    )
    _, memory = policy.predict(OBS[0])
    _, memory = policy.predict(OBS[1], memory)
    policy.predict(OBS[2], memory)
    policy.predict(OBS[3])
    jax.effects_barrier()
    pairs = [(0, 0), (0, 1), (1, 2), (3, 3)]
    np.testing.assert_allclose(np.concatenate(seen), [np.concatenate([OBS[i], OBS[j]]) for i, j in pairs], rtol=1e-6)


def test_statistics_are_used_and_never_changed():
    policy = policy_of(ROW, TWO, wrappers.normalize_observation())
    moments = policy.statistics[0][0]
    shifted = moments._replace(mean=moments.mean + 100, variance=moments.variance * 4)
    policy.statistics = ((shifted,),)
    plain = policy_of(ROW, TWO)
    before = jax.tree.map(np.asarray, policy.statistics)
    np.testing.assert_allclose(policy.value(100 + 2 * OBS), plain.value(OBS), rtol=1e-3, atol=1e-4)
    memory = None
    for _ in range(5):
        _, memory = policy.predict(100 + 2 * OBS, memory)
    for a, b in zip(jax.tree.leaves(before), jax.tree.leaves(policy.statistics), strict=True):
        np.testing.assert_array_equal(a, b)
    np.testing.assert_allclose(policy.value(100 + 2 * OBS), plain.value(OBS), rtol=1e-3, atol=1e-4)
