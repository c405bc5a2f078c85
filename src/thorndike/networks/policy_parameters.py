"""Which parameters of a network its policy depends on: found by tracing, so that it holds for a user's own network too."""

import jax
import numpy as np
from jax.interpreters import partial_eval
from jaxtyping import Bool

from thorndike.networks.network import Network
from thorndike.types import Observation


def reaches_policy(network: Network, example: Observation) -> Bool[np.ndarray, " P"]:
    """For each number of the flattened parameters of a policy and its value, whether it has a part in the policy's outputs."""
    params = jax.eval_shape(network.init, jax.random.key(0), example)
    program = jax.make_jaxpr(lambda tree: network.apply(tree, example)[0])(params).jaxpr
    _, used = partial_eval.dce_jaxpr(program, [True] * len(program.outvars))
    return np.concatenate([np.full(leaf.size, reached) for leaf, reached in zip(jax.tree.leaves(params), used, strict=True)])
