"""Strength by CPU-seconds of training, beside a plain loop of pgx's Connect Four and mctx as pgx's example of AlphaZero puts them together.

python benchmarks/strength.py ours --budget 130     train the preset that long, into benchmarks/results/strength.json
python benchmarks/strength.py plain --budget 900    the plain loop: 6 residual blocks of 64 channels, 32 simulations, one pass a batch
python benchmarks/strength.py plain_patches --budget 60    the plain loop with the network of the preset: what is won without the network
python benchmarks/strength.py --figure              both curves, docs/images/strength.png, and CPU-seconds to equal strength

Both are stopped at the same kind of points and judged alike: every second of the positions of benchmarks/data/connect_four.txt (600), 32
simulations a move, per cent of moves after which the game is worth less than after the best one. CPU-seconds are those of playing and
learning on one core; compiling and judging are left out. A run that is interrupted keeps the points it has.
"""

import argparse
import json
import time
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import mctx
import numpy as np
import optax
import pgx

from connect_four import labelled, positions_of
from machine import keep_row, origin
from thorndike.algorithms.alphazero import Config, alphazero
from thorndike.environments.wrappers import chain
from thorndike.games.connect_four import CONNECT_FOUR
from thorndike.games.environment import game_environment, observed_position
from thorndike.games.settings import game_settings
from thorndike.networks.board import board_network
from thorndike.plotting.style import COLOURS, STYLE, save_figure
from thorndike.training.presets import find_preset
from thorndike.training.runner import runner
from thorndike.training.sources import compiled_source

ROOT = Path(__file__).parents[1]
RESULT, FIGURE = ROOT / "benchmarks" / "results" / "strength.json", ROOT / "docs" / "images" / "strength.png"
SIMULATIONS, JUDGED_TOGETHER = 32, 200
GAMES, MOVES, MINIBATCH, LONGEST = 64, 42, 256, 42
"""Of the plain loop: games side by side, moves of each between two rounds of learning (a whole game), positions of a minibatch."""
LABELS = {
    "ours": "thorndike train alphazero connect_four",
    "plain": "plain pgx + mctx loop, 6 x 64 convolutions",
    "plain_patches": "the same plain loop with our preset's network",
}
Learner = Iterator[tuple[int, Callable[[Sequence[str]], list[int]]]]
"""Positions played so far, and how it plays now; each step of the iterator learns a little more."""


def ours(seed: int) -> Learner:
    """The preset's settings and schedule, by the runner that ``train`` uses."""
    preset = find_preset("alphazero", "connect_four")
    settings = {**preset.settings, "total_steps": preset.steps, "eval_simulations": SIMULATIONS}
    environment = game_environment(CONNECT_FOUR, preset.num_envs, game_settings("connect_four", preset.env_kwargs))
    algorithm = alphazero(Config(**settings), environment.spec)
    bound = runner(algorithm, compiled_source(environment, algorithm, chain()), seed, range(1))
    noise = jax.tree.map(lambda x: x[0], algorithm.draw(jax.random.key(0), 1))
    # A batch of 200 positions is judged where 256 games are played: the noise has the games' axis.
    noise = jax.tree.map(lambda x: x[:JUDGED_TOGETHER] if x.ndim and x.shape[0] == preset.num_envs else x, noise)
    observed = jax.vmap(lambda position: observed_position(CONNECT_FOUR, position))

    @jax.jit
    def decide(actor, positions):
        return algorithm.greedy(actor, algorithm.memory(JUDGED_TOGETHER), observed(positions), noise)[1]

    carry, done = bound.init(), 0
    while True:
        # The first twenty iterations hold the warm-up and learning, so that both are compiled in them.
        carry, report = bound.advance(carry, done, 20)
        jax.block_until_ready(report)
        done += 20
        actor = jax.tree.map(lambda leaf: leaf[0].copy(), algorithm.actor(carry.learner))
        yield done * bound.steps_per_iteration, _judged(lambda games, actor=actor: decide(actor, positions_of(games)))


def plain(seed: int, tower: str = "conv", width: int = 64, blocks: int = 6) -> Learner:
    """Self-play of whole batches of games, then one pass over what was played, in minibatches of random order."""
    rules = pgx.make("connect_four")
    network = board_network(7, tower, width, blocks)
    params = network.init(jax.random.key(seed), jnp.zeros((1, 6, 7, 2)))
    optimizer = optax.adam(1e-3)
    opt_state = optimizer.init(params)
    play, learn, decide = _plain_play(rules, network), _plain_learn(network, optimizer), _plain_decide(rules, network)
    key, positions = jax.random.key(seed + 1), 0
    while True:
        key, key_play, key_learn = jax.random.split(key, 3)
        played = play(params, key_play)
        params, opt_state = learn(params, opt_state, played, key_learn)
        jax.block_until_ready(params)
        positions += GAMES * MOVES
        yield positions, _judged(lambda games, params=params: decide(params, _columns(games)))


