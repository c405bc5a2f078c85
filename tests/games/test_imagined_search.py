"""Search through a model: where the model is the rules themselves it is the search by the rules, move for move."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gymnasium import spaces

import tic_tac_toe_lines as lines
from thorndike.functional.value_transform import Scale
from thorndike.games.board_view import View
from thorndike.games.imagined_search import Imagination, imagine, think
from thorndike.games.search import SEARCHES, SearchSettings, search
from thorndike.games.tic_tac_toe import TIC_TAC_TOE, TicTacToePosition
from thorndike.networks.learned_model import Judgement, Model, ModelShape, learned_model
from thorndike.networks.masking import FORBIDDEN

pytestmark = pytest.mark.usefixtures("quick_compile")

KEY, SCALE = jax.random.key(3), Scale(1.0, 201)


def made_up(pieces):
    """Logits and a value, by the position alone."""
    seed = pieces[..., 0] * 7.0 + pieces[..., 1] * 13.0
    return jnp.sin(seed[..., None] + jnp.arange(9, dtype=jnp.float32)[None] * 1.7), 0.8 * jnp.sin(seed * 0.37 + 1.0)


def positions_of(state):
    return TicTacToePosition(state[:, :2].astype(jnp.uint32))


def perfect_model() -> Model:
    """A state is the pieces, what the step to it earned its mover, and whether the game is over; finished games stay as they are."""

    def follow(params, state, action):
        del params
        before = positions_of(state)
        after = jax.vmap(lambda p, a: TIC_TAC_TOE.step(p, a, KEY))(before, action)
        over = jax.vmap(TIC_TAC_TOE.terminated)(after)
        movers = jax.vmap(TIC_TAC_TOE.player)(before)
        reward = jnp.take_along_axis(jax.vmap(TIC_TAC_TOE.rewards)(after), movers[:, None], axis=1)[:, 0]
        new = jnp.concatenate([after.pieces.astype(jnp.float32), reward[:, None], over[:, None].astype(jnp.float32)], axis=1)
        still = jnp.concatenate([state[:, :2], jnp.zeros_like(state[:, :1]), state[:, 3:]], axis=1)
        return jnp.where(state[:, 3:] > 0, still, new)

    def judge(params, state):
        del params
        over, (logits, value) = state[:, 3] > 0, made_up(state[:, :2])
        legal = jax.vmap(TIC_TAC_TOE.legal)(positions_of(state)) | over[:, None]
        said = jnp.log(jnp.maximum(SCALE.probabilities(jnp.stack([jnp.where(over, 0.0, value), state[:, 2]])), 1e-30))
        return Judgement(jnp.where(legal, logits, FORBIDDEN), said[0], said[1])

    return Model(None, lambda params, obs: obs, follow, judge)


def evaluate_made_up(params, positions, key):
    del params, key
    return made_up(positions.pieces.astype(jnp.float32))


@pytest.mark.parametrize("kind", SEARCHES)
def test_a_perfect_model_is_searched_as_the_rules_are(kind):
    settings = SearchSettings(kind=kind, simulations=24)
    pieces = [(0, 0), (0b1, 0b10), (0b000010001, 0b100000010), (0b11, 0b11000), (0b10100001, 0b01010010)]
    batch = lines.batch(pieces)
    by_rules = search(TIC_TAC_TOE, evaluate_made_up, settings, (), batch, KEY, explore=False)
    obs = jnp.concatenate([batch.pieces.astype(jnp.float32), jnp.zeros((len(pieces), 2))], axis=1)
    view = View(
        9, spaces.Box(0, np.inf, (4,)), lambda obs: obs, lambda seen: jax.vmap(TIC_TAC_TOE.legal)(positions_of(seen)), lambda batch: batch
    )
    imagined = imagine(Imagination(perfect_model(), SCALE, -1.0, view), settings, (), obs, jax.random.split(KEY)[1], False)
    np.testing.assert_array_equal(imagined.visits, by_rules.visits)
    np.testing.assert_allclose(imagined.policy, by_rules.policy, atol=1e-2)
    np.testing.assert_allclose(imagined.value, by_rules.value, atol=1e-2)


@pytest.mark.parametrize("kind", SEARCHES)
def test_no_forbidden_action_is_found_and_values_of_any_size_are_searched(kind):
    model = learned_model(spaces.Box(-1.0, 1.0, (3,)), 4, 11, ModelShape((8,), "nature", 6, 8))
    obs, legal = jnp.linspace(-1, 1, 15).reshape(5, 3), np.array([[True, False, True, False]] * 4 + [[False, True, False, False]])
    params = model.network.init(KEY, obs)
    view = View(4, spaces.Box(-1.0, 1.0, (3,)), lambda obs: obs, lambda seen: jnp.asarray(legal), lambda batch: batch)
    imagination = Imagination(model, Scale(1e4, 11), 0.99, view)
    found = imagine(imagination, SearchSettings(kind, 8, rescale_values=True), params, obs, KEY, True)
    assert (np.asarray(found.policy)[~legal] == 0).all() and legal[np.arange(5), found.action].all()
    assert np.isfinite(found.value).all()
    assert (np.asarray(think(imagination, params, obs).logits)[~legal] == FORBIDDEN).all()
