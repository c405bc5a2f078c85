"""MuZero: a tree search through a model that is learnt for nothing but the search: values, rewards and policies, not observations.

Schrittwieser et al. 2020, "Mastering Atari, Go, chess and shogi by planning with a learned model" (Nature 588; arXiv:1911.08265);
Gumbel: Danihelka et al. 2022, "Policy improvement by planning with Gumbel". Deviations from Schrittwieser et al.:

1. The search may be Gumbel's (the default), whose policy improves even with few simulations.
2. Values are bootstrapped by what the running average of the network says of them now (``bootstrap="search"``: by what a search said when
   they were played, as in the paper, which may fall behind where values grow).
3. What acts, and is exported, is that running average (``averaging``).
4. Values are stretched by the best and the worst action of their node, not of the whole tree; in games too they are the paper's transformed
   probabilities of atoms. A game's value changes its sign from each state to the next: players take turns.
5. Sequences are drawn uniformly. Behind a termination the model is taught that nothing comes; behind a time limit it is taught nothing,
   and the value goes on at the observation that was cut.
6. States are rows of numbers, of images too; rewards are told by the state that they lead to. AdamW, gradients clipped.
7. Actions are drawn at one temperature, a schedule over the run, in all moves of a game. Symmetries of a board turn what is learnt from.

Logs ``train/loss``, ``policy_loss``, ``value_loss``, ``reward_loss`` (of all K steps), ``target_entropy`` (of the search's policies),
``value_mean`` (of the targets), ``grad_norm``, ``learning_rate``. Results and their commands: docs/algorithms/muzero.md.
"""

from dataclasses import dataclass
from typing import Annotated, NamedTuple

import gymnasium
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, Int, Key, PyTree

from thorndike.errors import UserError
from thorndike.functional.descent import Averaged, averaged, clipped_adamw, descend_averaged
from thorndike.functional.learning_dynamics import mean_square_gradient
from thorndike.functional.policy_losses import weighted_mean
from thorndike.functional.schedules import schedule
from thorndike.functional.unrolled_targets import UnrolledTargets
from thorndike.functional.value_transform import Scale
from thorndike.games.board_view import view_of
from thorndike.games.imagined_search import Imagination, Thought, imagine, think
from thorndike.games.search import SEARCHES, Found, settings_from
from thorndike.networks.cnn import CNNS
from thorndike.networks.hidden_layers import look_into
from thorndike.networks.learned_model import ModelShape, learned_model, unroll
from thorndike.networks.torso import example_observation
from thorndike.replay.age import key_to_look_by, mean_age
from thorndike.replay.off_policy import repeated
from thorndike.replay.pace import Pace, pace
from thorndike.replay.uniform import ReplayBuffer, add, drawn_rows, init_replay, row_shapes
from thorndike.replay.unrolled import Unrolled, targets_of, unrolled_at
from thorndike.settings import AtLeast, Between, MoreThan, OneOf, check
from thorndike.types import Algorithm, EnvSpec, Metrics, Needs, Noise, Observation, Rollout, Shared


