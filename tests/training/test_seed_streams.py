"""A thousand runs of 64 environments: no two of them see the same random numbers, and none those of evaluation."""

from itertools import chain

import jax
import jax.numpy as jnp
import numpy as np

from thorndike.environments.native.cartpole import cartpole
from thorndike.environments.native.vectorize import vectorize
from thorndike.training.evaluation import _EVALUATION
from thorndike.training.host_source import environment_seeds
from thorndike.training.runner import agent_keys

RUNS, ENVIRONMENTS = 1000, 64


def test_64000_host_environments_have_seeds_of_their_own_and_none_that_evaluation_has():
    training = [environment_seeds(run, [0], ENVIRONMENTS, 0) for run in range(RUNS)]
    seeds = set(chain(*training))
    assert len(seeds) == RUNS * ENVIRONMENTS
    assert seeds.isdisjoint(environment_seeds(0, range(20), ENVIRONMENTS, _EVALUATION)), "evaluation as it is if nobody says otherwise"
    for run, own in enumerate(training):
        assert not set(own) & set(environment_seeds(run, [0], ENVIRONMENTS, _EVALUATION)), "evaluation with the seed of the run"


def test_64000_compiled_environments_have_random_numbers_and_keys_of_their_own():
    environment = vectorize(cartpole(), ENVIRONMENTS)

    def begin(run):
        keys = agent_keys(run, np.arange(1, dtype=np.uint32))
        evaluation = jax.random.fold_in(jax.random.key(run), _EVALUATION)
        key = keys.source[0]
        numbers = jax.tree.leaves(environment.draw(keys.loop[0], 3))
        return jnp.stack([each.reshape(3, ENVIRONMENTS) for each in numbers]), [
            jax.random.key_data(each) for each in (key, keys.loop[0], keys.learner[0], evaluation)
        ]

    numbers, keys = jax.jit(jax.vmap(begin))(np.arange(RUNS, dtype=np.uint32))
    streams = np.moveaxis(np.asarray(numbers), 3, 1).reshape(RUNS * ENVIRONMENTS, -1)
    # Of 64,000 single numbers of 32 bits two may be equal by chance; of streams, all that follows would have to be.
    assert streams.shape[1] == 3
    assert len(np.unique(streams, axis=0)) == RUNS * ENVIRONMENTS
    assert len(np.unique(np.concatenate(keys), axis=0)) == 4 * RUNS
