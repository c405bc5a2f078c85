"""How fast games are played, beside a plain loop of pgx's Connect Four and mctx with the same network, batch and simulations.

python benchmarks/self_play.py                  into benchmarks/results/self_play.json; --simulations, --games, --tower, --width, --blocks

Both play the same number of moves of the same number of games, compiled into one scan, with Gumbel's search; rates are positions in which
somebody moved, a CPU-second of one core, the compiling left out, and medians of rounds in which each runs once. The shares of time are of
our loop: the network alone is asked as often as the search asks it, the game alone is stepped as often as in the loop and in the search;
the rest is the tree.
"""

import argparse
import json
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from statistics import median

import jax
import jax.numpy as jnp
import mctx
import pgx

from machine import keep_row, origin
from thorndike.algorithms.alphazero import Config, alphazero
from thorndike.games.connect_four import CONNECT_FOUR
from thorndike.games.environment import game_environment
from thorndike.networks.board import board_network, win_value

RESULT = Path(__file__).parents[1] / "benchmarks" / "results" / "self_play.json"


def cpu_seconds(runs: Mapping[str, Callable[[jax.Array], jax.Array]], rounds: int) -> dict[str, list[float]]:
    """Of each, a number a round; in a round all run one after the other, so that what slows the machine slows them all. Compiled before."""
    for run in runs.values():
        jax.block_until_ready(run(jax.random.key(0)))
    times: dict[str, list[float]] = {name: [] for name in runs}
    for number in range(rounds):
        for name, run in runs.items():
            began = time.process_time()
            jax.block_until_ready(run(jax.random.key(number)))
            times[name].append(time.process_time() - began)
    return times


def ours(config: Config, games: int, moves: int) -> Callable[[jax.Array], jax.Array]:
    environment = game_environment(CONNECT_FOUR, games)
    algorithm = alphazero(config, environment.spec)
    actor = jax.jit(lambda key: algorithm.actor(algorithm.init(key)))(jax.random.key(0))

    @jax.jit
    def play(key: jax.Array) -> jax.Array:
        key_init, key_act, key_step = jax.random.split(key, 3)
        state, obs = environment.init(key_init)
        noise = algorithm.draw(key_act, moves), environment.draw(key_step, moves)

        def step(carry, noise):
            state, obs, memory = carry
            memory, action, _ = algorithm.act(actor, memory, obs, noise[0])
            state, result = environment.step(state, action, noise[1])
            return (state, result.obs, memory), result.reward

        return jax.lax.scan(step, (state, obs, algorithm.memory(games)), noise)[1].sum()

    return play


def plain(config: Config, games: int, moves: int) -> Callable[[jax.Array], jax.Array]:
    """pgx and mctx, as their examples put them together."""
    rules = pgx.make("connect_four")
    network = board_network(7, config.tower, config.width, config.blocks)
    params = network.init(jax.random.key(0), jnp.zeros((1, 6, 7, 2)))
    step = jax.vmap(rules.step)

    def evaluate(state):
        logits, win = network.apply(params, state.observation.astype(jnp.float32))
        return jnp.where(state.legal_action_mask, logits, -1e9), win_value(win)

    def recurrent(params, key, action, state):
        mover = state.current_player
        state = step(state, action)
        logits, value = evaluate(state)
        reward = state.rewards[jnp.arange(games), mover]
        output = mctx.RecurrentFnOutput(
            reward=reward,
            discount=jnp.where(state.terminated, 0.0, -1.0),
            prior_logits=logits,
            value=jnp.where(state.terminated, 0.0, value),
        )
        return output, state

    @jax.jit
    def play(key: jax.Array) -> jax.Array:
        key, key_init = jax.random.split(key)
        state = jax.vmap(rules.init)(jax.random.split(key_init, games))

        def move(state, key):
            key_search, key_new = jax.random.split(key)
            logits, value = evaluate(state)
            root = mctx.RootFnOutput(prior_logits=logits, value=value, embedding=state)
            found = mctx.gumbel_muzero_policy((), key_search, root, recurrent, config.num_simulations, ~state.legal_action_mask)
            after = step(state, found.action)
            fresh = jax.vmap(rules.init)(jax.random.split(key_new, games))
            ended = after.terminated
            following = jax.tree.map(lambda a, b: jnp.where(ended.reshape((-1,) + (1,) * (a.ndim - 1)), a, b), fresh, after)
            return following, after.rewards.sum()

        return jax.lax.scan(move, state, jax.random.split(key, moves))[1].sum()

    return play