@dataclass(frozen=True)
class Config:
    """Settings of MuZero, for small environments on a CPU."""

    total_steps: Annotated[int, AtLeast(1)] = 100_000  # environment steps of the run, the measure of all schedules
    learning_rate: Annotated[float | str, AtLeast(0)] = 1e-3  # AdamW's step size, or a schedule such as linear(1e-3, 1e-4)
    buffer_size: Annotated[int, AtLeast(1)] = 100_000  # N: steps kept
    learning_starts: Annotated[int, AtLeast(0)] = 2_000  # environment steps before the first update
    batch_size: Annotated[int, AtLeast(1)] = 128  # M: sequences of a minibatch
    train_freq: Annotated[int, AtLeast(1)] = 64  # environment steps between rounds of updates
    gradient_steps: Annotated[int, AtLeast(-1)] = 8  # updates in a round; -1: one an environment step
    gamma: Annotated[float, Between(0, 1)] = 0.99  # discount
    unroll_steps: Annotated[int, AtLeast(1)] = 5  # K: steps that the model is taught to look ahead
    n_step: Annotated[int, AtLeast(1)] = 10  # n: rewards summed before bootstrapping
    bootstrap: Annotated[str, OneOf("network", "search")] = "network"  # by what the network says now, or a search said when it was played
    search: Annotated[str, OneOf(*SEARCHES)] = "gumbel"  # at the root: Gumbel's sequential halving, or PUCT with Dirichlet noise
    num_simulations: Annotated[int, AtLeast(1)] = 16  # of a search while learning
    eval_simulations: Annotated[int, AtLeast(0)] = 16  # when evaluated; 0: the policy's network alone
    considered_moves: Annotated[int, AtLeast(1)] = 16  # m of gumbel: actions tried at the root
    value_scale: Annotated[float, MoreThan(0)] = 0.1  # c_scale of gumbel: weight of values against the prior
    rescale_values: bool = True  # stretch the values of a node's actions to [0, 1] first
    c_puct: Annotated[float, MoreThan(0)] = 1.25  # c_init of puct: weight of the prior
    dirichlet_alpha: Annotated[float, MoreThan(0)] = 0.3  # alpha of puct's noise at the root
    dirichlet_fraction: Annotated[float, Between(0, 1)] = 0.25  # epsilon: its share of the prior there
    temperature: Annotated[float | str, MoreThan(0)] = "linear(1, 0.25)"  # tau: actions are drawn from the search's policy ^ (1 / tau)
    symmetries: bool = True  # of a game: learn from turned and mirrored boards too
    value_limit: Annotated[float, MoreThan(0)] = 300.0  # the largest value or reward, either way, that the model can say
    atoms: Annotated[int, AtLeast(2)] = 51  # numbers that a value's probabilities are of
    vf_coef: Annotated[float, AtLeast(0)] = 0.25  # weight of the value loss
    weight_decay: Annotated[float, AtLeast(0)] = 1e-4  # c: of AdamW, decoupled
    max_grad_norm: Annotated[float, MoreThan(0)] = 5.0  # global norm the gradient is clipped to
    averaging: Annotated[float, MoreThan(0), Between(0, 1)] = 0.01  # how far what acts moves to the newest parameters at a step
    net_arch: tuple[int, ...] = (128,)  # widths of the hidden layers between observation and state
    cnn: Annotated[str, OneOf(*CNNS)] = "nature"  # convolutions of images
    state_size: Annotated[int, AtLeast(2)] = 64  # numbers of a state
    width: Annotated[int, AtLeast(1)] = 128  # of the hidden layer of dynamics, policy, value and reward

    def __post_init__(self) -> None:
        check(self)


class State(NamedTuple):
    """What learning carries from one iteration to the next."""

    learnt: Averaged
    """Its average is what acts."""
    replay: ReplayBuffer
    env_steps: Int[Array, ""]


class Actor(NamedTuple):
    """What acting needs."""

    params: PyTree
    temperature: Float[Array, ""]


def muzero_loss(
    params: PyTree, batch: Unrolled, targets: UnrolledTargets, imagination: Imagination, vf_coef: float
) -> tuple[Float[Array, ""], Metrics]:
    """Cross-entropies of policy, value and reward over K imagined steps: the paper's eq. 1, scaled as in its appendix G."""
    scale, steps = imagination.scale, batch.action.shape[0]
    said = unroll(imagination.model, params, batch.obs, batch.action)
    share = jnp.concatenate([jnp.ones((1, 1)), jnp.full((steps, 1), 1.0 / steps)]) * batch.valid[None]

    def cross_entropy(target: Array, logits: Array, weight: Array) -> Float[Array, ""]:
        each = -jnp.sum(target * jax.nn.log_softmax(logits), axis=-1)
        return jnp.sum(each * weight) / jnp.maximum(jnp.sum(batch.valid), 1.0)

    policy = cross_entropy(batch.policy, said.policy, share * targets.alive)
    value = cross_entropy(scale.probabilities(targets.value), said.value, share * targets.known)
    reward = cross_entropy(scale.probabilities(targets.reward), said.reward[1:], share[1:] * targets.known[1:])
    loss = policy + vf_coef * value + reward
    entropy = -jnp.sum(batch.policy[0] * jnp.log(jnp.maximum(batch.policy[0], 1e-9)), axis=-1)
    metrics = {"train/loss": loss, "train/policy_loss": policy, "train/value_loss": value, "train/reward_loss": reward}
    metrics["train/target_entropy"] = weighted_mean(entropy, batch.valid)
    return loss, metrics | {"train/value_mean": weighted_mean(targets.value[0], batch.valid)}


