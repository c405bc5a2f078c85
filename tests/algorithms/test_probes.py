"""Every learner on every probe environment that it applies to: ten seeds, all ten right.

The probes are one compiled program per learner: the seed axis holds ten seeds of each probe, and an environment that steps all probes
shows each seed its own.
"""

from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from thorndike.algorithms import (
    a2c,
    a3c,
    awac,
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
from thorndike.environments import wrappers
from thorndike.environments.native import factory
from thorndike.environments.native.randomness import draw_words
from thorndike.environments.native.vectorize import vectorize
from thorndike.environments.probes import PROBES, TIME_LIMIT, Probe
from thorndike.training.runner import runner
from thorndike.training.sources import compiled_source
from thorndike.types import Algorithm, Environment, EnvSpec, EpisodeStats, Rollout, Source, Wrapper

SEEDS, NUM_ENVS, GAMMA = 10, 8, 0.9
TOLERANCE, PROBABILITY = 0.05, 0.95
SAMPLES = 400
PLAIN = tuple(probe for probe in PROBES if probe.scale == 1)
SCALED = tuple(probe for probe in PROBES if probe.scale != 1)
DISCRETE = tuple(probe for probe in PLAIN if probe.action_values)
BOX = tuple(probe for probe in PLAIN if not probe.action_values)


def several(probes: Sequence[Probe], which: jax.Array | int) -> Environment:
    """The probe of number ``which``, as one program for all of them: their states are alike, and only one has a limit that is reached."""
    parts = [factory(probe.id)() for probe in probes]

    def one_of(trees: Sequence, number: jax.Array | int):
        return jax.tree.map(lambda *leaves: jnp.stack([jnp.broadcast_to(leaf, NUM_ENVS) for leaf in leaves])[number], *trees)

    def shown(number: jax.Array | int) -> Environment:
        return vectorize(
            parts[0]._replace(
                reset=lambda words: one_of([part.reset(words) for part in parts], number),
                observe=lambda signal: jnp.stack([part.observe(signal) for part in parts])[number],
                step=lambda signal, action, noise: one_of([part.step(signal, action, noise) for part in parts], number),
                draw_reset=draw_words,
                max_episode_steps=TIME_LIMIT,
            ),
            NUM_ENVS,
        )

    def init(key):
        state, obs = shown(which).init(key)
        return (jnp.asarray(which, jnp.int32), state), obs

    def step(state, action, noise):
        after, result = shown(state[0]).step(state[1], action, noise)
        return (state[0], after), result

    return Environment(init, step, shown(0).draw, shown(0).spec)


class Learnt(NamedTuple):
    """What the seeds of all probes ended with, ``[probes, seeds, ...]``."""

    probes: tuple[Probe, ...]
    actors: object
    statistics: object
    algorithm: Algorithm
    wrapper: Wrapper

    def values(self, number: int) -> np.ndarray:
        """``[seeds, observations]``."""
        return np.asarray(self._of_each_seed(number, lambda actor, seen: self.algorithm.value(actor, seen)))

    def actions(self, number: int) -> np.ndarray:
        """``[seeds, samples, observations]`` as the policy draws them; of one that explores by epsilon, without that."""

        def chosen(actor, seen):
            drawn = self.algorithm.draw(jax.random.key(7), SAMPLES)
            # One key a step is for all environments.
            noise = jax.tree.map(lambda leaf: leaf if leaf.ndim == 1 else leaf[:, : seen.shape[0]], drawn)
            choose = self.algorithm.greedy if hasattr(actor, "epsilon") else self.algorithm.act
            return jax.vmap(lambda drawn: choose(actor, self.algorithm.memory(seen.shape[0]), seen, drawn)[1])(noise)

        return np.asarray(self._of_each_seed(number, chosen))

    def _of_each_seed(self, number: int, function):
        obs = jnp.array(self.probes[number].observations)[:, None]

        def one(actor, statistics):
            return function(actor, self.wrapper.init(statistics, obs)[1])

        return jax.vmap(one)(*jax.tree.map(lambda leaf: leaf[number * SEEDS : (number + 1) * SEEDS], (self.actors, self.statistics)))


def learn(probes: tuple[Probe, ...], build, iterations: int, wrapper: Wrapper | None = None, noisy: bool = False) -> Learnt:
    """Train ten seeds on each of ``probes``, which have one kind of action, in one program.

    A ``noisy`` policy is one that explores by noise on its actions: it is asked without that.
    """
    wrapper = wrappers.chain() if wrapper is None else wrapper
    algorithm = build(wrapper.spec(several(probes, 0).spec))
    which = jnp.repeat(jnp.arange(len(probes)), SEEDS)
    bound = runner(algorithm, compiled_source(several(probes, 0), algorithm, wrapper), 0, range(len(which)))

    def begin(number, key):
        return compiled_source(several(probes, number), algorithm, wrapper).init(key)

    carry = bound.init()._replace(source=jax.jit(jax.vmap(begin))(which, jax.random.split(jax.random.key(1), len(which))))
    carry, _ = bound.advance(carry, 0, iterations)
    algorithm = algorithm._replace(act=algorithm.greedy) if noisy else algorithm
    return Learnt(probes, jax.vmap(algorithm.actor)(carry.learner), carry.source.statistics, algorithm, wrapper)


def random_steps(environment: Environment, steps: int) -> Rollout:
    """``steps`` steps of uniform actions, one after another, as a learner from data sees them."""
    box, total = isinstance(environment.spec.action_space, gymnasium.spaces.Box), steps // NUM_ENVS
    dice = jax.random.uniform(jax.random.key(2), (total, NUM_ENVS))
    actions = 2.0 * dice[..., None] - 1.0 if box else (2.0 * dice).astype(jnp.int32)

    def one(carry, drawn):
        state, obs = carry
        action, noise = drawn
        state, step = environment.step(state, action, noise)
        return (state, step.obs), Rollout(obs, action, {}, step, ())

    noise = environment.draw(jax.random.key(3), total)
    _, rows = jax.lax.scan(one, environment.init(jax.random.key(4)), (actions, noise))
    return jax.tree.map(lambda leaf: leaf.reshape(steps, *leaf.shape[2:]), rows)


def learn_from_data(probes: tuple[Probe, ...], build, updates: int) -> Learnt:
    """``learn`` from 4,000 steps of uniform actions on each probe, none of which is stepped while it learns."""
    algorithm = build(several(probes, 0).spec._replace(num_envs=1, engine="dataset"))
    rows = jax.jit(jax.vmap(lambda number: random_steps(several(probes, number), 4_000)))(jnp.arange(len(probes)))
    length, size = algorithm.needs.rollout_length, algorithm.needs.batch_size

    def collect(number, actor, drawn):
        counted = EpisodeStats(*[jnp.zeros((), jnp.float32)] * 3, jnp.full((), length, jnp.float32))
        return number, jax.tree.map(lambda leaf: leaf[number, drawn], rows), counted

    source = Source(
        init=lambda key: jnp.zeros((), jnp.int32),
        draw=lambda key, iterations: jax.random.randint(key, (iterations, length, size), 0, 4_000),
        collect=collect,
        statistics=lambda number: (),
        spec=several(probes, 0).spec,
        compiled=True,
    )
    which = jnp.repeat(jnp.arange(len(probes), dtype=jnp.int32), SEEDS)
    bound = runner(algorithm, source, 0, range(len(which)))
    carry, _ = bound.advance(bound.init()._replace(source=which), 0, updates // length)
    plain, asked = wrappers.chain(), algorithm._replace(act=algorithm.greedy)
    return Learnt(probes, jax.vmap(algorithm.actor)(carry.learner), (), asked, plain)


def check_values(learnt: Learnt, number: int) -> None:
    probe = learnt.probes[number]
    wrong = np.abs(learnt.values(number) - np.array(probe.values)).max(axis=1)
    assert (wrong <= TOLERANCE * probe.scale).all(), f"{probe.id} catches a mistake in {probe.catches}: V is wrong by {wrong.round(3)}"


def check_actions(learnt: Learnt, number: int) -> None:
    """The best action has 0.95 of the probability; of a Box, the actions whose reward is within 0.05 of the best one's."""
    probe = learnt.probes[number]
    actions, best = learnt.actions(number), np.array(probe.actions)
    right = actions == best if probe.action_values else np.square(actions[..., 0] - best) <= TOLERANCE
    probability = right.mean(axis=1).min(axis=1)
    assert (probability >= PROBABILITY).all(), f"{probe.id} catches a mistake in {probe.catches}: P(best) is {probability.round(3)}"


def ppo_for(iterations: int, spec: EnvSpec, **settings) -> Algorithm:
    config = {"n_steps": 20, "batch_size": 80, "n_epochs": 4, "gamma": GAMMA, "learning_rate": "linear(0.01, 0)", "net_arch": (16,)}
    return ppo.ppo(ppo.Config(total_steps=iterations * 20 * NUM_ENVS, **(config | settings)), spec)


def a2c_for(iterations: int, spec: EnvSpec, **settings) -> Algorithm:
    config = {"n_steps": 10, "gamma": GAMMA, "learning_rate": "linear(0.01, 0)", "net_arch": (16,)}
    return a2c.a2c(a2c.Config(total_steps=iterations * 10 * NUM_ENVS, **(config | settings)), spec)


def a3c_for(iterations: int, spec: EnvSpec, **settings) -> Algorithm:
    config = {"n_steps": 10, "gamma": GAMMA, "learning_rate": "linear(0.01, 0)", "ent_coef": 0.0, "net_arch": (16,)}
    return a3c.a3c(a3c.Config(total_steps=iterations * 10 * NUM_ENVS, **(config | settings)), spec)


def impala_for(iterations: int, spec: EnvSpec, **settings) -> Algorithm:
    config = {"n_steps": 10, "gamma": GAMMA, "learning_rate": "linear(0.01, 0)", "ent_coef": 0.0, "net_arch": (16,)}
    return impala.impala(impala.Config(total_steps=iterations * 10 * NUM_ENVS, **(config | settings)), spec)


def trpo_for(iterations: int, spec: EnvSpec, **settings) -> Algorithm:
    config = {"n_steps": 20, "batch_size": 80, "gamma": GAMMA, "learning_rate": "linear(0.01, 0)", "net_arch": (16,)}
    return trpo.trpo(trpo.Config(total_steps=iterations * 20 * NUM_ENVS, **(config | settings)), spec)


def reinforce_for(iterations: int, spec: EnvSpec, **settings) -> Algorithm:
    config = {"n_steps": 20, "gamma": GAMMA, "learning_rate": "linear(0.02, 0)", "net_arch": (16,), "max_grad_norm": 10.0}
    return reinforce.reinforce(reinforce.Config(total_steps=iterations * 20 * NUM_ENVS, **(config | settings)), spec)


def dqn_for(iterations: int, spec: EnvSpec, learner=dqn, **parts) -> Algorithm:
    """A learner of the deep Q family: a module of ``thorndike.algorithms``."""
    name = learner.__name__.rpartition(".")[2]
    config = {
        "total_steps": iterations * NUM_ENVS,
        "learning_rate": "linear(0.005, 0)",
        "buffer_size": 4000,
        "learning_starts": 200,
        "train_freq": NUM_ENVS,
        "gradient_steps": 4,
        "batch_size": 32,
        "target_update_interval": 10 * NUM_ENVS,
        "gamma": GAMMA,
        "exploration_final_eps": 0.2,
        "net_arch": (16,),
    }
    return getattr(learner, name)(learner.Config(**(config | parts)), spec)


def muzero_for(iterations: int, spec: EnvSpec, **settings) -> Algorithm:
    config = muzero.Config(
        total_steps=iterations * NUM_ENVS,
        learning_rate="linear(0.005, 0)",
        buffer_size=4000,
        learning_starts=200,
        train_freq=NUM_ENVS,
        gradient_steps=2,
        batch_size=32,
        gamma=GAMMA,
        unroll_steps=2,
        n_step=3,
        num_simulations=4,
        temperature="linear(1, 0.1)",
        value_limit=12.0,
        atoms=25,
        averaging=0.02,
        net_arch=(16,),
        state_size=12,
        width=16,
        **settings,
    )
    return muzero.muzero(config, spec)


def bootstrapped_for(iterations: int, spec: EnvSpec) -> Algorithm:
    config = bootstrapped_dqn.Config(
        total_steps=iterations * NUM_ENVS,
        learning_rate="linear(0.005, 0)",
        buffer_size=4000,
        learning_starts=200,
        train_freq=NUM_ENVS,
        gradient_steps=4,
        batch_size=32,
        target_update_interval=10 * NUM_ENVS,
        gamma=GAMMA,
        # With few members a seed is likely in which every prior puts the better action below what the other one is known to give.
        n_members=10,
        net_arch=(16,),
    )
    return bootstrapped_dqn.bootstrapped_dqn(config, spec)


def pqn_for(iterations: int, spec: EnvSpec, **settings) -> Algorithm:
    config = {"n_steps": 10, "batch_size": 80, "gamma": GAMMA, "learning_rate": "linear(0.01, 0)", "net_arch": (16,)}
    config |= {"exploration_final_eps": 0.2, "trace_decay": 0.5, "total_steps": iterations * 10 * NUM_ENVS}
    return pqn.pqn(pqn.Config(**(config | settings)), spec)


def control_for(iterations: int, learner, spec: EnvSpec, **parts) -> Algorithm:
    """A learner of continuous control: a module of ``thorndike.algorithms``."""
    name = learner.__name__.rpartition(".")[2]
    tau = {"tau": 0.05} if learner is not crossq else {}
    config = tau | {
        "total_steps": iterations * NUM_ENVS,
        "learning_rate": "linear(0.01, 0)",
        "buffer_size": 4000,
        "learning_starts": 200,
        "train_freq": NUM_ENVS,
        "gradient_steps": 2,
        "batch_size": 32,
        "gamma": GAMMA,
        "net_arch": (16,),
    }
    return getattr(learner, name)(learner.Config(**(config | parts)), spec)


def offline_for(updates: int, learner, spec: EnvSpec, **parts) -> Algorithm:
    """A learner from data: a module of ``thorndike.algorithms``."""
    name = learner.__name__.rpartition(".")[2]
    config = {"total_steps": updates, "learning_rate": "linear(0.01, 0)", "batch_size": 64, "tau": 0.05, "gamma": GAMMA, "net_arch": (16,)}
    return getattr(learner, name)(learner.Config(**(config | parts)), spec)


def table_for(iterations: int, variant: str, spec: EnvSpec) -> Algorithm:
    config = q_learning.Config(
        total_steps=iterations * 8 * NUM_ENVS,
        variant=variant,
        learning_rate="linear(0.3, 0.01)",
        gamma=GAMMA,
        n_steps=8,
        exploration_final_eps=0.0,
        exploration_fraction=1.0,
    )
    return q_learning.q_learning(config, spec)


def normalising() -> Wrapper:
    return wrappers.chain(wrappers.normalize_observation(), wrappers.normalize_reward(GAMMA))


CASES = {
    "ppo": lambda: learn(DISCRETE, partial(ppo_for, 60), 60),
    "ppo, Box": lambda: learn(BOX, partial(ppo_for, 60, log_std_init=-2.0), 60),
    "a2c": lambda: learn(DISCRETE, partial(a2c_for, 600), 600),
    "impala": lambda: learn(DISCRETE, partial(impala_for, 600), 600),
    "reinforce": lambda: learn(DISCRETE, partial(reinforce_for, 800), 800),
    "dqn": lambda: learn(DISCRETE, partial(dqn_for, 1200), 1200),
    "q_learning": lambda: learn(DISCRETE, partial(table_for, 60, "q_learning"), 60, wrappers.discretise(3)),
    "sac": lambda: learn(BOX, partial(control_for, 700, sac), 700),
}
SLOW_CASES = {
    "pqn": lambda: learn(DISCRETE, partial(pqn_for, 400), 400),
    "td3": lambda: learn(BOX, partial(control_for, 700, td3, action_noise=0.3), 700, noisy=True),
    "ddpg": lambda: learn(BOX, partial(control_for, 700, ddpg, action_noise=0.3), 700, noisy=True),
    "tqc": lambda: learn(BOX, partial(control_for, 1200, tqc), 1200),
    "crossq": lambda: learn(
        BOX, partial(control_for, 1000, crossq, critic_net_arch=(32,), renorm_warmup=100, batch_size=64, ent_coef_init=0.1), 1000
    ),
    "redq": lambda: learn(BOX, partial(control_for, 1200, redq, gradient_steps=4, policy_delay=2, n_critics=4), 1200),
    "ppo, Box, squashed": lambda: learn(BOX, partial(ppo_for, 60, log_std_init=-2.0, action_distribution="squashed"), 60),
    "ppo, Box, beta": lambda: learn(BOX, partial(ppo_for, 80, action_distribution="beta"), 80),
    "ppo, Box, held noise": lambda: learn(BOX, partial(ppo_for, 60, log_std_init=-2.0, use_sde=True, sde_sample_freq=4), 60),
    "sac, held noise": lambda: learn(BOX, partial(control_for, 1200, sac, use_sde=True, sde_sample_freq=4), 1200, noisy=True),
    "a2c, Box": lambda: learn(BOX, partial(a2c_for, 600, log_std_init=-2.0), 600),
    "a3c": lambda: learn(DISCRETE, partial(a3c_for, 600), 600),
    "a3c, Box": lambda: learn(BOX, partial(a3c_for, 800, log_std_init=-2.0, learning_rate="linear(0.003, 0)"), 800),
    "impala, Box": lambda: learn(BOX, partial(impala_for, 800, log_std_init=-2.0, learning_rate="linear(0.003, 0)"), 800),
    "trpo": lambda: learn(DISCRETE, partial(trpo_for, 60, target_kl=0.05), 60),
    "trpo, Box": lambda: learn(BOX, partial(trpo_for, 60, target_kl=0.05, log_std_init=-2.0), 60),
    "reinforce, Box": lambda: learn(BOX, partial(reinforce_for, 800, log_std_init=-2.0), 800),
    "dqn, double, dueling, 3 steps": lambda: learn(DISCRETE, partial(dqn_for, 1200, double=True, dueling=True, n_step=3), 1200),
    "rainbow": lambda: learn(DISCRETE, partial(dqn_for, 1200, learner=rainbow, v_min=-12.0, v_max=12.0, atoms=25), 1200),
    "bootstrapped_dqn": lambda: learn(DISCRETE, partial(bootstrapped_for, 1200), 1200),
    "dqn, boltzmann": lambda: learn(DISCRETE, partial(dqn_for, 1200, exploration="boltzmann", temperature="linear(1, 0.1)"), 1200),
    "dqn, prioritised": lambda: learn(DISCRETE, partial(dqn_for, 1200, prioritized=True), 1200),
    "dqn, noisy": lambda: learn(DISCRETE, partial(dqn_for, 2000, noisy=True), 2000),
    "dqn, c51": lambda: learn(DISCRETE, partial(dqn_for, 1200, distribution="c51", v_min=-12.0, v_max=12.0, atoms=25), 1200),
    "dqn, reset": lambda: learn(DISCRETE, partial(dqn_for, 2400, reset_every=801 * NUM_ENVS), 2400),
    "qr_dqn": lambda: learn(DISCRETE, partial(dqn_for, 1200, learner=qr_dqn, n_quantiles=8), 1200),
    "iqn": lambda: learn(DISCRETE, partial(dqn_for, 1600, learner=iqn, n_quantiles=8, net_arch=(32, 32)), 1600),
    "muzero": lambda: learn(DISCRETE, partial(muzero_for, 1200), 1200),
    # Expectiles near 1 and little conservatism: the values are then those of the best policy.
    "iql": lambda: learn_from_data(DISCRETE, partial(offline_for, 2000, iql, expectile=0.99, temperature=0.1), 2000),
    "iql, Box": lambda: learn_from_data(BOX, partial(offline_for, 4000, iql, expectile=0.99, temperature=0.02), 4000),
    "cql": lambda: learn_from_data(DISCRETE, partial(offline_for, 2000, cql, alpha=0.01), 2000),
    "cql, Box": lambda: learn_from_data(BOX, partial(offline_for, 2000, cql, alpha=0.01, n_actions=4), 2000),
    "td3_bc": lambda: learn_from_data(BOX, partial(offline_for, 4000, td3_bc, alpha=100.0), 4000),
    "awac": lambda: learn_from_data(BOX, partial(offline_for, 4000, awac, temperature=0.02), 4000),
    "sarsa": lambda: learn(DISCRETE, partial(table_for, 100, "sarsa"), 100, wrappers.discretise(3)),
    "expected sarsa": lambda: learn(DISCRETE, partial(table_for, 100, "expected_sarsa"), 100, wrappers.discretise(3)),
    "double q": lambda: learn(DISCRETE, partial(table_for, 100, "double_q"), 100, wrappers.discretise(3)),
    "q(lambda)": lambda: learn(DISCRETE, partial(table_for, 100, "q_lambda"), 100, wrappers.discretise(3)),
}


def with_slow(cases: dict, slow: dict) -> list:
    return [
        *(pytest.param(make, id=name) for name, make in cases.items()),
        *(pytest.param(make, id=name, marks=pytest.mark.slow) for name, make in slow.items()),
    ]


@pytest.mark.parametrize("train", with_slow(CASES, SLOW_CASES))
def test_every_seed_ends_with_the_right_values_and_actions(train, quick_compile):
    learnt = train()
    for number, probe in enumerate(learnt.probes):
        check_values(learnt, number)
        if probe.actions:
            check_actions(learnt, number)


SCALED_CASES = {"ppo": lambda: learn(SCALED[::2], partial(ppo_for, 60), 60, normalising())}
SLOW_SCALED_CASES = {
    "ppo, Box": lambda: learn(SCALED[1::2], partial(ppo_for, 60, log_std_init=-2.0), 60, normalising()),
    "dqn": lambda: learn(SCALED[::2], partial(dqn_for, 1200), 1200, normalising()),
}


@pytest.mark.parametrize("train", with_slow(SCALED_CASES, SLOW_SCALED_CASES))
def test_normalisation_makes_up_for_the_size_of_rewards_and_an_offset_of_observations(train, quick_compile):
    """Values are of normalised rewards, whose unit moves while learning, so actions alone are right or wrong."""
    learnt = train()
    for number in range(len(learnt.probes)):
        check_actions(learnt, number)
