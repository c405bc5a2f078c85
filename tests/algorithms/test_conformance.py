"""What every learner promises: stable types, one trace, safe donation, repeatable bits, exact resume."""

import dataclasses
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from made_up_data import BOX, DISCRETE, made_up
from squares_game import SQUARES
from thorndike.algorithms import (
    a2c,
    a3c,
    alphazero,
    awac,
    bc,
    bootstrapped_dqn,
    cql,
    crossq,
    ddpg,
    dqn,
    impala,
    iql,
    iqn,
    muzero,
    ppo,
    pqn,
    q_learning,
    qr_dqn,
    rainbow,
    redq,
    reinforce,
    sac,
    td3,
    td3_bc,
    tqc,
    trpo,
)
from thorndike.environments import novelty, wrappers
from thorndike.environments.native import factory
from thorndike.environments.native.vectorize import vectorize
from thorndike.games.environment import game_environment
from thorndike.games.game import Game
from thorndike.games.registry import game
from thorndike.networks.torso import example_observation
from thorndike.training import segment as segment_module
from thorndike.training.checkpoints import Progressed, restore, save_checkpoint
from thorndike.training.dataset_source import dataset_source, dataset_spec
from thorndike.training.policy import Policy
from thorndike.training.run_directory import checkpoints
from thorndike.training.runner import Runner, runner
from thorndike.training.segment import Carry
from thorndike.training.sources import compiled_source
from thorndike.types import Algorithm, Source, Wrapper

NUM_ENVS, SEEDS, ITERATIONS = 4, 3, 8
NEW = (novelty.random_network_distillation(net_arch=(8,), features=4, batch_size=16), novelty.count_bonus(resolution=0.5, table_bits=8))
NORMALISED = (wrappers.normalize_observation(), wrappers.normalize_reward(0.99))
PPO = ppo.Config(total_steps=1000, n_steps=8, batch_size=16, n_epochs=2, net_arch=(8,), learning_rate="linear(1e-3, 0)")
DQN = dqn.Config(
    total_steps=1000,
    buffer_size=120,
    learning_starts=40,
    batch_size=8,
    train_freq=8,
    gradient_steps=2,
    target_update_interval=16,
    net_arch=(8, 8),
)
OF_THE_FAMILY = {name: getattr(DQN, name) for name in ("total_steps", "buffer_size", "learning_starts", "batch_size", "train_freq")}
OF_THE_FAMILY |= {name: getattr(DQN, name) for name in ("gradient_steps", "target_update_interval", "net_arch")}
CONTROL = {"total_steps": 1000, "buffer_size": 120, "learning_starts": 20, "batch_size": 8, "train_freq": 8, "net_arch": (8,)}
TABLE = q_learning.Config(total_steps=1000, n_steps=5)


class Case(NamedTuple):
    build: object
    config: object
    environment: str
    wrappers: tuple[Wrapper, ...] = ()

    def make(self) -> tuple[Algorithm, Source]:
        environment, wrapper = vectorize(factory(self.environment)(), NUM_ENVS), wrappers.chain(*self.wrappers)
        algorithm = self.build(self.config, wrapper.spec(environment.spec))
        return algorithm, compiled_source(environment, algorithm, wrapper)


class DataCase(NamedTuple):
    """A learner from a dataset."""

    build: object
    config: object
    space: object

    def make(self) -> tuple[Algorithm, Source]:
        data = made_up(self.space)
        algorithm = self.build(self.config, dataset_spec(data))
        return algorithm, dataset_source(data, algorithm)


class GameCase(NamedTuple):
    """A learner that plays a game with itself."""

    build: object
    config: object
    game: str | Game

    def make(self) -> tuple[Algorithm, Source]:
        rules = game(self.game) if isinstance(self.game, str) else self.game
        environment = game_environment(rules, NUM_ENVS)
        algorithm = self.build(self.config, environment.spec)
        return algorithm, compiled_source(environment, algorithm, wrappers.chain())


DATA = {"total_steps": 1000, "batch_size": 8, "net_arch": (8,)}


def parts(config, **changes):
    return dataclasses.replace(config, **changes)


