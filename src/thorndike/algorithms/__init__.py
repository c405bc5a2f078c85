"""One file, one algorithm. This list is all that is imported until one of them is chosen."""

from typing import NamedTuple


class Entry(NamedTuple):
    """Where an algorithm lives and what it is, in one line."""

    module: str
    description: str


ALGORITHMS: dict[str, Entry] = {
    "ppo": Entry("thorndike.algorithms.ppo", "Proximal policy optimisation: actor-critic; all kinds of actions"),
    "a2c": Entry("thorndike.algorithms.a2c", "Advantage actor-critic, the synchronous A3C; all kinds of actions"),
    "reinforce": Entry(
        "thorndike.algorithms.reinforce", "Policy gradient by whole returns, with or without a baseline; all kinds of actions"
    ),
    "dqn": Entry("thorndike.algorithms.dqn", "Deep Q-network: replay and target network; double, dueling, n-step; Discrete actions"),
    "q_learning": Entry("thorndike.algorithms.q_learning", "Q-learning from a table; SARSA, expected SARSA, double Q, Q(lambda)"),
    "planning": Entry("thorndike.algorithms.planning", "Value iteration, policy iteration, evaluation, finite horizon on a known model"),
}
"""Name on the command line -> entry. A new algorithm is one more line here."""
