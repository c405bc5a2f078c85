"""One file, one algorithm. This list is all that is imported until one of them is chosen."""

from typing import NamedTuple

from thorndike.errors import UserError


class Entry(NamedTuple):
    """Where an algorithm lives and what it is, in one line."""

    module: str
    description: str
    actions: tuple[str, ...] = ()
    """The kinds of action space that it takes; empty for all of them."""
    num_envs: int = 8
    """Environments of each seed, where nobody says how many."""
    tabular: bool = False
    """Whether it learns in a table, without a network: masks and images are nothing to it."""
    network: bool = True
    """Whether a network of the user's own can take the place of its own."""
    learns_from: tuple[str, ...] = ("environment",)
    """``environment``, ``dataset``, or both."""
    plays: bool = False
    """Whether it learns games of two by playing itself."""
    only_games: bool = False
    """Whether it learns nothing else."""
    searches: bool = False
    """Whether it acts by a search, which needs a game's rules."""


ALGORITHMS: dict[str, Entry] = {
    "ppo": Entry(
        "thorndike.algorithms.ppo",
        "Proximal policy optimisation: actor-critic; all kinds of actions; games of two by playing itself",
        plays=True,
    ),
    "a2c": Entry("thorndike.algorithms.a2c", "Advantage actor-critic, the synchronous A3C; all kinds of actions"),
    "reinforce": Entry(
        "thorndike.algorithms.reinforce", "Policy gradient by whole returns, with or without a baseline; all kinds of actions"
    ),
    "a3c": Entry(
        "thorndike.algorithms.a3c", "Asynchronous advantage actor-critic: gradients of policies some updates old; all kinds of actions"
    ),
    "impala": Entry("thorndike.algorithms.impala", "Actor-critic that corrects for late actors by V-trace; all kinds of actions"),
    "trpo": Entry("thorndike.algorithms.trpo", "Trust region policy optimisation: natural gradient, bounded KL; all kinds of actions"),
    "dqn": Entry(
        "thorndike.algorithms.dqn",
        "Deep Q-network: replay and target network; every part of the family to switch on; Discrete actions",
        ("Discrete",),
        num_envs=4,
    ),
    "rainbow": Entry(
        "thorndike.algorithms.rainbow",
        "DQN with six improvements: double, dueling, n-step, prioritised, noisy, C51; Discrete actions",
        ("Discrete",),
        num_envs=4,
    ),
    "qr_dqn": Entry("thorndike.algorithms.qr_dqn", "DQN on quantiles of the return; Discrete actions", ("Discrete",), num_envs=4),
    "iqn": Entry(
        "thorndike.algorithms.iqn", "DQN on returns at random quantile levels; Munchausen; Discrete actions", ("Discrete",), num_envs=4
    ),
    "bootstrapped_dqn": Entry(
        "thorndike.algorithms.bootstrapped_dqn",
        "DQN that follows one of an ensemble with random priors each episode: deep exploration; Discrete actions",
        ("Discrete",),
        num_envs=4,
    ),
    "pqn": Entry(
        "thorndike.algorithms.pqn", "Q-network without replay or target, many environments; Discrete actions", ("Discrete",), num_envs=16
    ),
    "sac": Entry(
        "thorndike.algorithms.sac", "Soft actor-critic: off-policy, maximum entropy, learnt temperature; Box actions", ("Box",), num_envs=1
    ),
    "td3": Entry(
        "thorndike.algorithms.td3", "Twin delayed DDPG: off-policy, deterministic, two critics; Box actions", ("Box",), num_envs=1
    ),
    "ddpg": Entry(
        "thorndike.algorithms.ddpg", "Deep deterministic policy gradient: off-policy, one critic; Box actions", ("Box",), num_envs=1
    ),
    "tqc": Entry(
        "thorndike.algorithms.tqc", "Truncated quantile critics: SAC on quantiles of the return; Box actions", ("Box",), num_envs=1
    ),
    "crossq": Entry(
        "thorndike.algorithms.crossq",
        "SAC without target networks, batch-renormalised, wide critics; Box actions",
        ("Box",),
        num_envs=1,
        network=False,
    ),
    "redq": Entry(
        "thorndike.algorithms.redq", "SAC with ten critics and twenty updates a step: fewest steps; Box actions", ("Box",), num_envs=1
    ),
    "bc": Entry(
        "thorndike.algorithms.bc",
        "Behaviour cloning of a dataset, the baseline of offline learning; Discrete and Box actions",
        ("Discrete", "Box"),
        num_envs=1,
        learns_from=("dataset",),
    ),
    "cql": Entry(
        "thorndike.algorithms.cql",
        "Conservative Q-learning from a dataset; Discrete and Box actions",
        ("Discrete", "Box"),
        num_envs=1,
        learns_from=("dataset",),
    ),
    "iql": Entry(
        "thorndike.algorithms.iql",
        "Implicit Q-learning from a dataset: asks of no action outside of it; Discrete and Box actions",
        ("Discrete", "Box"),
        num_envs=1,
        learns_from=("dataset",),
    ),
    "td3_bc": Entry(
        "thorndike.algorithms.td3_bc",
        "TD3 from a dataset, kept near its actions; Box actions",
        ("Box",),
        num_envs=1,
        learns_from=("dataset",),
    ),
    "awac": Entry(
        "thorndike.algorithms.awac",
        "Advantage-weighted actor-critic: from a dataset, and online from there; Box actions",
        ("Box",),
        num_envs=1,
        learns_from=("dataset", "environment"),
    ),
    "q_learning": Entry(
        "thorndike.algorithms.q_learning",
        "Q-learning from a table; SARSA, expected SARSA, double Q, Q(lambda)",
        ("Discrete",),
        num_envs=1,
        tabular=True,
        network=False,
    ),
    "alphazero": Entry(
        "thorndike.algorithms.alphazero",
        "AlphaZero: a network and a tree search that learn a game of two by playing themselves; games",
        ("Discrete",),
        num_envs=256,
        network=False,
        plays=True,
        only_games=True,
        searches=True,
    ),
    "muzero": Entry(
        "thorndike.algorithms.muzero",
        "MuZero: a tree search through a learnt model; games and Discrete actions",
        ("Discrete",),
        network=False,
        plays=True,
        searches=True,
    ),
    "planning": Entry(
        "thorndike.algorithms.planning",
        "Value iteration, policy iteration, evaluation, finite horizon on a known model",
        ("Discrete",),
        tabular=True,
        network=False,
    ),
}
"""Name on the command line -> entry. A new algorithm is one more line here."""


def check_plays(algorithm: str, environment: str, of_two: bool) -> None:
    """Raises UserError if an algorithm for games is to learn something else, or another one a game ``of_two``, whose rewards take turns."""
    if ALGORITHMS[algorithm].only_games and not of_two:
        raise UserError(f"{algorithm} learns games of two players, such as connect_four, and {environment} is none: train it with ppo")
    if of_two and not ALGORITHMS[algorithm].plays:
        players = [name for name, entry in ALGORITHMS.items() if entry.plays]
        raise UserError(
            f"{environment} is a game of two players: train {' or '.join(players)} on it, which play themselves, not {algorithm}"
        )