ALPHAZERO = alphazero.Config(
    total_steps=1000,
    n_steps=2,
    batch_size=16,
    gradient_steps=2,
    buffer_size=100,
    learning_starts=16,
    num_simulations=4,
    fast_simulations=2,
    full_search_fraction=0.5,
    width=8,
    blocks=1,
    learning_rate="linear(1e-3, 0)",
)
HEADS = {"ownership_coef": 1.0, "score_coef": 0.1}
GATED = {"gate_every": 3, "gate_games": 4, "gate_threshold": 0.5}
MUZERO = muzero.Config(
    total_steps=1000,
    buffer_size=120,
    learning_starts=40,
    batch_size=8,
    train_freq=8,
    gradient_steps=2,
    unroll_steps=2,
    n_step=3,
    num_simulations=3,
    eval_simulations=2,
    atoms=11,
    net_arch=(8,),
    state_size=6,
    width=8,
    learning_rate="linear(1e-3, 0)",
)
TRPO = trpo.Config(total_steps=1000, n_steps=8, batch_size=16, n_critic_updates=2, net_arch=(8,), cg_max_steps=4)
BINS = (wrappers.discretise(6),)
RUN = {
    "sac": Case(sac.sac, sac.Config(**CONTROL, gradient_steps=3, n_critics=3, policy_delay=2, noise_color=1.0), "Pendulum-v1"),
    "td3": Case(td3.td3, td3.Config(**CONTROL, gradient_steps=3), "Pendulum-v1"),
    "crossq": Case(crossq.crossq, crossq.Config(**CONTROL, critic_net_arch=(8,), renorm_warmup=2), "Pendulum-v1"),
    "dqn, lstm": Case(dqn.dqn, parts(DQN, memory="lstm", memory_size=8, sequence_length=4, double=True), "CartPole-v1"),
    "a2c, gru": Case(a2c.a2c, a2c.Config(net_arch=(8,), memory="gru", memory_size=8), "CartPole-v1"),
    "impala": Case(impala.impala, impala.Config(total_steps=1000, n_steps=5, net_arch=(8,), policy_lag=2), "CartPole-v1", NORMALISED),
    "trpo": Case(trpo.trpo, TRPO, "CartPole-v1"),
    "a3c, gru": Case(a3c.a3c, a3c.Config(net_arch=(8,), memory="gru", memory_size=8), "CartPole-v1"),
    "a2c, held noise": Case(
        a2c.a2c, a2c.Config(net_arch=(8,), use_sde=True, sde_sample_freq=3, action_distribution="squashed"), "Pendulum-v1"
    ),
    "dqn, hindsight": Case(dqn.dqn, parts(DQN, goal_selection_strategy="future"), "BitFlip-v0"),
    "ppo": Case(ppo.ppo, PPO, "CartPole-v1", NORMALISED),
    "dqn": Case(dqn.dqn, parts(DQN, double=True, dueling=True, n_step=3), "CartPole-v1"),
    "rainbow": Case(rainbow.rainbow, rainbow.Config(**OF_THE_FAMILY, atoms=11), "CartPole-v1"),
    "pqn": Case(pqn.pqn, pqn.Config(total_steps=1000, n_steps=8, batch_size=16, n_epochs=2, net_arch=(8,)), "CartPole-v1"),
    "bootstrapped_dqn": Case(bootstrapped_dqn.bootstrapped_dqn, bootstrapped_dqn.Config(**OF_THE_FAMILY, n_members=3), "CartPole-v1"),
    "ppo, bonuses": Case(ppo.ppo, PPO, "CartPole-v1", NEW),
    "q_learning": Case(q_learning.q_learning, parts(TABLE, variant="sarsa"), "MountainCar-v0", BINS),
    # A second search would double what is compiled.
    "alphazero": GameCase(alphazero.alphazero, parts(ALPHAZERO, full_search_fraction=1.0, **HEADS), SQUARES),
    "alphazero, fast moves, resignation, gate": GameCase(
        alphazero.alphazero, parts(ALPHAZERO, resign_threshold=-0.1, **HEADS, **GATED), SQUARES
    ),
    "muzero": Case(muzero.muzero, MUZERO, "CartPole-v1"),
    "iql": DataCase(iql.iql, iql.Config(**DATA, learning_rate="linear(1e-3, 0)"), DISCRETE),
    "td3_bc": DataCase(td3_bc.td3_bc, td3_bc.Config(**DATA), BOX),
    "cql, Box": DataCase(cql.cql, cql.Config(**DATA, n_actions=2), BOX),
}
ALL = RUN | {
    "sac, one update a step": Case(sac.sac, sac.Config(**CONTROL | {"train_freq": 4, "gradient_steps": 1}), "Pendulum-v1", NORMALISED),
    "sac, fixed temperature": Case(sac.sac, sac.Config(**CONTROL, ent_coef=0.1, layer_norm=True), "MountainCarContinuous-v0"),
    "sac, held noise": Case(sac.sac, sac.Config(**CONTROL, use_sde=True), "Pendulum-v1"),
    "ppo, Box, held noise, gru": Case(ppo.ppo, parts(PPO, use_sde=True, memory="gru", memory_size=8), "Pendulum-v1"),
    "ppo, Box, beta": Case(ppo.ppo, parts(PPO, action_distribution="beta"), "Pendulum-v1"),
    "alphazero, plain": GameCase(alphazero.alphazero, ALPHAZERO, "tic_tac_toe"),
    "alphazero, puct": GameCase(alphazero.alphazero, parts(ALPHAZERO, search="puct", tower="patches"), "connect_four"),
    "alphazero, conv": GameCase(alphazero.alphazero, parts(ALPHAZERO, tower="conv", full_search_fraction=1.0), "connect_four"),
    "muzero, a game, puct": GameCase(muzero.muzero, parts(MUZERO, search="puct"), "tic_tac_toe"),
    "muzero, images, as played": Case(muzero.muzero, parts(MUZERO, bootstrap="search", eval_simulations=0), "MinAtar/Breakout-v1"),
    "bc": DataCase(bc.bc, bc.Config(**DATA), DISCRETE),
    "bc, Box": DataCase(bc.bc, bc.Config(**DATA), BOX),
    "iql, Box": DataCase(iql.iql, iql.Config(**DATA), BOX),
    "cql": DataCase(cql.cql, cql.Config(**DATA), DISCRETE),
    "awac": DataCase(awac.awac, awac.Config(**DATA), BOX),
    "awac, online": Case(awac.awac, awac.Config(**CONTROL), "Pendulum-v1"),
    "ddpg": Case(ddpg.ddpg, ddpg.Config(**CONTROL), "Pendulum-v1"),
    "tqc": Case(tqc.tqc, tqc.Config(**CONTROL, n_quantiles=5), "Pendulum-v1"),
    "redq": Case(redq.redq, redq.Config(**CONTROL | {"gradient_steps": 4}, policy_delay=4), "Pendulum-v1"),
    "ppo, Box, KL stop, clipped value": Case(ppo.ppo, parts(PPO, target_kl=0.01, clip_range_vf=0.2), "Pendulum-v1", NORMALISED),
    "ppo, frames": Case(
        ppo.ppo, parts(PPO, normalize_advantage=False, clip_range="cosine(0.2, 0.1)"), "Acrobot-v1", (wrappers.frame_stack(3),)
    ),
    "ppo, gru": Case(ppo.ppo, parts(PPO, memory="gru", memory_size=8), "CartPole-v1", NORMALISED),
    "a2c, lstm": Case(a2c.a2c, a2c.Config(net_arch=(8,), memory="lstm", memory_size=8), "CartPole-v1"),
    "a2c, Box": Case(a2c.a2c, a2c.Config(net_arch=(8,)), "Pendulum-v1"),
    "a3c": Case(a3c.a3c, a3c.Config(net_arch=(8,), policy_lag=1, thread_lag=2), "CartPole-v1"),
    "a3c, Box": Case(a3c.a3c, a3c.Config(net_arch=(8,), normalize_advantage=True), "Pendulum-v1"),
    "impala, lstm": Case(impala.impala, impala.Config(net_arch=(8,), n_steps=5, memory="lstm", memory_size=8), "CartPole-v1"),
    "impala, Box": Case(impala.impala, impala.Config(net_arch=(8,), n_steps=5, policy_lag=0), "Pendulum-v1"),
    "trpo, Box": Case(trpo.trpo, TRPO, "Pendulum-v1", NORMALISED),
    "trpo, gru": Case(trpo.trpo, parts(TRPO, memory="gru", memory_size=8), "CartPole-v1"),
    "reinforce": Case(reinforce.reinforce, reinforce.Config(n_steps=8, net_arch=(8,)), "CartPole-v1"),
    "reinforce, lstm": Case(reinforce.reinforce, reinforce.Config(n_steps=8, net_arch=(8,), memory="lstm", memory_size=8), "CartPole-v1"),
    "dqn, gru": Case(dqn.dqn, parts(DQN, memory="gru", memory_size=8, sequence_length=4), "CartPole-v1"),
    "qr_dqn": Case(qr_dqn.qr_dqn, qr_dqn.Config(**OF_THE_FAMILY, n_quantiles=5, prioritized=True), "CartPole-v1"),
    "iqn": Case(iqn.iqn, iqn.Config(**OF_THE_FAMILY, n_quantiles=5, munchausen=True, dueling=True), "CartPole-v1"),
    "dqn, noisy quantiles with memory": Case(
        dqn.dqn, parts(DQN, memory="gru", memory_size=8, sequence_length=4, noisy=True, distribution="quantile"), "CartPole-v1"
    ),
    "dqn, munchausen, resets": Case(dqn.dqn, parts(DQN, munchausen=True, reset_every=40, tau=0.1, gradient_steps=-1), "CartPole-v1"),
    "dqn, boltzmann": Case(dqn.dqn, parts(DQN, exploration="boltzmann"), "CartPole-v1", NEW),
    "dqn, plain": Case(dqn.dqn, parts(DQN, learning_rate="exponential(1e-3, 1e-4)"), "CartPole-v1"),
    **{
        f"q_learning, {variant}": Case(q_learning.q_learning, parts(TABLE, variant=variant, visits_power=0.5), "MountainCar-v0", BINS)
        for variant in ("q_learning", "expected_sarsa", "double_q", "q_lambda")
    },
    **{
        f"q_learning, {how}": Case(q_learning.q_learning, parts(TABLE, exploration=how), "MountainCar-v0", BINS)
        for how in ("boltzmann", "ucb")
    },
    "q_learning, decay by episodes": Case(q_learning.q_learning, parts(TABLE, exploration_decay=0.99), "MountainCar-v0", BINS),
}


