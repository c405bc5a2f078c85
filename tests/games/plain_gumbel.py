"""The search of Gumbel AlphaZero in slow Python, from the paper: Danihelka et al. 2022, "Policy improvement by planning with Gumbel".

Equations are the paper's: sequential halving at the root (section 3, figure 1), completed values and the improved policy (eqs. 10, 11), the
mixed value (appendix D, eq. 33), the choice below the root (section 5, eq. 14).
"""

import math
from collections.abc import Callable, Hashable, Sequence
from typing import NamedTuple

State = Hashable | object


class Moved(NamedTuple):
    """What a move does."""

    state: State
    reward: float
    """Of the mover."""
    sign: float
    """What a value of the next state is multiplied by for the mover: -1 where the other one moves there, 0 where the game is over."""


class Rules(NamedTuple):
    predict: Callable[[State], tuple[dict[int, float], float]]
    """State -> the logits of its legal moves, and its value for the mover."""
    move: Callable[[State, int], Moved]


class Scale(NamedTuple):
    """Of sigma: ``(c_visit + max N) c_scale q``, of values stretched to [0, 1] first if ``rescale``."""

    c_scale: float
    c_visit: float = 50.0
    rescale: bool = False


class Node:
    def __init__(self, rules: Rules, state: State, over: bool = False) -> None:
        self.state, self.over = state, over
        logits, value = ({}, 0.0) if over else rules.predict(state)
        highest = max(logits.values(), default=0.0)
        self.logits = {move: logit - highest for move, logit in logits.items()}
        self.raw = value
        self.returns = [value]
        self.edges: dict[int, Edge] = {}

    @property
    def value(self) -> float:
        return sum(self.returns) / len(self.returns)

    def visits(self, move: int) -> int:
        return self.edges[move].visits if move in self.edges else 0


class Edge(NamedTuple):
    reward: float
    sign: float
    child: Node
    passed: list[float]
    """What each visit brought back to the mover."""

    @property
    def visits(self) -> int:
        return len(self.passed)

    @property
    def q(self) -> float:
        return self.reward + self.sign * self.child.value


def softmax(logits: dict[int, float]) -> dict[int, float]:
    highest = max(logits.values())
    weights = {move: math.exp(logit - highest) for move, logit in logits.items()}
    return {move: weight / sum(weights.values()) for move, weight in weights.items()}


def mixed_value(node: Node) -> float:
    """Eq. 33: the network's value, and the prior's mean of what the moves tried are worth, by how often they were tried."""
    prior = softmax(node.logits)
    mass = sum(prior[move] for move in node.edges)
    if mass == 0:
        return node.raw
    visits = sum(edge.visits for edge in node.edges.values())
    return (node.raw + visits / mass * sum(prior[move] * edge.q for move, edge in node.edges.items())) / (1 + visits)


def sigma(node: Node, scale: Scale) -> dict[int, float]:
    """Of the completed values (eq. 10): a move not yet tried is worth the mixed value."""
    mixed = mixed_value(node)
    completed = {move: node.edges[move].q if move in node.edges else mixed for move in node.logits}
    if scale.rescale:
        low, high = min(completed.values()), max(completed.values())
        completed = {move: (q - low) / max(high - low, 1e-8) for move, q in completed.items()}
    most = max((edge.visits for edge in node.edges.values()), default=0)
    return {move: (scale.c_visit + most) * scale.c_scale * q for move, q in completed.items()}


def improved_policy(node: Node, scale: Scale) -> dict[int, float]:
    """Eq. 11."""
    values = sigma(node, scale)
    return softmax({move: logit + values[move] for move, logit in node.logits.items()})


def below_the_root(node: Node, scale: Scale) -> int:
    """Eq. 14: what brings the shares of visits nearest to the improved policy."""
    policy, total = improved_policy(node, scale), sum(edge.visits for edge in node.edges.values())
    return max(policy, key=lambda move: policy[move] - node.visits(move) / (1 + total))


def visited_in_rounds(moves: int, simulations: int) -> list[int]:
    """Sequential halving: how many moves a round tries, until the simulations are spent. Each of about log2(m) phases has an equal part of
    them, and at least one round; the better half goes on to the next, never fewer than two."""
    rounds: list[int] = []
    going, phases = moves, max(1, math.ceil(math.log2(moves)))
    while sum(rounds) < simulations:
        rounds += [going] * max(1, simulations // (phases * going))
        going = max(2, going // 2) if moves > 1 else 1
    return rounds


def simulate(rules: Rules, scale: Scale, node: Node, move: int) -> float:
    """Down by ``move``, and then by eq. 14, until a position is new or the game over; what that brings to the mover of ``node``."""
    edge = node.edges.get(move)
    if edge is None:
        moved = rules.move(node.state, move)
        edge = node.edges[move] = Edge(moved.reward, moved.sign, Node(rules, moved.state, moved.sign == 0), [])
        brought = edge.child.raw
    elif edge.child.over:
        brought = 0.0
    else:
        brought = simulate(rules, scale, edge.child, below_the_root(edge.child, scale))
    result = edge.reward + edge.sign * brought
    edge.passed.append(result)
    node.returns.append(result)
    return result


def gumbel_search(
    rules: Rules, state: State, simulations: int, considered: int, scale: Scale, gumbel: Sequence[float]
) -> tuple[Node, int, dict[int, float]]:
    """The root after the search, the move chosen, and the improved policy. ``gumbel`` is the noise of every action, zeros for none."""
    root = Node(rules, state)

    def score(move: int) -> float:
        return gumbel[move] + root.logits[move] + sigma(root, scale)[move]

    spent = 0
    for number, tried in enumerate(visited_in_rounds(min(considered, len(root.logits)), simulations)):
        for _ in range(min(tried, simulations - spent)):
            # Those that went through every round so far, and are yet to be tried in this one.
            waiting = [move for move in root.logits if root.visits(move) == number]
            simulate(rules, scale, root, max(waiting, key=score))
            spent += 1
    most = max(edge.visits for edge in root.edges.values())
    best = max((move for move, edge in root.edges.items() if edge.visits == most), key=score)
    return root, best, improved_policy(root, scale)
