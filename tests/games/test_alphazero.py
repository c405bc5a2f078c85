"""AlphaZero: its losses, what it refuses, and tic-tac-toe learnt from nothing until no line is lost."""

import json
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import thorndike as td
import tic_tac_toe_lines as lines
from thorndike.algorithms.alphazero import Config, alphazero, alphazero_loss
from thorndike.api.building import build_algorithm
from thorndike.environments.wrappers import chain, normalize_observation
from thorndike.errors import UserError
from thorndike.games.environment import game_environment, observed_position
from thorndike.games.self_play import Batch
from thorndike.games.tic_tac_toe import TIC_TAC_TOE
from thorndike.networks.board import TOWERS, board_network, win_value
from thorndike.networks.network import Network
from thorndike.training.sources import compiled_source


def test_the_loss_is_that_of_a_slow_loop():
    random = np.random.default_rng(0)
    count, actions = 6, 4
    logits, win = random.normal(size=(count, actions)), random.normal(size=count)
    legal = np.array([[True, True, True, False]] * 3 + [[True] * 4] * 3)
    policy = np.where(legal, random.random((count, actions)), 0.0)
    policy /= policy.sum(axis=1, keepdims=True)
    outcome, known, taught = np.array([1, 0, -1, 1, -1, 0.0]), np.array([1, 1, 0, 1, 1, 0.0]), np.array([1, 0, 1, 1, 1, 1.0])
    policy_loss = value_loss = entropy = 0.0
    for i in range(count):
        exponents = np.exp(logits[i]) * legal[i]
        log_policy = np.log(np.maximum(exponents / exponents.sum(), 1e-30))
        policy_loss += taught[i] / taught.sum() * -sum(policy[i, a] * log_policy[a] for a in range(actions) if legal[i, a])
        entropy += taught[i] / taught.sum() * -sum(policy[i, a] * np.log(policy[i, a]) for a in range(actions) if policy[i, a] > 0)
        wins, chance = (outcome[i] + 1) / 2, 1 / (1 + np.exp(-win[i]))
        value_loss += known[i] / known.sum() * -(wins * np.log(chance) + (1 - wins) * np.log(1 - chance))
    network = Network(lambda key, board: (), lambda params, board: (jnp.asarray(logits, jnp.float32), jnp.asarray(win, jnp.float32)))
    numbers = (jnp.asarray(x, jnp.float32) for x in (policy, taught, outcome, known))
    loss, metrics = alphazero_loss((), Batch(jnp.zeros((count, 2, 2, 1)), jnp.asarray(legal), *numbers), network, 0.5)
    assert float(metrics["train/policy_loss"]) == pytest.approx(policy_loss, rel=1e-5)
    assert float(metrics["train/value_loss"]) == pytest.approx(value_loss, rel=1e-5)
    assert float(metrics["train/policy_kl"]) == pytest.approx(policy_loss - entropy, rel=1e-4)
    assert float(loss) == pytest.approx(policy_loss + 0.5 * value_loss, rel=1e-5)


@pytest.mark.parametrize("tower", TOWERS)
def test_every_tower_sees_where_pieces_are_and_begins_without_preference(tower: str):
    network = board_network(7, tower, 16, 1)
    board = jax.random.bernoulli(jax.random.key(0), 0.4, (3, 6, 7, 2)).astype(jnp.float32)
    params = network.init(jax.random.key(1), board[:1])
    logits, win = network.apply(params, board)
    assert logits.shape == (3, 7) and win.shape == (3,)
    assert float(jnp.abs(logits).max()) < 1.0 and float(jnp.abs(win_value(win)).max()) < 0.5
    gradient = jax.grad(lambda b: network.apply(params, b)[0].sum())(board)
    assert (jnp.abs(gradient).sum(axis=0) > 0).mean() > 0.9