def described(tree) -> tuple:
    return jax.tree.structure(tree), [(leaf.shape, leaf.dtype, leaf.weak_type) for leaf in jax.tree.leaves(tree)]


@pytest.mark.parametrize("case", ALL.values(), ids=ALL)
def test_a_policy_acts_in_another_number_of_environments_than_it_learnt_in(case):
    algorithm, source = case.make()
    size = 2 * NUM_ENVS + 1

    def decide(key):
        policy = Policy(algorithm, wrappers.chain(), source.spec, actors=(), statistics=(), best=0)
        obs = jax.tree.map(lambda x: jnp.broadcast_to(x, (size, *x.shape[1:])), example_observation(source.spec.observation_space))
        actor, memory, noise = algorithm.actor(algorithm.init(key)), algorithm.memory(size), policy.noise(key, size)
        return algorithm.act(actor, memory, obs, noise)[:2], algorithm.greedy(actor, memory, obs, noise)[:2]

    (memory, action), (later, greedy) = jax.eval_shape(decide, jax.random.key(0))
    assert {action.shape[0], greedy.shape[0]} == {size}
    assert jax.tree.map(jnp.shape, memory) == jax.tree.map(jnp.shape, later) == jax.tree.map(jnp.shape, algorithm.memory(size))


@pytest.mark.parametrize("case", ALL.values(), ids=ALL)
def test_types_are_strong_and_stay_as_they_are_over_an_update(case):
    algorithm, source = case.make()

    def iteration(key, learn):
        learner, state = algorithm.init(key), source.init(key)
        noise = jax.tree.map(lambda leaf: leaf[0], source.draw(key, 1))
        after, rollout, episodes = source.collect(state, algorithm.actor(learner), noise)
        later, metrics = learn(learner, rollout, key)
        return (learner, state), (later, after), (metrics, episodes)

    for learn in (algorithm.update, algorithm.observe):
        before, after, reported = jax.eval_shape(lambda key, learn=learn: iteration(key, learn), jax.random.key(0))
        assert described(before) == described(after)
        assert not any(leaf.weak_type for leaf in jax.tree.leaves((after, reported)))
        assert not any(leaf.dtype.name.endswith("64") for leaf in jax.tree.leaves((after, reported)))
        assert all(leaf.shape == () for leaf in jax.tree.leaves(reported)), "metrics are reduced inside the program"


