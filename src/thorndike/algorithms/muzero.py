"""MuZero: a tree search through a model that is learnt for nothing but the search: values, rewards and policies, not observations.

Schrittwieser et al. 2020, "Mastering Atari, Go, chess and shogi by planning with a learned model" (Nature 588; arXiv:1911.08265);
Gumbel: Danihelka et al. 2022, "Policy improvement by planning with Gumbel". Deviations from Schrittwieser et al.:

1. The search may be Gumbel's (the default), whose policy improves even with few simulations.
2. PLACEHOLDER
"""

from dataclasses import dataclass
from typing import Annotated, NamedTuple

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import optax
from gymnasium import spaces
from jaxtyping import Array, Bool, Float, Int, Key, PyTree

from thorndike.errors import UserError
from thorndike.functional.guards import accept_if, all_finite
from thorndike.functional.learning_dynamics import mean_square_gradient
from thorndike.functional.policy_losses import weighted_mean
from thorndike.functional.schedules import schedule
from thorndike.functional.unrolled_targets import UnrolledTargets, scaled_gradient, unrolled_targets
from thorndike.functional.value_transform import Scale
from thorndike.games.imagined_search import Imagination, imagine, think
from thorndike.games.search import SEARCHES, Found, SearchSettings
from thorndike.networks.cnn import CNNS
from thorndike.networks.hidden_layers import look_into
from thorndike.networks.learned_model import ModelShape, learned_model
from thorndike.networks.masking import MASK, allowed, check_mask, has_mask
from thorndike.networks.torso import example_observation
from thorndike.replay.age import key_to_look_by, mean_age
from thorndike.replay.off_policy import repeated
from thorndike.replay.pace import Pace, pace
from thorndike.replay.uniform import ReplayBuffer, add, drawn_rows, init_replay, row_shapes
from thorndike.replay.unrolled import Unrolled, unrolled_at
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

    params: PyTree
    average: PyTree
    """The running average of the parameters: what acts."""
    opt_state: PyTree
    replay: ReplayBuffer
    updates: Int[Array, ""]
    env_steps: Int[Array, ""]


class Actor(NamedTuple):
    """What acting needs."""

    params: PyTree
    temperature: Float[Array, ""]


def muzero_loss(
    params: PyTree, batch: Unrolled, targets: UnrolledTargets, imagination: Imagination, vf_coef: float
) -> tuple[Float[Array, ""], Metrics]:
    """Cross-entropies of policy, value and reward over K imagined steps: the paper's eq. 1, scaled as in its appendix G."""
    model, scale, _ = imagination
    first, steps = model.represent(params, batch.obs), batch.action.shape[0]

    def follow(state: Array, action: Array) -> tuple[Array, Array]:
        after = scaled_gradient(model.follow(params, state, action), 0.5)
        return after, after

    _, later = jax.lax.scan(follow, first, batch.action, unroll=True)
    said = model.judge(params, jnp.concatenate([first[None], later]))
    share = jnp.concatenate([jnp.ones((1, 1)), jnp.full((steps, 1), 1.0 / steps)]) * batch.valid

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
    metrics["train/value_mean"] = weighted_mean(targets.value[0], batch.valid)
    return loss, metrics


class Parts(NamedTuple):
    """What the functions below share."""

    config: Config
    spec: EnvSpec
    space: gymnasium.Space
    """Of what the model sees."""
    actions: int
    imagination: Imagination
    optimizer: optax.GradientTransformation
    plan: Pace

    def see(self, obs: Observation) -> Observation:
        """What the model sees of observations with any leading axes: of a game the board alone, and which moves are legal."""
        if self.spec.game is None:
            return obs
        board = obs["board"]
        return {"board": board.reshape((*board.shape[:-3], -1)), MASK: obs[MASK]}

    def legal(self, seen: Observation) -> Bool[Array, "B actions"]:
        """Which actions are allowed."""
        if has_mask(self.space):
            return allowed(seen)
        return jnp.ones((jax.tree.leaves(seen)[0].shape[0], self.actions), bool)

    def look_ahead(self, simulations: int, explore: bool, params: PyTree, obs: Observation, key: Key[Array, ""]) -> Found:
        """A search from observations ``[B]``. Consumes the key."""
        c, seen = self.config, self.see(obs)
        noise, bandit = (c.dirichlet_alpha, c.dirichlet_fraction, c.c_puct), (c.considered_moves, c.value_scale, c.rescale_values)
        settings = SearchSettings(c.search, simulations, *noise, *bandit)
        return imagine(self.imagination, settings, params, seen, self.legal(seen), key, explore)