def test_what_is_no_game_of_two_is_refused():
    with pytest.raises(UserError, match="learns games of two players, such as connect_four, and CartPole-v1 is none"):
        build_algorithm("alphazero", {}, td.make("CartPole-v1", 2).spec, None)
    with pytest.raises(UserError, match="train ppo or alphazero or muzero on it"):
        build_algorithm("a2c", {}, td.make("tic_tac_toe", 2).spec, None)
    spec = game_environment(TIC_TAC_TOE, 2).spec
    with pytest.raises(UserError, match=r"two players without dice.*train it with ppo"):
        alphazero(Config(), spec._replace(game=TIC_TAC_TOE._replace(has_chance=True)))
    for name in ("alphazero", "muzero"):
        with pytest.raises(UserError, match=r"tic_tac_toe is learnt from its board as the rules show it, which a wrapper changes"):
            build_algorithm(name, {}, normalize_observation().spec(spec), None)


def test_the_newest_average_is_what_asks_to_pass_the_gate_and_the_best_is_what_plays(monkeypatch: pytest.MonkeyPatch):
    small = {"n_steps": 2, "batch_size": 16, "gradient_steps": 1, "num_simulations": 2, "width": 8, "blocks": 0}
    environment = game_environment(TIC_TAC_TOE, 4)
    plain, gated = alphazero(Config(**small), environment.spec), alphazero(Config(**small, gate_every=1), environment.spec)
    source, seen = compiled_source(environment, gated, chain()), []
    monkeypatch.setattr("thorndike.algorithms.alphazero.try_gate", lambda game, decide, how, gate, candidate, *rest: (candidate, {}))

    def once(key):
        state, ungated, noise = gated.init(key), plain.init(key), jax.tree.map(lambda leaf: leaf[0], source.draw(key, 1))
        assert gated.actor(state) is state.gate.best and plain.actor(ungated) is ungated.average
        later, _ = gated.update(state, source.collect(source.init(key), gated.actor(state), noise)[1], key)
        seen.extend(one is other for one, other in zip(jax.tree.leaves(later.gate), jax.tree.leaves(later.average), strict=True))

    jax.eval_shape(once, jax.random.key(0))
    assert seen and all(seen)


def test_a_run_is_saved_loaded_and_gone_on_with(tmp_path: Path, quick_compile: None):
    """With the heads that no search asks, which are exported beside the others, and a gate that lets all pass."""
    small = {"n_steps": 2, "batch_size": 32, "gradient_steps": 1, "learning_starts": 64, "num_simulations": 4, "width": 8, "blocks": 0}
    small |= {"ownership_coef": 1.0, "score_coef": 0.1, "gate_every": 2, "gate_games": 2, "gate_threshold": 0.0}
    game = f"{Path(__file__).parents[1] / 'squares_game.py'}:SQUARES"
    result = td.train("alphazero", game, steps=256, num_envs=16, settings=small, preset="none", output=tmp_path)
    evaluation = td.load(result.run).evaluate(episodes=10)
    assert -1 <= evaluation.mean <= 1 and len(evaluation.rows) == 10
    assert td.resume(result.run, steps=320).steps == 320
    logged = json.loads((result.run / "metrics.jsonl").read_text().splitlines()[-1])
    assert {"train/ownership_loss", "train/score_loss", "train/gate_score"} <= set(logged) and logged["train/gates_passed"][0] > 1
    policy = td.load(result.run)
    obs = jax.tree.map(np.asarray, observed_position(TIC_TAC_TOE, TIC_TAC_TOE.init(jax.random.key(0))))
    action, _ = policy.predict(obs)
    assert 0 <= int(action) < 9 and abs(float(policy.value(obs))) <= 1


@pytest.mark.slow
def test_no_line_of_tic_tac_toe_is_lost_after_two_minutes(tmp_path: Path, capsys: pytest.CaptureFixture):
    result = td.train("alphazero", "tic_tac_toe", output=tmp_path)
    assert result.cpu_s < 120
    for simulations in (0, 64):
        choose = lines.chooser(result.run, simulations)
        walked = [lines.walk(choose, agent) for agent in (0, 1)]
        share = lines.optimal_share(choose)
        with capsys.disabled():
            print(f"\n{result.cpu_s:.0f} CPU-s; {simulations} simulations: first {walked[0]}, second {walked[1]}, best moves {share:.4f}")
        assert walked[0].lost == walked[1].lost == 0
        assert share > 0.97