WITHOUT_NETWORKS = (q_learning.q_learning,)


@pytest.mark.parametrize("case", ALL.values(), ids=ALL)
def test_every_learner_with_networks_says_how_they_fare(case):
    algorithm, source = case.make()
    assert (algorithm.dynamics is None) == (case.build in WITHOUT_NETWORKS)
    if algorithm.dynamics is not None:
        replays = not algorithm.needs.on_policy and not isinstance(case, DataCase)

        def found_of(key):
            state, noise = algorithm.init(key), jax.tree.map(lambda leaf: leaf[0], source.draw(key, 1))
            rollout = source.collect(source.init(key), algorithm.actor(state), noise)[1]
            return algorithm.dynamics(state, () if replays else rollout)

        found = jax.eval_shape(found_of, jax.random.key(0))
        assert {"dead_units", "effective_rank", "grad_norm"} <= {name.split("/")[1] for name in found}
        assert ("train/replay_age" in found) == replays
        assert all((leaf.shape, leaf.dtype) == ((), jnp.float32) for leaf in jax.tree.leaves(found))


class Bound(NamedTuple):
    name: str
    runner: Runner
    alone: Runner
    """The second of the same agents by itself."""
    source: Source
    traces: list[str]


SLOW = (
    "ppo, bonuses",
    "dqn, hindsight",
    "td3",
    "crossq",
    "dqn, lstm",
    "a2c, gru",
    "a3c, gru",
    "trpo",
    "pqn",
    "td3_bc",
    "cql, Box",
    "muzero",
    "alphazero, fast moves, resignation, gate",
)
"""Cases whose machinery another one runs too."""