class Played(NamedTuple):
    """What the plain loop learns from ``[T, B, ...]``."""

    board: jax.Array
    policy: jax.Array
    value: jax.Array
    known: jax.Array


def _plain_search(rules, network):
    """``(params, states, key, scale) -> mctx's output`` of a batch of pgx's states."""
    step = jax.vmap(rules.step)

    def evaluate(params, state):
        logits, value = network.apply(params, state.observation.astype(jnp.float32))
        return jnp.where(state.legal_action_mask, logits, -1e9), jnp.tanh(value)

    def recurrent(params, key, action, state):
        mover = state.current_player
        state = step(state, action)
        logits, value = evaluate(params, state)
        discount = jnp.where(state.terminated, 0.0, -1.0)
        reward = jnp.take_along_axis(state.rewards, mover[:, None], axis=1)[:, 0]
        value = jnp.where(state.terminated, 0.0, value)
        return mctx.RecurrentFnOutput(reward=reward, discount=discount, prior_logits=logits, value=value), state

    def search(params, state, key, scale):
        logits, value = evaluate(params, state)
        root = mctx.RootFnOutput(prior_logits=logits, value=value, embedding=state)
        return mctx.gumbel_muzero_policy(params, key, root, recurrent, SIMULATIONS, ~state.legal_action_mask, gumbel_scale=scale)

    return search


def _plain_play(rules, network):
    search, step, init = _plain_search(rules, network), jax.vmap(rules.step), jax.vmap(rules.init)

    @jax.jit
    def play(params, key):
        key_init, key_moves = jax.random.split(key)

        def move(state, key):
            key_search, key_new = jax.random.split(key)
            found = search(params, state, key_search, 1.0)
            after, mover = step(state, found.action), state.current_player
            reward = jnp.take_along_axis(after.rewards, mover[:, None], axis=1)[:, 0]
            ended, fresh = after.terminated, init(jax.random.split(key_new, GAMES))
            following = jax.tree.map(lambda a, b: jnp.where(ended.reshape((-1,) + (1,) * (a.ndim - 1)), a, b), fresh, after)
            return following, (state.observation.astype(jnp.float32), found.action_weights, reward, ended)

        state = init(jax.random.split(key_init, GAMES))
        board, policy, reward, ended = jax.lax.scan(move, state, jax.random.split(key_moves, MOVES))[1]

        def back(carry, row):
            value, known = carry
            reward, ended = row
            value, known = jnp.where(ended, reward, -value), ended | known
            return (value, known), (value, known)

        nothing = jnp.zeros(GAMES), jnp.zeros(GAMES, bool)
        value, known = jax.lax.scan(back, nothing, (reward, ended), reverse=True)[1]
        return Played(board, policy, value, known)

    return play


def _plain_learn(network, optimizer):
    def loss(params, batch):
        logits, value = network.apply(params, batch.board)
        policy = optax.softmax_cross_entropy(logits, batch.policy).mean()
        return policy + jnp.mean(optax.l2_loss(jnp.tanh(value), batch.value) * batch.known)

    @jax.jit
    def learn(params, opt_state, played, key):
        count = GAMES * MOVES // MINIBATCH
        order = jax.random.permutation(key, GAMES * MOVES)[: count * MINIBATCH].reshape(count, MINIBATCH)
        flat = jax.tree.map(lambda x: x.reshape((GAMES * MOVES, *x.shape[2:])), played)

        def one(carry, rows):
            params, opt_state = carry
            grads = jax.grad(loss)(params, jax.tree.map(lambda x: x[rows], flat))
            updates, opt_state = optimizer.update(grads, opt_state, params)
            return (optax.apply_updates(params, updates), opt_state), None

        return jax.lax.scan(one, (params, opt_state), order)[0]

    return learn


def _plain_decide(rules, network):
    search = _plain_search(rules, network)

    @jax.jit
    def decide(params, columns):
        def moved(state, column):
            after = rules.step(state, jnp.maximum(column, 0))
            return jax.tree.map(lambda new, old: jnp.where(column >= 0, new, old), after, state), None

        state = jax.vmap(lambda row: jax.lax.scan(moved, rules.init(jax.random.key(0)), row)[0])(columns)
        return search(params, state, jax.random.key(0), 0.0).action

    return decide


