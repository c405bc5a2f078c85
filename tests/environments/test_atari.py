"""Atari: the vector engines step by step beside Gymnasium's own game, their resets, protocols, and what a user may ask for."""

import gymnasium
import jax.numpy as jnp
import numpy as np
import pytest

from thorndike.environments import registry, wrappers
from thorndike.environments.host.atari import atari_settings, described, is_preprocessed
from thorndike.environments.host.atari_game import area_weights
from thorndike.environments.origins import make_single
from thorndike.errors import UserError
from thorndike.types import Step

pytest.importorskip("ale_py")
STILL = {"repeat_action_probability": 0.0}
"""Without sticky actions a game is what its actions make of it."""


def engine_of(id: str, num_envs: int, limit: int | None = None, engine: str = "ale", **settings):
    return registry.build_host(registry.resolve(id, engine=engine, env_kwargs=settings, max_episode_steps=limit), num_envs)


def almost(pixels: np.ndarray, expected: np.ndarray) -> None:
    """Equal, but for averages that lie between two whole numbers."""
    apart = np.abs(pixels.astype(int) - expected.astype(int))
    assert apart.max() <= 1 and np.count_nonzero(apart) <= 8


@pytest.mark.parametrize("limit", [None, 150])
def test_every_transition_is_that_of_gymnasiums_game(limit):
    """Deaths, lost lives and time limits: observations, true final observations, rewards, flags, and the games that begin after them."""
    engine = engine_of("ALE/Breakout-v5", 2, limit, terminal_on_life_loss=True, **STILL)
    games = [make_single("ALE/Breakout-v5", {**STILL, "terminal_on_life_loss": True}, limit) for _ in range(2)]
    obs, rng, kinds = engine.reset([3, 3]), np.random.default_rng(0), np.zeros(3, int)
    for row, game in enumerate(games):
        almost(obs[row], game.reset(seed=3)[0])
    for _ in range(500):
        actions = rng.integers(0, 4, 2)
        step = engine.step(actions)
        for row, game in enumerate(games):
            seen, reward, terminated, truncated, info = game.step(actions[row])
            almost(step.next_obs[row], seen)
            told = (step.reward[row], step.terminated[row], step.truncated[row], step.cost[row], step.valid[row])
            assert told == (reward, terminated, truncated, info.get("cost", 0), True)
            kinds += (terminated, truncated, step.cost[row] > 0)
            almost(step.obs[row], game.reset()[0] if terminated or truncated else seen)
    assert kinds[2] > 10 and kinds[0 if limit is None else 1] >= 4, kinds


@pytest.mark.parametrize("protocol", ["machado", "classic"])
def test_no_false_transition_in_many_games(protocol):
    """Every successor is the stack acted on and one frame more; every game begins with a frame after black ones, and ends at its limit."""
    num_envs, limit = 8, 40
    engine = engine_of("ALE/Boxing-v5", num_envs, limit, protocol=protocol)
    obs, age, rng = engine.reset(range(num_envs)), np.zeros(num_envs, int), np.random.default_rng(0)
    false, ends = 0, 0
    for _ in range(200):
        step = engine.step(rng.integers(0, 18, num_envs))
        age += 1
        false += int(np.sum((step.next_obs[..., :3] != obs[..., 1:]).any((1, 2, 3))))
        done = step.terminated | step.truncated
        np.testing.assert_array_equal(step.truncated, age == limit)
        false += int(np.sum((step.obs != step.next_obs).any((1, 2, 3)) & ~done))
        assert not step.obs[done][..., :3].any() and (step.obs[done][..., 3].max((1, 2)) > 0).all()
        assert step.valid.all()
        ends += int(done.sum())
        obs, age = step.obs, np.where(done, 0, age)
    assert false == 0 and ends >= 5 * num_envs


def test_a_pool_of_envpool_shows_the_same_kind_of_game():
    pytest.importorskip("envpool")
    engine = engine_of("ALE/Breakout-v5", 3, 60, engine="envpool", protocol="classic")
    assert (engine.spec.id, engine.spec.frames, engine.spec.max_episode_steps) == ("ALE/Breakout-v5", 4, 60)
    obs, rng, costs, cuts = engine.reset([1, 2, 3]), np.random.default_rng(0), 0.0, 0
    for _ in range(150):
        step = engine.step(rng.integers(0, 4, 3))
        moved = (step.next_obs[..., :3] == obs[..., 1:]).all((1, 2, 3))
        assert moved[step.valid].all()
        costs, cuts, obs = costs + step.cost.sum(), cuts + step.truncated.sum(), step.obs
    assert costs > 0 and cuts >= 3
    engine.close()


