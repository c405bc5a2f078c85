"""The compiled MinAtar games against the package minatar 1.0.15: the same random numbers and actions, equal at every step."""

import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from minatar import Environment

from thorndike.environments.native import factory
from thorndike.environments.native.minatar.asterix import ASTERIX
from thorndike.environments.native.minatar.breakout import BREAKOUT
from thorndike.environments.native.minatar.freeway import FREEWAY, speeds
from thorndike.environments.native.minatar.game import DOWN, FIRE, LEFT, NOOP, RIGHT, UP, of_the_six
from thorndike.environments.native.minatar.seaquest import SEAQUEST
from thorndike.environments.native.minatar.space_invaders import SPACE_INVADERS
from thorndike.environments.native.randomness import uniforms
from thorndike.environments.native.vectorize import Dynamics, vectorize
from thorndike.environments.registry import reference, resolve
from thorndike.errors import UserError

BATCH = 16
STEPS = 640
"""16 x 640 = 10,240 steps a game."""


def nothing_in_mind(state: tuple) -> jax.Array:
    return jnp.full(BATCH, -1)


def follow_the_ball(state: tuple) -> jax.Array:
    return jnp.where(state.x > state.paddle, RIGHT, jnp.where(state.x < state.paddle, LEFT, NOOP))


def go_up(state: tuple) -> jax.Array:
    return jnp.full(BATCH, UP)


def bob_at_the_surface(state: tuple) -> jax.Array:
    return jnp.where(state.aboard == 0, FIRE, jnp.where(state.y > 1, UP, DOWN))


class Scripted:
    """Stands in for NumPy's random generator: gives the numbers that the compiled game drew."""

    def __init__(self) -> None:
        self.numbers: Iterator[float] = iter(())

    def give(self, numbers: np.ndarray) -> None:
        self.numbers = iter(numbers)

    def rand(self, count: int | None = None) -> np.ndarray | float:
        return float(next(self.numbers)) if count is None else np.where(self.right, 0.75, 0.25)

    def randint(self, low: int, high: int | None = None, size: int | None = None) -> np.ndarray | int:
        low, high = (0, low) if high is None else (low, high)
        if size is None:
            return low + int(np.float32(next(self.numbers)) * np.float32(high - low))
        # Freeway's cars: one number gives direction and speed.
        assert (low, high, size) == (1, 6, 8)
        drawn = jnp.asarray([next(self.numbers) for _ in range(size)], jnp.float32)
        self.right, interval = (np.asarray(part) for part in speeds(drawn))
        return interval.copy()


def simulate(dynamics: Dynamics, aim: Callable[[tuple], jax.Array], steps: int) -> dict[str, np.ndarray]:
    """Random play, ``[steps, batch, ...]``; half of the lanes often take the action of `aim`, and none that ends the game."""
    environment = vectorize(dynamics, BATCH)
    count = int(dynamics.action_space.n)
    tried = jnp.broadcast_to(jnp.arange(count, dtype=jnp.int32)[:, None], (count, BATCH))
    careful = jnp.linspace(-1.0, 1.0, BATCH)[None]

    @jax.jit
    def run(key: jax.Array) -> dict[str, jax.Array]:
        key_init, key_draw, key_act = jax.random.split(key, 3)
        drawn = environment.draw(key_draw, steps)

        def one(state: tuple, given: tuple) -> tuple:
            numbers, noise = given
            ends = jax.vmap(lambda action: dynamics.step(state.inner, action, noise[0])[2])(tried)
            liked = 2.0 * ends - 1.0 * (tried == aim(state.inner.game)[None])
            action = jnp.argmin(numbers[1:] + jnp.where(numbers[:1] < careful, liked, 0.0), axis=0).astype(jnp.int32)
            after, step = environment.step(state, action, noise)
            return after, (action, step.obs, step.next_obs, step.reward, step.terminated)

        numbers = jax.random.uniform(key_act, (steps, 1 + count, BATCH))
        state, first_obs = environment.init(key_init)
        names = ("action", "obs", "next_obs", "reward", "terminated")
        trace = dict(zip(names, jax.lax.scan(one, state, (numbers, drawn))[1], strict=True))
        starts = dynamics.draw_reset(key_init, (BATCH,)), drawn[1]
        # Games that always start alike draw nothing for it.
        first, later = (jnp.zeros((1, BATCH), jnp.uint32) if isinstance(words, tuple) else words.reshape(-1, BATCH) for words in starts)
        return {
            **trace,
            "first_obs": first_obs,
            "numbers": uniforms(drawn[0], 9, 0.0, 1.0),
            "first": uniforms(first, 8, 0.0, 1.0)[0],
            "start": uniforms(jnp.broadcast_to(later, (steps, BATCH)), 8, 0.0, 1.0),
        }

    return jax.tree.map(np.asarray, run(jax.random.key(11)))


