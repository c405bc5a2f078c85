"""AlphaZero: a network learns a game of two from nothing but playing itself, guided by a tree search that it guides.

Silver et al. 2018, "A general reinforcement learning algorithm that masters chess, shogi, and Go through self-play" (Science 362);
Gumbel: Danihelka et al. 2022, "Policy improvement by planning with Gumbel"; playout caps: Wu 2019, KataGo (arXiv:1902.10565).
Deviations from Silver et al.:

1. The search may be Gumbel's (the default), whose policy improves even with few simulations. No tree is used again for the next move.
2. Only a share of the moves (``full_search_fraction``) is searched in full and teaches the policy; the others are fast ones, without noise
   (KataGo). All games of the batch search together, so the coin is thrown once a step for all of them.
3. A share of the games begins with random moves (``games/environment.py``), for else the network knows nothing off its own paths.
4. The value is a logit of winning, a draw counted as half, learnt by cross-entropy in place of squared error.
5. What plays, and is exported, is a running average of the learnt parameters (``averaging``): the latest, or the last that won a match
   against the one before (``gate_every``).
6. AdamW in place of momentum, with gradients clipped. Learning alternates with a few moves of all games.
7. Symmetries of the board turn what is learnt from, a minibatch in equal parts, and not what is searched.
8. Where squares decide the game, two more heads may learn how it ends (``ownership_coef``, ``score_coef``: KataGo, section 4.1): squares by
   cross-entropy, and their number by Huber's loss in place of a distribution of scores. No search asks them.

Rewards are the mover's: ``rollout/ep_rew_mean`` is what games paid to whoever moved last. Logs ``train/loss``, ``policy_loss``,
``value_loss``, ``ownership_loss``, ``score_loss`` (of these heads), ``policy_kl`` (the loss less the target's entropy), ``known_outcomes``,
``grad_norm``, ``learning_rate`` and, of positions in games played on, ``resign_checks``: the share in which the mover would have resigned,
``resign_errors``: and yet did not lose. Results: docs/algorithms/alphazero.md.
"""

import math
from dataclasses import dataclass
from functools import partial
from typing import Annotated, NamedTuple

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, Int, Key, PyTree

from thorndike.errors import UserError
from thorndike.functional.descent import Averaged, clipped_adamw, descend_averaged
from thorndike.functional.learning_dynamics import mean_square_gradient
from thorndike.functional.policy_losses import weighted_mean
from thorndike.functional.schedules import schedule
from thorndike.games.board_heads import NO_HEADS, HeadWeights, check_heads, head_losses
from thorndike.games.environment import check_unchanged
from thorndike.games.game import Game, Position
from thorndike.games.gating import Gate, GateSettings, closed_gate, try_gate
from thorndike.games.packing import packing
from thorndike.games.search import SEARCHES, Found, by_network, search, settings_from
from thorndike.games.self_play import Batch, Manners, as_batch, draw_moves, false_resignations, fresh_memory, move
from thorndike.games.window import empty_window, into_window
from thorndike.networks.board import TOWERS, board_network, win_value
from thorndike.networks.hidden_layers import look_into
from thorndike.networks.masking import FORBIDDEN, MASK
from thorndike.networks.network import Network
from thorndike.replay.age import key_to_look_by
from thorndike.replay.self_play import SelfPlayBuffer, sample_self_play
from thorndike.settings import AtLeast, Between, MoreThan, OneOf, check
from thorndike.types import Algorithm, EnvSpec, Metrics, Needs, Noise, Observation, Rollout


