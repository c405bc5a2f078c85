"""Gumbel's search beside a plain Python one written from the paper, and both searches beside mctx's own golden trees."""

import json
from functools import cache
from importlib.util import find_spec
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from games.plain_gumbel import Moved, Node, Rules, Scale, gumbel_search, visited_in_rounds
from games.taking import TAKING
from thorndike.games.connect_four import CONNECT_FOUR
from thorndike.games.environment import opening
from thorndike.games.game import Game
from thorndike.games.packing import packing
from thorndike.games.search import SearchSettings, search
from thorndike.games.tic_tac_toe import TIC_TAC_TOE

pytestmark = pytest.mark.usefixtures("quick_compile")

KEY = jax.random.key(3)
POSITIONS = 4


def made_up(game: Game, position):
    """Numbers that stand for a network: logits and a value, by the position alone."""
    numbers = packing(game).pack(position)
    seed = jnp.sum((numbers % 97).astype(jnp.float32) * (1.0 + jnp.arange(numbers.shape[0], dtype=jnp.float32)))
    return jnp.sin(seed + jnp.arange(game.num_actions, dtype=jnp.float32) * 1.7), 0.8 * jnp.sin(seed * 0.37 + 1.0)


def plain_rules(game: Game) -> Rules:
    look = jax.jit(lambda position: (*made_up(game, position), game.legal(position)))
    after = jax.jit(lambda position, action: game.step(position, action, KEY))
    facts = jax.jit(lambda position: (game.player(position), game.terminated(position), game.rewards(position)))

    def predict(position):
        logits, value, legal = jax.device_get(look(position))
        return {int(move): float(logits[move]) for move in np.flatnonzero(legal)}, float(value)

    def move(position, action):
        following = after(position, np.int32(action))
        mover, (player, over, rewards) = int(game.player(position)), jax.device_get(facts(following))
        return Moved(following, float(rewards[mover]), 0.0 if over else (1.0 if player == mover else -1.0))

    return Rules(predict, move)