def init_state(parts: Parts, key: Key[Array, ""]) -> State:
    """Parameters and an empty ring. Consumes the key."""
    params = parts.imagination.model.network.init(key, example_observation(parts.space))
    found = {"policy": jax.ShapeDtypeStruct((parts.actions,), jnp.float32), "value": jax.ShapeDtypeStruct((), jnp.float32)}
    row = row_shapes(parts.spec._replace(observation_space=parts.space), search=found)
    replay, zero = init_replay(row, parts.plan.ring_steps, parts.spec.num_envs), jnp.zeros((), jnp.int32)
    return State(params, jax.tree.map(jnp.copy, params), parts.optimizer.init(params), replay, zero, zero + 0)


def remember(parts: Parts, state: State, rollout: Rollout) -> State:
    """The rollout in the ring."""
    seen = rollout._replace(obs=parts.see(rollout.obs), step=rollout.step._replace(next_obs=parts.see(rollout.step.next_obs)))
    steps = parts.plan.rollout_length * parts.spec.num_envs
    return state._replace(replay=add(state.replay, seen), env_steps=state.env_steps + steps)


def drawn(parts: Parts, replay: ReplayBuffer, average: PyTree, key: Key[Array, ""]) -> tuple[Unrolled, UnrolledTargets]:
    """A minibatch and its targets. Consumes the key."""
    c, num_envs = parts.config, parts.spec.num_envs
    rows = drawn_rows(replay, key, c.batch_size, num_envs, c.unroll_steps + c.n_step + 1)
    batch = unrolled_at(replay, rows, num_envs, c.unroll_steps, c.n_step)
    cut = think(parts.imagination, average, batch.end_obs, parts.legal(batch.end_obs)).value
    next_value = jnp.where(batch.done, cut, batch.value)
    return batch, unrolled_targets(batch.reward, next_value, batch.terminated, batch.done, parts.imagination.discount, c.n_step)


def learn(parts: Parts, state: State, replay: ReplayBuffer, key: Key[Array, ""]) -> tuple[State, Metrics]:
    """One minibatch. Consumes the key."""
    config = parts.config
    batch, targets = drawn(parts, replay, state.average, key)
    gradient = jax.value_and_grad(muzero_loss, has_aux=True)
    (_, metrics), grads = gradient(state.params, batch, targets, parts.imagination, config.vf_coef)
    rate = schedule(config.learning_rate)(state.env_steps / config.total_steps)
    direction, opt_state = parts.optimizer.update(grads, state.opt_state, state.params)
    metrics |= {"train/grad_norm": optax.tree.norm(grads), "train/learning_rate": rate}
    params = jax.tree.map(lambda p, d: p - rate * d, state.params, direction)
    average = jax.tree.map(lambda a, p: a + config.averaging * (p - a), state.average, params)
    sound = all_finite(metrics["train/loss"], metrics["train/grad_norm"])
    kept = accept_if(sound, (params, average, opt_state), (state.params, state.average, state.opt_state))
    return state._replace(params=kept[0], average=kept[1], opt_state=kept[2]), metrics


def look_at(parts: Parts, state: State) -> Metrics:
    """Dead units, ranks and gradient norms of the model, and how old what it learns from is."""
    c, network = parts.config, parts.imagination.model.network
    rows = drawn_rows(state.replay, key_to_look_by(state.env_steps), c.batch_size, parts.spec.num_envs, 1)
    seen = jax.tree.map(lambda x: x[rows], state.replay.rows["obs"])
    found = look_into(network, state.params, seen, mean_square_gradient(state.opt_state))
    return found | {"train/replay_age": mean_age(state.replay, parts.spec.num_envs)}