@dataclass(frozen=True)
class Config:
    """Settings of AlphaZero, for small boards on a CPU."""

    total_steps: Annotated[int, AtLeast(1)] = 100_000  # moves of the run, the measure of the schedule
    learning_rate: Annotated[float | str, AtLeast(0)] = 1e-3  # AdamW's step size, or a schedule such as linear(1e-3, 1e-4)
    n_steps: Annotated[int, AtLeast(1)] = 8  # T: moves of each game between two rounds of learning
    batch_size: Annotated[int, AtLeast(1)] = 512  # positions of a minibatch
    gradient_steps: Annotated[int, AtLeast(1)] = 16  # minibatches of a round
    buffer_size: Annotated[int, AtLeast(1)] = 200_000  # the window: positions that are learnt from
    learning_starts: Annotated[int, AtLeast(0)] = 20_000  # positions before learning starts
    search: Annotated[str, OneOf(*SEARCHES)] = "gumbel"  # at the root: Gumbel's sequential halving, or PUCT with Dirichlet noise
    num_simulations: Annotated[int, AtLeast(1)] = 32  # of a full search
    fast_simulations: Annotated[int, AtLeast(1)] = 12  # of a fast one, which teaches no policy
    full_search_fraction: Annotated[float, Between(0, 1)] = 1.0  # p: share of full searches (KataGo's playout cap randomisation)
    eval_simulations: Annotated[int, AtLeast(0)] = 64  # when playing for strength; 0: the network alone
    considered_moves: Annotated[int, AtLeast(1)] = 16  # m of gumbel: moves tried at the root
    value_scale: Annotated[float, MoreThan(0)] = 0.5  # c_scale of gumbel: weight of values in [-1, 1] against the prior
    rescale_values: bool = False  # stretch the values of a node's moves to [0, 1] first
    c_puct: Annotated[float, MoreThan(0)] = 1.25  # c_init of puct: weight of the prior
    dirichlet_alpha: Annotated[float, MoreThan(0)] = 1.0  # alpha of puct's noise at the root
    dirichlet_fraction: Annotated[float, Between(0, 1)] = 0.25  # epsilon: its share of the prior there
    temperature: Annotated[float, MoreThan(0)] = 1.0  # tau: of the first moves, drawn from the search's policy
    temperature_moves: Annotated[int, AtLeast(0)] = 8  # moves of a game that are drawn; later ones are the search's best
    resign_threshold: Annotated[float, Between(-1, 0)] = -1.0  # resign below this value; -1: never
    resign_check_fraction: Annotated[float, Between(0, 1)] = 0.1  # share of games played on, to count resignations in error
    symmetries: bool = True  # learn from turned and mirrored boards too
    vf_coef: Annotated[float, AtLeast(0)] = 1.0  # weight of the value loss
    ownership_coef: Annotated[float, AtLeast(0)] = 0.0  # weight of learning whose each square will be (KataGo); 0: no such head
    score_coef: Annotated[float, AtLeast(0)] = 0.0  # weight of learning by how many squares the game will be won; 0: no such head
    weight_decay: Annotated[float, AtLeast(0)] = 1e-4  # c: of AdamW, decoupled
    max_grad_norm: Annotated[float, MoreThan(0)] = 1.0  # global norm the gradient is clipped to
    averaging: Annotated[float, MoreThan(0), Between(0, 1)] = 0.005  # how far what plays moves to the newest parameters at a step
    gate_every: Annotated[int, AtLeast(0)] = 0  # iterations between matches that what plays next must win; 0: the average always plays
    gate_games: Annotated[int, AtLeast(2)] = 100  # games of such a match
    gate_threshold: Annotated[float, Between(0, 1)] = 0.55  # share of its points that is needed
    tower: Annotated[str, OneOf(*TOWERS)] = "mlp"  # dense layers, these on shared patches, convolutions, or these with moves by square
    width: Annotated[int, AtLeast(1)] = 256  # units of a dense layer, or channels
    blocks: Annotated[int, AtLeast(0)] = 2  # residual blocks of two layers

    def __post_init__(self) -> None:
        check(self)


class State(NamedTuple):
    """What learning carries from one iteration to the next."""

    params: PyTree
    average: PyTree
    """The running average of the parameters: what plays, unless there is a gate."""
    opt_state: PyTree
    buffer: SelfPlayBuffer
    env_steps: Int[Array, ""]
    gate: Gate | None
    """Where the average must win a match before it plays."""