@pytest.mark.parametrize(
    ("game", "simulations", "considered", "explore", "rescale"),
    [
        (TIC_TAC_TOE, 33, 16, True, True),
        (TIC_TAC_TOE, 64, 4, False, False),
        (CONNECT_FOUR, 32, 16, True, False),
        (CONNECT_FOUR, 50, 5, True, True),
        (TAKING, 40, 2, True, False),
    ],
    ids=lambda value: value.id if isinstance(value, Game) else str(value),
)
def test_the_search_is_the_plain_one_of_the_paper(game, simulations, considered, explore, rescale):
    settings = SearchSettings("gumbel", simulations, considered_moves=considered, value_scale=0.1, rescale_values=rescale)
    positions = jax.vmap(lambda key: opening(game, key, 1.0, game.max_moves // 3))(jax.random.split(KEY, POSITIONS))

    def evaluate(params, positions, key):
        return jax.vmap(lambda position: made_up(game, position))(positions)

    run = jax.jit(lambda positions, key: search(game, evaluate, settings, (), positions, key, explore=explore))
    found = jax.device_get(run(positions, KEY))
    # As mctx draws its noise, of the second half of the key.
    noise = jax.random.gumbel(jax.random.split(jax.random.split(KEY)[1])[1], (POSITIONS, game.num_actions)) * explore
    rules, scale = plain_rules(game), Scale(0.1, rescale=rescale)
    for i in range(POSITIONS):
        position = jax.tree.map(lambda leaf, i=i: leaf[i], positions)
        root, action, policy = gumbel_search(rules, position, simulations, min(considered, game.num_actions), scale, np.asarray(noise[i]))
        assert found.visits[i].tolist() == [root.visits(move) for move in range(game.num_actions)]
        assert found.action[i] == action
        np.testing.assert_allclose(found.policy[i], [policy.get(move, 0.0) for move in range(game.num_actions)], atol=2e-4)
        assert found.value[i] == pytest.approx(root.value, abs=1e-4)


def test_half_of_the_moves_go_on_from_phase_to_phase():
    # Figure 1 of the paper, with its 16 moves and 200 simulations: log2(16) = 4 phases of about 50; the last one
    # goes on until the simulations are spent.
    assert visited_in_rounds(16, 200) == [16] * 3 + [8] * 6 + [4] * 12 + [2] * 25 * 2
    assert visited_in_rounds(4, 2) == [4]
    assert visited_in_rounds(1, 3) == [1, 1, 1]


@cache
def golden(name: str) -> dict:
    """A tree that mctx's own tests hold it against, as it comes with the package (Apache-2.0), as tables by number of the node."""
    spec = find_spec("mctx")
    path = Path(spec.origin).parent / "_src" / "tests" / "test_data" / f"{name}.json"
    if not path.is_file():
        pytest.skip(f"this mctx brings no {name}.json")
    stored = json.loads(path.read_text())
    nodes: dict[int, dict] = {}

    def visit(node: dict) -> None:
        nodes[node["evaluation_index"]] = node
        for child in node["child_stats"]:
            if "visit" in child:
                visit(child)

    visit(stored["tree"])
    return {"facts": stored, "nodes": nodes}


def plain_golden(name: str) -> Rules:
    """What the tree's made-up network said of the positions in it; to look at any other is an error."""
    tree = golden(name)
    discount = tree["facts"]["env_config"]["discount"]

    def predict(node):
        stored = tree["nodes"][node]
        return {child["action"]: float(np.log(child["prior"])) for child in stored["child_stats"]}, stored["raw_value_view"]

    def move(node, action):
        child = tree["nodes"][node]["child_stats"][action]
        return Moved(child["evaluation_index"], child["reward"], discount)

    return Rules(predict, move)


@pytest.mark.parametrize("name", ["gumbel_muzero_tree", "gumbel_muzero_reward_tree"])
def test_the_plain_search_grows_mctxs_golden_tree_node_by_node(name):
    facts = golden(name)["facts"]
    config, simulations = facts["algorithm_config"], facts["tree"]["visit"] - 1
    kwargs = config["qtransform_kwargs"]
    scale = Scale(kwargs["value_scale"], kwargs["maxvisit_init"], kwargs["rescale_values"])
    noise = np.zeros(len(facts["tree"]["child_stats"]))
    root, _, _ = gumbel_search(plain_golden(name), 0, simulations, config["max_num_considered_actions"], scale, noise)

    def compare(node: Node, stored: dict) -> int:
        assert len(node.returns) == stored["visit"]
        assert node.value == pytest.approx(stored["value_view"], abs=1e-4)
        tried = {child["action"] for child in stored["child_stats"] if "visit" in child}
        assert node.edges.keys() == tried
        return 1 + sum(compare(edge.child, stored["child_stats"][action]) for action, edge in node.edges.items())

    assert compare(root, facts["tree"]) == simulations + 1


@pytest.mark.parametrize(("name", "kind"), [("gumbel_muzero_tree", "gumbel"), ("muzero_tree", "puct")])
def test_our_searches_give_the_roots_of_mctxs_golden_trees(name, kind):
    """The trees of a game of two without rewards: their positions are numbers of nodes, of which all others are the last."""
    tree = golden(name)
    nodes, actions, count = tree["nodes"], len(tree["facts"]["tree"]["child_stats"]), len(tree["nodes"])
    children = np.full((count + 1, actions), count, np.int32)
    logits, values = np.zeros((count + 1, actions), np.float32), np.zeros(count + 1, np.float32)
    for number, node in nodes.items():
        values[number] = node["raw_value_view"]
        for child in node["child_stats"]:
            logits[number, child["action"]] = np.log(child["prior"])
            children[number, child["action"]] = child.get("evaluation_index", count)
    children, logits, values = map(jnp.asarray, (children, logits, values))

    def after(position, action, key):
        return {"node": children[position["node"], action], "player": 1 - position["player"]}

    of_nodes = TAKING._replace(
        num_actions=actions,
        init=lambda key: {"node": jnp.int32(0), "player": jnp.int32(0)},
        step=after,
        legal=lambda position: jnp.ones((actions,), bool),
        player=lambda position: position["player"],
        terminated=lambda position: jnp.array(False),
        rewards=lambda position: jnp.zeros((2,)),
    )

    def evaluate(params, positions, key):
        return logits[positions["node"]], values[positions["node"]]

    # The defaults are the tree's.
    settings = SearchSettings(kind, count - 1)
    root = jax.tree.map(lambda leaf: leaf[None], of_nodes.init(KEY))
    found = jax.device_get(jax.jit(lambda position: search(of_nodes, evaluate, settings, (), position, KEY, explore=False))(root))
    stored = tree["facts"]["tree"]
    assert found.visits[0].tolist() == [child.get("visit", 0) for child in stored["child_stats"]]
    assert found.value[0] == pytest.approx(stored["value_view"], abs=1e-4)