class Parts(NamedTuple):
    """What the functions below share."""

    config: Config
    spec: EnvSpec
    imagination: Imagination
    optimizer: optax.GradientTransformation
    plan: Pace

    def look_ahead(self, simulations: int, explore: bool, params: PyTree, obs: Observation, key: Key[Array, ""]) -> Found:
        """A search from observations ``[B]``. Consumes the key."""
        settings = settings_from(vars(self.config), simulations)
        return imagine(self.imagination, settings, params, self.imagination.view.see(obs), key, explore)


def init_state(parts: Parts, key: Key[Array, ""]) -> State:
    """Parameters and an empty ring. Consumes the key."""
    model, (actions, space, *_), num_envs = parts.imagination.model, parts.imagination.view, parts.spec.num_envs
    found = {"policy": jax.ShapeDtypeStruct((actions,), jnp.float32), "value": jax.ShapeDtypeStruct((), jnp.float32)}
    replay = init_replay(row_shapes(parts.spec._replace(observation_space=space), search=found), parts.plan.ring_steps, num_envs)
    return State(averaged(model.network.init(key, example_observation(space)), parts.optimizer), replay, jnp.zeros((), jnp.int32))


def remember(parts: Parts, state: State, rollout: Rollout) -> State:
    """The rollout in the ring."""
    see, step = parts.imagination.view.see, rollout.step
    seen = rollout._replace(obs=see(rollout.obs), step=step._replace(next_obs=see(step.next_obs)))
    return state._replace(replay=add(state.replay, seen), env_steps=state.env_steps + step.reward.size)


def learn(parts: Parts, learnt: Averaged, replay: ReplayBuffer, rate: Float[Array, ""], key: Key[Array, ""]) -> tuple[Averaged, Metrics]:
    """One minibatch. Consumes the key."""
    c, imagination, num_envs = parts.config, parts.imagination, parts.spec.num_envs
    rows = drawn_rows(replay, key, c.batch_size, num_envs, c.unroll_steps + c.n_step + 1)
    batch = imagination.view.turn(unrolled_at(replay, rows, num_envs, c.unroll_steps, c.n_step, again=c.bootstrap == "network"))
    targets = targets_of(batch, lambda seen: think(imagination, learnt.average, seen).value, imagination.discount, c.n_step)
    grads, metrics = jax.grad(muzero_loss, has_aux=True)(learnt.params, batch, targets, imagination, c.vf_coef)
    learnt, metrics["train/grad_norm"] = descend_averaged(parts.optimizer, rate, c.averaging, learnt, grads, metrics["train/loss"])
    return learnt, metrics


def look_at(parts: Parts, state: State) -> Metrics:
    """Dead units, ranks and gradient norms of the model, and how old what it learns from is."""
    rows = drawn_rows(state.replay, key_to_look_by(state.env_steps), parts.config.batch_size, parts.spec.num_envs, 1)
    seen, learnt = jax.tree.map(lambda x: x[rows], state.replay.rows["obs"]), state.learnt
    found = look_into(parts.imagination.model.network, learnt.params, seen, mean_square_gradient(learnt.opt_state))
    return found | {"train/replay_age": mean_age(state.replay, parts.spec.num_envs)}