def _columns(games: Sequence[str]) -> np.ndarray:
    columns = np.full((len(games), LONGEST), -1, np.int32)
    for row, moves in zip(columns, games, strict=True):
        row[: len(moves)] = [int(column) for column in moves]
    return columns


def _judged(decide: Callable[[Sequence[str]], jax.Array]) -> Callable[[Sequence[str]], list[int]]:
    def choose(games: Sequence[str]) -> list[int]:
        parts = [np.asarray(decide(games[i : i + JUDGED_TOGETHER])) for i in range(0, len(games), JUDGED_TOGETHER)]
        return [int(move) for move in np.concatenate(parts)]

    return choose


def judge(choose: Callable[[Sequence[str]], list[int]]) -> dict[str, float]:
    """Per cent of errors over all 600 positions, and by stratum."""
    rows, wrong = labelled()[::2], {}
    for row, move in zip(rows, choose([row.moves for row in rows]), strict=True):
        wrong.setdefault(row.stratum, []).append(
            (-2 if row.signs[move] is None else row.signs[move]) < max(s for s in row.signs if s is not None)
        )
    everything = [each for values in wrong.values() for each in values]
    return {
        "all": round(100 * float(np.mean(everything)), 2),
        **{name: round(100 * float(np.mean(values)), 1) for name, values in wrong.items()},
    }


def measure(name: str, budget: float, seed: int, first: float) -> None:
    """Points at ``first`` CPU-seconds and each 1.5 times later, until the budget is spent."""
    learners = {"ours": ours, "plain": plain, "plain_patches": partial(plain, tower="patches", width=256, blocks=2)}
    learner = learners[name](seed)
    points, spent, due = [], 0.0, first
    positions, choose = next(learner)
    # The first round compiles; its seconds are those of its positions at the rate of the rounds after it.
    points.append({"cpu_s": 0.0, "positions": positions, "errors": judge(choose)})
    rounds = 1
    while spent < budget:
        began = time.process_time()
        positions, choose = next(learner)
        spent += time.process_time() - began
        rounds += 1
        if spent >= due or spent >= budget:
            due *= 1.5
            seconds = spent * rounds / (rounds - 1)
            points[0]["cpu_s"] = round(spent / (rounds - 1), 1)
            points.append({"cpu_s": round(seconds, 1), "positions": positions, "errors": judge(choose)})
            print(name, points[-1], flush=True)
            keep_row(RESULT, name, {**origin(), "seed": seed, "simulations": SIMULATIONS, "points": points})


def seconds_to(points: Sequence[dict], error: float) -> float | None:
    """CPU-seconds to the first point with no more errors than that; None: there is none."""
    return next((point["cpu_s"] for point in points if point["errors"]["all"] <= error), None)


def compare() -> None:
    """How many times the CPU-seconds the plain loop takes to what ours has come to at each point, or more than that; the figure."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    results = json.loads(RESULT.read_text(encoding="utf-8"))
    rows = []
    for name in (name for name in LABELS if name != "ours" and name in results):
        theirs = results[name]["points"]
        for point in results["ours"]["points"]:
            own, error = point["cpu_s"], point["errors"]["all"]
            reached = seconds_to(theirs, error)
            ratio = round((reached or theirs[-1]["cpu_s"]) / own, 1)
            rows.append(
                {"against": name, "errors": error, "ours_cpu_s": own, "cpu_s": reached, "ratio": ratio, "at_least": reached is None}
            )
    results["equal_strength"] = rows
    RESULT.write_text(json.dumps(results, indent=1) + "\n", encoding="utf-8")
    print(json.dumps(rows))
    with plt.rc_context(STYLE):
        figure, axes = plt.subplots(figsize=(7, 4))
        for colour, name in zip(COLOURS, (name for name in LABELS if name in results), strict=False):
            points = results[name]["points"]
            axes.plot([p["cpu_s"] for p in points], [p["errors"]["all"] for p in points], "o-", color=colour, label=LABELS[name])
        axes.set(xscale="log", ylim=(0, None), xlabel="CPU-seconds of training, one core", ylabel=f"errors, {SIMULATIONS} simulations (%)")
        axes.set_title("Connect Four: moves that give something away, by a perfect solver", fontsize=10)
        axes.legend()
        figure.tight_layout()
        save_figure(figure, FIGURE)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("learner", nargs="?", choices=tuple(LABELS))
    parser.add_argument("--budget", type=float, default=300, help="CPU-seconds")
    parser.add_argument("--first", type=float, default=5, help="CPU-seconds to the first point")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--figure", action="store_true")
    options = parser.parse_args()
    if options.learner is not None:
        measure(options.learner, options.budget, options.seed, options.first)
    if options.figure:
        compare()


if __name__ == "__main__":
    main()