def build_parts(config: Config, spec: EnvSpec) -> Parts:
    """The learner's parts. Raises ``UserError`` for settings or spaces that do not fit."""
    if not isinstance(spec.action_space, spaces.Discrete):
        raise UserError(f"muzero takes Discrete actions; {spec.id} has {spec.action_space}; ppo, sac and td3 take the others")
    space, discount, actions = spec.observation_space, config.gamma, int(spec.action_space.n)
    if spec.game is not None:
        if spec.game.has_chance and spec.game.num_players == 2:
            raise UserError(f"muzero plays games of two players without dice (connect_four, ...), which {spec.id} is not")
        size = int(np.prod(spec.game.observation_shape))
        space = spaces.Dict({"board": spaces.Box(-np.inf, np.inf, (size,), np.float32), MASK: spaces.MultiBinary(actions)})
        discount = -config.gamma if spec.game.num_players == 2 else config.gamma
    if has_mask(space):
        check_mask(spec._replace(observation_space=space))
    model = learned_model(space, actions, config.atoms, ModelShape(config.net_arch, config.cnn, config.state_size, config.width))
    optimizer = optax.chain(
        optax.clip_by_global_norm(config.max_grad_norm), optax.scale_by_adam(), optax.add_decayed_weights(config.weight_decay)
    )
    follow, amounts = config.unroll_steps + config.n_step + 1, (config.train_freq, config.gradient_steps, spec.num_envs)
    plan = pace("muzero", config.buffer_size, config.learning_starts, *amounts, follow)
    imagination = Imagination(model, Scale(config.value_limit, config.atoms), discount)
    return Parts(config, spec, space, actions, imagination, optimizer, plan)


def muzero(config: Config, spec: EnvSpec) -> Algorithm:
    """MuZero for an environment or a game with Discrete actions. Raises ``UserError`` for other actions, and games of two with dice."""
    parts = build_parts(config, spec)
    temperature, plan = schedule(config.temperature), parts.plan

    def actor(state: State) -> Actor:
        return Actor(state.average, temperature(state.env_steps / config.total_steps))

    def act(actor: Actor, memory: PyTree, obs: Observation, noise: Noise) -> tuple[PyTree, PyTree, PyTree]:
        found = parts.look_ahead(config.num_simulations, True, actor.params, obs, noise["search"].numbers)
        tempered = jnp.log(jnp.maximum(found.policy, 1e-30)) / actor.temperature
        action = jnp.argmax(tempered + noise["choice"], axis=-1).astype(jnp.int32)
        return memory, action, {"search": {"policy": found.policy, "value": found.value}}

    def thought(actor: Actor, obs: Observation) -> tuple[Float[Array, "B actions"], Float[Array, " B"]]:
        seen = parts.see(obs)
        return think(parts.imagination, actor.params, seen, parts.legal(seen))[1:]

    def greedy(actor: Actor, memory: PyTree, obs: Observation, noise: Noise) -> tuple[PyTree, PyTree, PyTree]:
        if config.eval_simulations == 0:
            return memory, jnp.argmax(thought(actor, obs)[0], axis=-1).astype(jnp.int32), {}
        return memory, parts.look_ahead(config.eval_simulations, False, actor.params, obs, noise["search"].numbers).action, {}

    def draw(key: Key[Array, ""], steps: int) -> Noise:
        key_search, key_choice = jax.random.split(key)
        choice = jax.random.gumbel(key_choice, (steps, spec.num_envs, parts.actions))
        return {"search": Shared(jax.random.split(key_search, steps)), "choice": choice}

    def update(state: State, rollout: Rollout, key: Key[Array, ""]) -> tuple[State, Metrics]:
        state = remember(parts, state, rollout)
        replay = state.replay
        # One key more than updates: from a single one the compiler would take the sampling out of the loop (see ``repeated``).
        keys = jax.random.split(key, plan.gradient_steps + 1)
        light = state._replace(replay=())
        light, metrics = repeated(lambda held, i: learn(parts, held, replay, keys[i]), light, plan.gradient_steps, state.updates >= 0)
        return light._replace(replay=replay, updates=state.updates + plan.gradient_steps), metrics

    return Algorithm(
        init=lambda key: init_state(parts, key),
        actor=actor,
        memory=lambda batch: (),
        draw=draw,
        act=act,
        greedy=greedy,
        value=lambda actor, obs: thought(actor, obs)[1],
        update=update,
        observe=lambda state, rollout, key: (remember(parts, state, rollout), {}),
        needs=Needs(rollout_length=plan.rollout_length, on_policy=False, warmup_iterations=plan.warmup_iterations),
        probabilities=lambda actor, memory, obs: jax.nn.softmax(thought(actor, obs)[0]),
        dynamics=lambda state, rollout: look_at(parts, state),
    )