class Theirs:
    """The package's game, played with the numbers of ours."""

    def __init__(self, game: str, settings: dict, prepare: Callable[[object], None]) -> None:
        self.game, self.prepare = Environment(game, **settings), prepare
        self.random = self.game.random = self.game.env.random = Scripted()
        self.diver_numbers: np.ndarray = np.zeros(0)
        if game == "seaquest":
            spawn = self.game.env._spawn_diver
            self.game.env._spawn_diver = lambda: (self.random.give(self.diver_numbers), spawn())

    def start(self, numbers: np.ndarray) -> np.ndarray:
        self.random.give(numbers)
        self.game.reset()
        # The package would repeat the last action of the episode before.
        self.game.last_action = 0
        self.prepare(self.game.env)
        return self.game.state()

    def step(self, action: int, numbers: np.ndarray) -> tuple[np.ndarray, float, bool]:
        self.random.give(numbers)
        self.diver_numbers = numbers[4:]
        reward, terminated = self.game.act(action)
        return self.game.state(), reward, terminated


def check(
    name: str,
    settings: dict | None = None,
    aim: Callable = nothing_in_mind,
    ours: dict | None = None,
    prepare: Callable = lambda env: None,
    steps: int = STEPS,
) -> dict[str, np.ndarray]:
    """Every step of ours is the package's; the trace, to look at what has happened in it. `ours` and `prepare` change how a game starts."""
    game, dynamics = GAMES[name], factory(f"MinAtar/{name}-v0")(**settings or {})
    if ours is not None:
        reset = dynamics.reset
        dynamics = dynamics._replace(reset=lambda noise: started(reset(noise), ours))
    mine = simulate(dynamics, aim, steps)
    for lane in range(BATCH):
        theirs = Theirs(game, settings or {}, prepare)
        np.testing.assert_array_equal(mine["first_obs"][lane], theirs.start(mine["first"][lane]))
        for step in range(steps):
            where = f"{name}, lane {lane}, step {step}"
            obs, reward, terminated = theirs.step(mine["action"][step, lane], mine["numbers"][step, lane])
            assert np.array_equal(mine["next_obs"][step, lane], obs), where
            assert (mine["reward"][step, lane], mine["terminated"][step, lane]) == (reward, terminated), where
            if terminated:
                obs = theirs.start(mine["start"][step, lane])
            assert np.array_equal(mine["obs"][step, lane], obs), where
    return mine


def started(state: tuple, values: dict) -> tuple:
    changed = {name: jnp.full_like(getattr(state.game, name), value) for name, value in values.items()}
    return state._replace(game=state.game._replace(**changed))


GAMES = {"Asterix": "asterix", "Breakout": "breakout", "Freeway": "freeway", "Seaquest": "seaquest", "SpaceInvaders": "space_invaders"}
AIMS = {"Breakout": follow_the_ball, "Freeway": go_up}


@pytest.mark.parametrize("name", GAMES)
def test_a_game_plays_as_the_package(name: str) -> None:
    trace = check(name, aim=AIMS.get(name, nothing_in_mind))
    assert trace["reward"].any()
    assert trace["terminated"].any() != (name == "Freeway")


@pytest.mark.slow
@pytest.mark.parametrize("name", ["Asterix", "Seaquest", "SpaceInvaders"])
def test_a_game_plays_as_the_package_with_settings(name: str) -> None:
    check(name, {"sticky_action_prob": 0.3, "difficulty_ramping": False}, steps=250)


def test_breakout_brings_new_bricks_as_the_package() -> None:
    def nearly_cleared(env: object) -> None:
        env.brick_map[:] = 0
        env.brick_map[3, 4:6] = 1

    trace = check("Breakout", aim=follow_the_ball, ours={"bricks": 0b11 << 24}, prepare=nearly_cleared, steps=250)
    assert (trace["obs"][..., 3].sum(axis=(2, 3)) > 20).any()