def network_alone(config: Config, games: int, asked: int) -> Callable[[jax.Array], jax.Array]:
    network = board_network(7, config.tower, config.width, config.blocks)
    params = network.init(jax.random.key(0), jnp.zeros((1, 6, 7, 2)))

    @jax.jit
    def ask(key: jax.Array) -> jax.Array:
        boards = jax.random.bernoulli(key, 0.3, (games, 6, 7, 2)).astype(jnp.float32)

        def once(carry, _):
            logits, win = network.apply(params, boards + carry)
            # What was said is looked at, so that nothing is left out.
            return (logits.sum() + win.sum()) * 1e-9, None

        return jax.lax.scan(once, jnp.zeros(()), None, length=asked)[0]

    return ask


def game_alone(games: int, stepped: int) -> Callable[[jax.Array], jax.Array]:
    """All that a search asks of the rules about a position, and the step."""

    def one(position, column):
        after = CONNECT_FOUR.step(position, column, jax.random.key(0))
        over = CONNECT_FOUR.terminated(after)
        following = jax.tree.map(lambda new, old: jnp.where(over, old, new), after, position)
        told = CONNECT_FOUR.observe(after).sum() + CONNECT_FOUR.rewards(after).sum() + CONNECT_FOUR.legal(after).sum()
        return following, told

    @jax.jit
    def play(key: jax.Array) -> jax.Array:
        positions = jax.vmap(CONNECT_FOUR.init)(jax.random.split(key, games))
        columns = jax.random.randint(key, (stepped, games), 0, 7)
        return jax.lax.scan(jax.vmap(one), positions, columns)[1].sum()

    return play


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--simulations", type=int, default=32)
    parser.add_argument("--games", type=int, default=256)
    parser.add_argument("--moves", type=int, default=16)
    parser.add_argument("--tower", default="mlp")
    parser.add_argument("--width", type=int, default=256)
    parser.add_argument("--blocks", type=int, default=2)
    parser.add_argument("--rounds", type=int, default=5)
    options = parser.parse_args()
    config = Config(num_simulations=options.simulations, tower=options.tower, width=options.width, blocks=options.blocks)
    positions, asked = options.games * options.moves, options.moves * (options.simulations + 1)
    runs = {
        "ours": ours(config, options.games, options.moves),
        "pgx and mctx": plain(config, options.games, options.moves),
        "network": network_alone(config, options.games, asked),
        "game": game_alone(options.games, asked),
    }
    spent = cpu_seconds(runs, options.rounds)
    rates = {name: [round(positions / seconds) for seconds in spent[name]] for name in ("ours", "pgx and mctx")}
    ratios = [round(theirs / own, 3) for own, theirs in zip(spent["ours"], spent["pgx and mctx"], strict=True)]
    shares = {name: round(median(spent[name]) / median(spent["ours"]), 3) for name in ("network", "game")}
    row = {
        **origin(),
        **vars(options),
        "positions_per_cpu_s": {name: median(values) for name, values in rates.items()},
        "rounds_positions_per_cpu_s": rates,
    }
    row |= {"ratio": median(ratios), "ratios": ratios, "shares": {**shares, "tree": round(1 - sum(shares.values()), 3)}}
    name = f"{options.tower} {options.width} x {options.blocks}, {options.simulations} simulations, {options.games} games"
    keep_row(RESULT, name, row)
    print(json.dumps(row))


if __name__ == "__main__":
    main()
