"""DeepSea: the rules as they are published, and the compiled environment against the plain one."""

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from thorndike.environments import registry
from thorndike.environments.deep_sea import DeepSeaEnv, right_actions
from thorndike.environments.native.deep_sea import deep_sea
from thorndike.environments.native.vectorize import vectorize
from thorndike.errors import UserError


def dive(environment, actions) -> tuple[float, int]:
    """Return and length of an episode."""
    environment.reset(seed=0)
    total, length, ended = 0.0, 0, False
    while not ended:
        _, reward, ended, truncated, _ = environment.step(actions(length))
        assert not truncated
        total, length = total + reward, length + 1
    return total, length


@pytest.mark.parametrize("size", [2, 5, 20])
def test_the_way_right_is_worth_99_hundredths_and_the_way_left_nothing(size):
    environment, right = DeepSeaEnv(size), right_actions(size, True, 42)
    total, length = dive(environment, lambda row: right[row, row])
    assert total == pytest.approx(0.99)
    assert length == size
    assert dive(environment, lambda row: 1 - right[row, 0]) == (0.0, size)
    one_mistake, _ = dive(environment, lambda row: 1 - right[row, row] if row == 0 else right[row, max(row - 1, 0)])
    assert one_mistake == pytest.approx(-0.01 * (size - 1) / size)


def test_actions_are_drawn_for_each_cell_and_always_the_same():
    # np.random.RandomState(42).binomial(1, 0.5, (3, 3)): what bsuite draws with mapping_seed=42.
    np.testing.assert_array_equal(right_actions(3, True, 42), [[0, 1, 1], [1, 0, 0], [0, 1, 1]])
    assert not np.array_equal(right_actions(20, True, 42), right_actions(20, True, 43))
    assert right_actions(4, False, 42).all()


@pytest.mark.parametrize(("observation", "randomize"), [("one_hot", True), ("index", True), ("one_hot", False)])
def test_the_compiled_one_steps_as_the_plain_one(observation, randomize):
    """Mostly to the right, so that every cell of the way to the treasure is met."""
    settings = {"size": 6, "observation": observation, "randomize_actions": randomize, "mapping_seed": 7}
    steps, batch = 300, 5
    environment = vectorize(deep_sea(**settings), batch)
    rng, right = np.random.default_rng(0), right_actions(6, randomize, 7)
    plain = [DeepSeaEnv(**settings) for _ in range(batch)]
    state, obs = environment.init(jax.random.key(0))
    np.testing.assert_array_equal(obs, [each.reset()[0] for each in plain])
    step, best = jax.jit(environment.step), 0.0
    for _ in range(steps):
        wanted = np.array([right[each._row, each._column] for each in plain])
        action = np.where(rng.random(batch) < 0.9, wanted, 1 - wanted)
        state, mine = step(state, jnp.asarray(action, jnp.int32), ((), ()))
        rows = [each.step(int(one)) for each, one in zip(plain, action, strict=True)]
        np.testing.assert_array_equal(mine.next_obs, [row[0] for row in rows])
        np.testing.assert_allclose(mine.reward, [row[1] for row in rows], rtol=1e-6)
        np.testing.assert_array_equal(mine.terminated, [row[2] for row in rows])
        assert not np.any(mine.truncated)
        after = [each.reset()[0] if row[2] else row[0] for each, row in zip(plain, rows, strict=True)]
        np.testing.assert_array_equal(mine.obs, after)
        best = max(best, float(mine.reward.max()))
    assert best > 0.9, "the treasure was found"


def test_it_is_one_id_for_training_and_for_evaluation():
    choice = registry.resolve("DeepSea-v0", env_kwargs={"size": 7})
    assert choice.engine == "native"
    reference = registry.reference(choice)
    assert isinstance(reference.unwrapped, DeepSeaEnv)
    assert reference.observation_space == registry.build_native(choice, 1).spec.observation_space
    picture = gymnasium.make("DeepSea-v0", size=7, render_mode="rgb_array")
    picture.reset()
    assert picture.render().shape == (7 * 16, 7 * 16, 3)


@pytest.mark.parametrize("settings", [{"size": 1}, {"size": 2.5}, {"observation": "picture"}])
def test_what_it_cannot_be_is_said(settings):
    for make in (deep_sea, DeepSeaEnv):
        with pytest.raises(UserError, match="of DeepSea-v0 must be"):
            make(**settings)


def test_its_table_gives_planning_the_exact_value():
    from thorndike.algorithms.planning import Config, plan
    from thorndike.environments.native.table import read_table

    table = read_table(gymnasium.make("DeepSea-v0", size=8, observation="index"))
    assert plan(table, Config(gamma=1.0)).start_value(table) == pytest.approx(0.99)