def build_parts(config: Config, spec: EnvSpec) -> Parts:
    """The learner's parts. Raises ``UserError`` for settings or spaces that do not fit."""
    if not isinstance(spec.action_space, gymnasium.spaces.Discrete):
        raise UserError(f"muzero takes Discrete actions; {spec.id} has {spec.action_space}; ppo, sac and td3 take the others")
    game, of_two = spec.game, spec.game is not None and spec.game.num_players == 2
    if game is not None and of_two and not game.can_be_searched:
        raise UserError(f"muzero plays games of two players without dice (connect_four, ...), which {spec.id} is not: train it with ppo")
    actions, shape = int(spec.action_space.n), ModelShape(config.net_arch, config.cnn, config.state_size, config.width)
    view = view_of(spec, actions, config.symmetries)
    optimizer = clipped_adamw(config.max_grad_norm, config.weight_decay)
    follow, amounts = config.unroll_steps + config.n_step + 1, (config.train_freq, config.gradient_steps, spec.num_envs)
    plan = pace("muzero", config.buffer_size, config.learning_starts, *amounts, follow)
    model, scale = learned_model(view.space, actions, config.atoms, shape), Scale(config.value_limit, config.atoms)
    return Parts(config, spec, Imagination(model, scale, -config.gamma if of_two else config.gamma, view), optimizer, plan)


def muzero(config: Config, spec: EnvSpec) -> Algorithm:
    """MuZero for an environment or a game with Discrete actions. Raises ``UserError`` for other actions, and games of two with dice."""
    parts = build_parts(config, spec)
    learning_rate, temperature, plan = schedule(config.learning_rate), schedule(config.temperature), parts.plan

    def thought(actor: Actor, obs: Observation) -> Thought:
        return think(parts.imagination, actor.params, parts.imagination.view.see(obs))

    def actor(state: State) -> Actor:
        return Actor(state.learnt.average, temperature(state.env_steps / config.total_steps))

    def act(actor: Actor, memory: PyTree, obs: Observation, noise: Noise) -> tuple[PyTree, Int[Array, " B"], PyTree]:
        found = parts.look_ahead(config.num_simulations, True, actor.params, obs, noise["search"].numbers)
        tempered = jnp.log(jnp.maximum(found.policy, 1e-30)) / actor.temperature
        action = jnp.argmax(tempered + noise["choice"], axis=-1).astype(jnp.int32)
        return memory, action, {"search": {"policy": found.policy, "value": found.value}}

    def greedy(actor: Actor, memory: PyTree, obs: Observation, noise: Noise) -> tuple[PyTree, Int[Array, " B"], PyTree]:
        if config.eval_simulations == 0:
            return memory, jnp.argmax(thought(actor, obs).logits, axis=-1).astype(jnp.int32), {}
        return memory, parts.look_ahead(config.eval_simulations, False, actor.params, obs, noise["search"].numbers).action, {}

    def draw(key: Key[Array, ""], steps: int) -> Noise:
        key_search, key_choice = jax.random.split(key)
        choice = jax.random.gumbel(key_choice, (steps, spec.num_envs, parts.imagination.view.actions))
        return {"search": Shared(jax.random.split(key_search, steps)), "choice": choice}

    def update(state: State, rollout: Rollout, key: Key[Array, ""]) -> tuple[State, Metrics]:
        rate = learning_rate(state.env_steps / config.total_steps)
        state = remember(parts, state, rollout)
        # One key more than updates: from a single one the compiler would take the sampling out of the loop (see ``repeated``).
        keys = jax.random.split(key, plan.gradient_steps + 1)
        learnt, metrics = repeated(
            lambda learnt, i: learn(parts, learnt, state.replay, rate, keys[i]), state.learnt, plan.gradient_steps, state.env_steps >= 0
        )
        return state._replace(learnt=learnt), metrics | {"train/learning_rate": rate}

    return Algorithm(
        init=lambda key: init_state(parts, key),
        actor=actor,
        memory=lambda batch: (),
        draw=draw,
        act=act,
        greedy=greedy,
        value=lambda actor, obs: thought(actor, obs).value,
        update=update,
        observe=lambda state, rollout, key: (remember(parts, state, rollout), {}),
        needs=Needs(rollout_length=plan.rollout_length, on_policy=False, warmup_iterations=plan.warmup_iterations),
        probabilities=lambda actor, memory, obs: jax.nn.softmax(thought(actor, obs).logits),
        dynamics=lambda state, rollout: look_at(parts, state),
    )