def test_freeway_ends_as_the_package() -> None:
    trace = check("Freeway", ours={"time_left": 90}, prepare=lambda env: setattr(env, "terminate_timer", 90), steps=200)
    assert trace["terminated"].any()


@pytest.mark.slow
@pytest.mark.parametrize(("aboard", "aim"), [(-1, bob_at_the_surface), (5, nothing_in_mind)])
def test_seaquest_grows_as_hard_as_the_package(aboard: int, aim: Callable) -> None:
    trace = check("Seaquest", aim=aim, ours={"aboard": aboard}, prepare=lambda env: setattr(env, "diver_count", aboard))
    enemies = trace["obs"][..., 5:7].sum(axis=(2, 3, 4))
    if aboard == 5:
        assert trace["reward"].max() > 3, "surfacing with six divers"
    else:
        assert enemies.max() >= 6, "the first levels have three at most"


def test_the_last_level_of_seaquest_is_played_as_the_package() -> None:
    def hardest(env: object) -> None:
        env.e_spawn_speed, env.move_speed, env.ramp_index, env.e_spawn_timer = 1, 2, 19, 0

    trace = check("Seaquest", ours={"level": 19, "enemy_timer": 0}, prepare=hardest)
    assert trace["obs"][..., 5:7].sum(axis=(2, 3, 4)).max() >= 12


def test_the_smaller_sets_of_actions_are_the_packages() -> None:
    for game in (ASTERIX, BREAKOUT, FREEWAY, SEAQUEST, SPACE_INVADERS):
        theirs = reference(resolve(f"MinAtar/{game.name}-v1")).unwrapped.action_set
        assert list(game.minimal_actions) == theirs
        assert of_the_six(jnp.arange(len(theirs)), theirs).tolist() == theirs


def test_the_smaller_set_of_actions_is_played() -> None:
    mine = factory("MinAtar/Breakout-v1")()
    # The first number of this word is 0.92: no sticky action.
    words = jnp.full(3, 8, jnp.uint32)
    after, _, _ = jax.jit(mine.step)(mine.reset(words), jnp.arange(3, dtype=jnp.int32), words)
    assert after.last_action.tolist() == [NOOP, LEFT, RIGHT]
    assert after.game.paddle.tolist() == [4, 3, 5]


def test_the_package_is_asked_for_where_it_is_needed_and_only_there(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    monkeypatch.delitem(gymnasium.registry, "MinAtar/Breakout-v0", raising=False)
    choice = resolve("MinAtar/Breakout-v0", env_kwargs={"sticky_action_prob": 0.0})
    assert choice.engine == "native"
    for ask in (lambda: reference(choice), lambda: resolve("MinAtar/Breakout-v0", engine="gymnasium")):
        with pytest.raises(UserError, match=r"pip install 'thorndike\[minatar\]'"):
            ask()


def test_training_does_not_import_the_package() -> None:
    code = (
        "import sys\n"
        "from thorndike.cli.environment_names import check_environment\n"
        "check_environment('MinAtar/Asterix-v1', engine='auto', env_kwargs={}, max_episode_steps=None, algorithm='ppo')\n"
        "print({'minatar', 'matplotlib', 'pandas', 'jax'} & set(sys.modules))\n"
    )
    source = Path(__file__).parents[2] / "src"
    done = subprocess.run([sys.executable, "-c", code], env={"PYTHONPATH": str(source)}, check=True, capture_output=True, text=True)
    assert done.stdout.strip() == "set()"


def test_a_game_can_be_filmed() -> None:
    environment = reference(resolve("MinAtar/Seaquest-v0"), "rgb_array")
    environment.reset(seed=0)
    picture = environment.render()
    assert picture.dtype == np.uint8 and picture.shape == (320, 320, 3) and np.ptp(picture) > 100


@pytest.mark.parametrize("chance", [-0.1, 1.5, "often"])
def test_a_chance_that_is_none_is_refused(chance: object) -> None:
    with pytest.raises(UserError, match="from 0 to 1"):
        factory("MinAtar/Freeway-v1")(sticky_action_prob=chance)