def alphazero_loss(
    params: PyTree, batch: Batch, network: Network, vf_coef: float, weights: HeadWeights = NO_HEADS
) -> tuple[Float[Array, ""], Metrics]:
    """Cross-entropy of the search's policy, and of the outcome as the probability of winning: the paper's eq. 1 with deviations 4 and 8."""
    logits, win, *heads = network.apply(params, batch.board)
    log_policy = jax.nn.log_softmax(jnp.where(batch.legal, logits, FORBIDDEN))
    policy = weighted_mean(-jnp.sum(batch.policy * log_policy, axis=-1), batch.policy_weight)
    value = weighted_mean(optax.sigmoid_binary_cross_entropy(win, 0.5 * (batch.outcome + 1.0)), batch.value_weight)
    entropy = -jnp.sum(batch.policy * jnp.log(jnp.maximum(batch.policy, 1e-9)), axis=-1)
    loss = policy + vf_coef * value
    kl = policy - weighted_mean(entropy, batch.policy_weight)
    metrics = {"train/policy_loss": policy, "train/value_loss": value, "train/policy_kl": kl}
    if batch.ending is not None:
        of_heads, found = head_losses(heads[0], batch.ending, weights)
        loss, metrics = loss + of_heads, metrics | found
    return loss, metrics | {"train/loss": loss}


class Parts(NamedTuple):
    """What the functions below share."""

    config: Config
    game: Game
    network: Network
    optimizer: optax.GradientTransformation
    weights: HeadWeights
    gating: GateSettings
    num_envs: int

    @property
    def rows(self) -> int:
        """Positions of an iteration."""
        return self.config.n_steps * self.num_envs


def init_state(parts: Parts, key: Key[Array, ""]) -> State:
    """Parameters and an empty window. Consumes the key."""
    config, game = parts.config, parts.game
    params = parts.network.init(key, jnp.zeros((1, *game.observation_shape)))
    buffer = empty_window(game, config.buffer_size, config.n_steps, parts.num_envs, endings=bool(parts.weights.heads))
    average, gate = jax.tree.map(jnp.copy, params), closed_gate(parts.gating, params)
    return State(params, average, parts.optimizer.init(params), buffer, jnp.zeros((), jnp.int32), gate)


def remember(parts: Parts, state: State, rollout: Rollout) -> State:
    """The rollout's positions in the window, and the outcomes of the games that ended."""
    return state._replace(buffer=into_window(parts.game, state.buffer, rollout), env_steps=state.env_steps + parts.rows)


def learn(parts: Parts, state: State, key: Key[Array, ""]) -> tuple[State, Metrics]:
    """One minibatch. Consumes the key."""
    config = parts.config
    sampled = sample_self_play(state.buffer, key, config.batch_size)
    batch = as_batch(parts.game, sampled, config.symmetries)
    taught = batch, parts.network, config.vf_coef, parts.weights
    grads, metrics = jax.grad(alphazero_loss, has_aux=True)(state.params, *taught)
    rate = schedule(config.learning_rate)(state.env_steps / config.total_steps)
    held = Averaged(state.params, state.average, state.opt_state)
    held, norm = descend_averaged(parts.optimizer, rate, config.averaging, held, grads, metrics["train/loss"])
    metrics |= {"train/grad_norm": norm, "train/learning_rate": rate}
    metrics["train/known_outcomes"] = jnp.mean(batch.value_weight)
    metrics["train/resign_checks"], metrics["train/resign_errors"] = false_resignations(sampled)
    return state._replace(params=held.params, average=held.average, opt_state=held.opt_state), metrics


def look_at(parts: Parts, state: State) -> Metrics:
    """Dead units, ranks and gradient norms of the network, and how old what it learns from is."""
    key = key_to_look_by(state.env_steps)
    seen = as_batch(parts.game, sample_self_play(state.buffer, key, parts.config.batch_size), symmetries=False)
    age = parts.num_envs * (jnp.maximum(state.buffer.size, 1) - 1).astype(jnp.float32) / 2.0
    return look_into(parts.network, state.params, seen.board, mean_square_gradient(state.opt_state)) | {"train/replay_age": age}