@pytest.fixture(scope="module", params=[pytest.param(name, marks=pytest.mark.slow if name in SLOW else ()) for name in RUN])
def bound(request, quick_compile) -> Bound:
    case = RUN[request.param]
    algorithm, source = case.make()
    traces: list[str] = []

    def counted(state, rollout, key):
        traces.append("update")
        return algorithm.update(state, rollout, key)

    with pytest.MonkeyPatch.context() as patch:
        # Random numbers of five iterations at once, so that segments end within and across them.
        patch.setattr(segment_module, "_ROWS_OF_A_PAGE", 5 * algorithm.needs.rollout_length * NUM_ENVS)
        many = runner(algorithm._replace(update=counted), source, 3, range(SEEDS))
        alone = runner(algorithm, source, 3, [1])
    return Bound(request.param, many, alone, source, traces)


def assert_equal(first, second) -> None:
    for (path, a), b in zip(jax.tree.leaves_with_path(first), jax.tree.leaves(second), strict=True):
        np.testing.assert_array_equal(words(a), words(b), err_msg=jax.tree_util.keystr(path))


def words(leaf) -> np.ndarray:
    return np.asarray(jax.random.key_data(leaf) if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key) else leaf)


def advance(bound: Bound, *segments: int, first: int = 0, carry: Carry | None = None) -> tuple[Carry, list]:
    """The carry after these segments, and their reports."""
    carry, reports = bound.runner.init() if carry is None else carry, []
    for count in segments:
        carry, report = bound.runner.advance(carry, first, count)
        first += count
        reports.append(jax.tree.map(np.asarray, report))
    return carry, reports


