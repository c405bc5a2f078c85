"""OpenSpiel's Monte-Carlo tree search at Connect Four. It runs in .venv-opponents, in a process of its own.

A line in: the columns played so far; a line out: its move. With a solver in its tree and uct_c 2, as OpenSpiel's own example.
"""

import sys

import pyspiel


def main(rollouts: int, seed: int) -> None:
    """Answer until the input ends."""
    game = pyspiel.load_game("connect_four")
    for number, line in enumerate(sys.stdin):
        state = game.new_initial_state()
        for column in line.strip():
            state.apply_action(int(column))
        # A fresh one each time: no answer depends on the games before it.
        evaluator = pyspiel.RandomRolloutEvaluator(1, seed + 2 * number)
        bot = pyspiel.MCTSBot(game, evaluator, 2.0, rollouts, 1000, True, seed + 2 * number + 1, False)
        print(bot.step(state), flush=True)


if __name__ == "__main__":
    main(int(sys.argv[1]), int(sys.argv[2]))