def alphazero(config: Config, spec: EnvSpec) -> Algorithm:
    """AlphaZero for a game. Raises ``UserError`` for an environment that is no game of two players without dice."""
    game = spec.game
    if game is None or not game.can_be_searched:
        raise UserError(f"alphazero plays games of two players without dice (connect_four, ...), which {spec.id} is not: train it with ppo")
    check_unchanged(spec, game)
    weights = HeadWeights(config.ownership_coef, config.score_coef)
    check_heads(game, weights)
    network = board_network(game.num_actions, config.tower, config.width, config.blocks, weights.heads)
    optimizer = clipped_adamw(config.max_grad_norm, config.weight_decay)
    c, positions_of = config, jax.vmap(packing(game).unpack)
    manners = Manners(c.temperature, c.temperature_moves, c.resign_threshold, c.resign_check_fraction, c.full_search_fraction)
    parts = Parts(c, game, network, optimizer, weights, GateSettings(c.gate_every, c.gate_games, c.gate_threshold), spec.num_envs)

    def look_ahead(simulations: int, explore: bool, params: PyTree, positions: Position, key: Key[Array, ""]) -> Found:
        return search(game, by_network(game, network), settings_from(vars(config), simulations), params, positions, key, explore)

    def decide(simulations: int, params: PyTree, positions: Position, key: Key[Array, ""]) -> Int[Array, " B"]:
        return look_ahead(simulations, False, params, positions, key).action

    def prior(params: PyTree, obs: Observation) -> Float[Array, "B actions"]:
        return jax.nn.softmax(jnp.where(obs[MASK] > 0, network.apply(params, obs["board"])[0], FORBIDDEN))

    def act(params: PyTree, memory: PyTree, obs: Observation, noise: Noise) -> tuple[PyTree, PyTree, PyTree]:
        full, key = noise["full"].numbers, noise["search"].numbers
        look = partial(look_ahead, params=params, positions=positions_of(obs["position"]), key=key)
        if config.full_search_fraction == 1:
            found = look(config.num_simulations, True)
        else:
            found = jax.lax.cond(full, lambda: look(config.num_simulations, True), lambda: look(config.fast_simulations, False))
        moved = move(found, memory, noise, manners)
        weight = jnp.broadcast_to(full.astype(jnp.float32), moved.action.shape)
        return moved.memory, moved.action, {"policy": found.policy, "policy_weight": weight, "resigns": moved.resigns}

    def greedy(params: PyTree, memory: PyTree, obs: Observation, noise: Noise) -> tuple[PyTree, PyTree, PyTree]:
        if config.eval_simulations == 0:
            return memory, jnp.argmax(prior(params, obs), axis=-1).astype(jnp.int32), {}
        return memory, decide(config.eval_simulations, params, positions_of(obs["position"]), noise["search"].numbers), {}

    def update(state: State, rollout: Rollout, key: Key[Array, ""]) -> tuple[State, Metrics]:
        state, keys = remember(parts, state, rollout), jax.random.split(key, config.gradient_steps + 1)
        state, metrics = jax.lax.scan(lambda state, key: learn(parts, state, key), state, keys[:-1])
        play, played = partial(decide, config.num_simulations), state.env_steps // parts.rows
        gate, told = try_gate(game, play, parts.gating, state.gate, state.average, played, keys[-1])
        return state._replace(gate=gate), {name: jnp.mean(values) for name, values in metrics.items()} | told

    return Algorithm(
        init=lambda key: init_state(parts, key),
        actor=lambda state: state.average if state.gate is None else state.gate.best,
        memory=fresh_memory,
        draw=lambda key, steps: draw_moves(key, steps, spec.num_envs, game.num_actions, manners),
        act=act,
        greedy=greedy,
        value=lambda params, obs: win_value(network.apply(params, obs["board"])[1]),
        update=update,
        observe=lambda state, rollout, key: (remember(parts, state, rollout), {}),
        needs=Needs(rollout_length=config.n_steps, on_policy=False, warmup_iterations=math.ceil(config.learning_starts / parts.rows)),
        probabilities=lambda params, memory, obs: prior(params, obs),
        dynamics=lambda state, rollout: look_at(parts, state),
    )