def test_three_segments_are_one_trace(bound):
    carry, _ = advance(bound, ITERATIONS)
    after_first = len(bound.traces)
    assert after_first > 0
    advance(bound, 1, 7, 3, first=ITERATIONS, carry=carry)
    assert len(bound.traces) == after_first


def test_the_carry_is_donated_and_no_two_leaves_share_memory(bound):
    carry = bound.runner.init()
    for segment in range(2):
        leaves = [leaf for leaf in jax.tree.leaves(carry) if leaf.size and not jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)]
        pointers = [leaf.unsafe_buffer_pointer() for leaf in leaves]
        assert len(set(pointers)) == len(pointers)
        before = carry
        carry, _ = bound.runner.advance(carry, segment * ITERATIONS, ITERATIONS)
        assert all(leaf.is_deleted() for leaf in jax.tree.leaves(before.learner)), "the old learner is not kept beside the new one"


def test_metrics_are_finite_and_one_number_a_seed(bound):
    _, reports = advance(bound, ITERATIONS, ITERATIONS)
    assert reports[-1].metrics
    for name, values in reports[-1].metrics.items():
        assert values.shape == (SEEDS,), name
        assert np.isfinite(values).all(), name
    assert (reports[0].episodes.steps == ITERATIONS * bound.runner.steps_per_iteration).all()


def test_the_same_seed_twice_is_bit_for_bit_the_same_and_other_seeds_are_not(bound):
    (first, reports), (second, again) = advance(bound, ITERATIONS), advance(bound, ITERATIONS)
    assert_equal((first, reports), (second, again))
    per_seed = [np.concatenate([np.ravel(np.asarray(leaf)[i]) for leaf in jax.tree.leaves(first.learner)]) for i in range(SEEDS)]
    assert not np.array_equal(per_seed[0], per_seed[1])
    assert not np.array_equal(per_seed[1], per_seed[2])


def test_ten_segments_of_one_are_one_of_ten(bound):
    """Across the end of a warm-up and of a block of random numbers too."""
    once, whole = advance(bound, 10)
    often, parts = advance(bound, *[1] * 10)
    assert_equal(once, often)
    assert_equal(whole[0].episodes.steps, sum(part.episodes.steps for part in parts))
    np.testing.assert_allclose(whole[0].episodes.return_sum, sum(part.episodes.return_sum for part in parts), rtol=1e-5)


def test_a_seed_among_others_is_that_seed_alone(bound):
    """Bit for bit on a CPU, where seeds take turns inside the program."""
    many, reports = advance(bound, ITERATIONS)
    one, report = bound.alone.advance(bound.alone.init(), 0, ITERATIONS)
    assert_equal(jax.tree.map(lambda leaf: leaf[1:2], (many, reports[0])), (one, report))


@pytest.mark.parametrize(
    "name",
    # Another of the first ones runs the machinery of those that are slow.
    ["reinforce, lstm", "ppo, gru", "a2c, Box", *(pytest.param(name, marks=pytest.mark.slow) for name in ("reinforce", "trpo", "a3c"))],
)
def test_a_seed_among_others_is_that_seed_alone_in_learners_that_are_not_tried_as_a_whole(name, quick_compile):
    many, alone = (runner(*ALL[name].make(), 3, indices) for indices in (range(2), [1]))
    (carry, report), (one, told) = (each.advance(each.init(), 0, 2) for each in (many, alone))
    assert_equal(jax.tree.map(lambda leaf: leaf[1:2], (carry, report)), (one, told))


def test_training_saving_loading_and_training_on_is_training_without_a_stop(bound, tmp_path: Path):
    through, reports = advance(bound, 6, 6)
    half, _ = advance(bound, 6)
    save_checkpoint(tmp_path, half, bound.source, Progressed(6, 1.5, 2.5), bound.runner.steps_per_iteration)
    assert [path.name for path in checkpoints(tmp_path)] == [str(6 * bound.runner.steps_per_iteration)]
    restored, progressed = restore(tmp_path, bound.runner, bound.source)
    assert progressed == Progressed(6, 1.5, 2.5)
    resumed, later = advance(bound, 6, first=6, carry=restored)
    assert_equal((through, reports[1]), (resumed, later[0]))