@pytest.mark.parametrize("engine", ["ale", "gymnasium"])
def test_the_same_seeds_give_the_same_games_and_others_do_not(engine):
    pool = engine_of("ALE/SpaceInvaders-v5", 2, engine=engine, protocol="classic")

    def play(seeds):
        pool.reset(seeds)
        return np.stack([pool.step(np.array([1, 1])).obs for _ in range(40)])

    first, again, others = play([0, 7]), play([0, 7]), play([8, 9])
    np.testing.assert_array_equal(first, again)
    assert not np.array_equal(first[:, 0], first[:, 1]) and not np.array_equal(first, others)


def test_sticky_actions_make_equal_actions_end_differently():
    still, sticky = (engine_of("ALE/Pong-v5", 2, **settings) for settings in (STILL, {}))
    actions = np.random.default_rng(0).integers(2, 4, 60)
    for pool, equal in ((still, True), (sticky, False)):
        pool.reset([1, 2])
        for action in actions:
            step = pool.step(np.array([action, action]))
        assert np.array_equal(step.obs[0], step.obs[1]) is equal


def test_an_id_is_the_preprocessed_game_on_every_engine_and_raw_by_gymnasiums_own_settings():
    for engine in ("ale", "gymnasium", "subprocess"):
        choice = registry.resolve("ALE/Pong-v5", engine="auto" if engine == "ale" else engine)
        assert choice.engine == engine
    game = registry.reference(registry.resolve("ALE/Pong-v5", env_kwargs={"full_action_space": True, "screen_size": 42}))
    assert game.observation_space == gymnasium.spaces.Box(0, 255, (42, 42, 4), np.uint8) and game.action_space.n == 18
    raw = registry.resolve("ALE/Pong-v5", env_kwargs={"obs_type": "ram"})
    assert raw.engine == "gymnasium" and registry.reference(raw).observation_space.shape == (128,)
    assert registry.build_host(registry.resolve("ALE/Pong-v5", engine="gymnasium"), 1).spec.frames == 4
    assert not is_preprocessed("CartPole-v1", {})


@pytest.mark.parametrize(
    ("settings", "engine", "words"),
    [
        ({"protocol": "clasic"}, "auto", "did you mean 'classic'"),
        ({"frameskip": 1}, "auto", "frameskip must be at least 2"),
        ({"noop_max": True}, "auto", "noop_max must be of the kind int"),
        ({"repeat_action_probability": 2}, "auto", "between 0 and 1"),
        ({"obs_type": "ram"}, "ale", "raw game"),
    ],
)
def test_a_mistake_is_named(settings, engine, words):
    with pytest.raises(UserError, match=words):
        registry.resolve("ALE/Pong-v5", engine=engine, env_kwargs=settings)


def test_engines_that_do_not_have_an_id_say_so():
    with pytest.raises(UserError, match="ids begin with ALE/"):
        registry.resolve("CartPole-v1", engine="ale")
    with pytest.raises(UserError, match="did you mean 'ALE/Pong-v5'"):
        registry.resolve("ALE/Pongg-v5")


def test_the_protocol_is_told_in_words():
    assert described("ALE/Pong-v5", {}).startswith("machado: sticky actions 0.25, no no-ops, minimal action set, frame skip 4")
    assert described("ALE/Pong-v5", {"protocol": "classic"}).startswith("classic: no sticky actions, 1 to 30 no-ops at the start")
    assert described("CartPole-v1", {}) is None
    assert atari_settings({"protocol": "classic", "noop_max": 5}).noop_max == 5


def test_areas_are_averages():
    weights = area_weights(210, 84)
    np.testing.assert_allclose(weights.sum(1), 1, rtol=1e-6)
    np.testing.assert_allclose(weights[1][:6], [0, 0, 0.2, 0.4, 0.4, 0], atol=1e-6)


def test_clipped_rewards_and_lost_lives_are_for_learning_only():
    wrapper = wrappers.from_settings([{"name": "clip_reward"}, {"name": "end_at_cost"}])
    reward, no = jnp.array([7.0, -0.5, 0.0]), jnp.zeros(3, bool)
    raw = Step(jnp.zeros((3, 1)), jnp.zeros((3, 1)), reward, jnp.array([0.0, 1.0, 1.0]), no, no, jnp.array([True, True, False]))
    memory, _ = wrapper.init(((), ()), raw.obs)
    _, seen = wrapper.step(((), ()), memory, raw.obs, jnp.zeros(3, jnp.int32), raw)
    np.testing.assert_array_equal(seen.reward, [1, -0.5, 0])
    np.testing.assert_array_equal(seen.terminated, [False, True, False])
    with pytest.raises(UserError, match="above 0"):
        wrappers.clip_reward(0)
