"""Networks of continuous control: a policy's outputs, and ensembles of critics Q(s, a)."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import flax.linen as nn
import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, Key, PyTree

from thorndike.errors import UserError
from thorndike.functional.descent import Optimized
from thorndike.functional.held_noise import noise_features, state_dependent_parameters, with_constant
from thorndike.functional.learning_dynamics import mean_square_gradient
from thorndike.networks.hidden_layers import SHOWN, hidden_layers, look_into, look_into_ensemble
from thorndike.networks.masking import observed, without_mask
from thorndike.networks.network import Network, NetworkBuilder, flattened
from thorndike.networks.torso import ACTIVATIONS, Torso, example_observation, flatten_observation, is_image, torch_uniform
from thorndike.types import EnvSpec, Metrics, Number, Observation


class PolicyOutputs(nn.Module):
    """What a policy is made of, ``[B, outputs]``, from the observation; with ``state_dependent`` exploration, what held_noise.py says."""

    space: gymnasium.Space
    outputs: int
    hidden: Sequence[int]
    activation: str
    state_dependent: bool = False
    log_std_init: Number = 0.0

    @nn.compact
    def __call__(self, obs: Observation) -> Float[Array, "B P"]:
        """Observation ``[B, ...]`` to the policy's parameters."""
        features = Torso(self.space, self.hidden, self.activation, torch_uniform, name="torso")(obs)
        outputs = nn.Dense(self.outputs, kernel_init=torch_uniform, name="policy")(features)
        if not self.state_dependent:
            return outputs
        log_std = self.param("log_std", nn.initializers.constant(self.log_std_init), (noise_features(features.shape[-1]), self.outputs))
        return state_dependent_parameters(outputs, with_constant(features), log_std)


class ActionValue(nn.Module):
    """Q(s, a): one number, or ``outputs`` of them (quantiles). With ``layer_norm`` hidden layers are normalised before the activation."""

    space: gymnasium.Space
    hidden: Sequence[int]
    activation: str
    outputs: int
    layer_norm: bool

    @nn.compact
    def __call__(self, obs: Observation, action: Float[Array, "B D"]) -> Float[Array, "B outputs"]:
        """Observation ``[B, ...]`` and action to values."""
        x = jnp.concatenate([features_of(self.space, obs, self.hidden, self.activation), action], axis=-1)
        for width in self.hidden:
            x = nn.Dense(width, kernel_init=torch_uniform)(x)
            x = ACTIVATIONS[self.activation](nn.LayerNorm()(x) if self.layer_norm else x)
            self.sow(SHOWN, self.activation, x)
        return nn.Dense(self.outputs, kernel_init=torch_uniform)(x)


def features_of(space: gymnasium.Space, obs: Observation, hidden: Sequence[int], activation: str) -> Float[Array, "B F"]:
    """What a critic sees of an observation: images through convolutions, everything else as one row of numbers. Within a module."""
    if is_image(space):
        return Torso(space, hidden, activation, torch_uniform, name="torso")(obs)
    return flatten_observation(without_mask(space), observed(space, obs))


class StateDependent(NamedTuple):
    """Generalised state-dependent exploration."""

    sample_freq: int
    """Steps that its noise is held for; -1: a rollout's length."""
    log_std_init: Number


def state_dependent(use_sde: bool, sample_freq: int, log_std_init: Number, noise_color: float) -> StateDependent | None:
    """From the settings. Raises ``UserError`` where noise would be correlated in two ways at once."""
    if use_sde and noise_color > 0.0:
        raise UserError(f"use_sde holds its noise already: set noise_color to 0, not {noise_color:g}")
    return StateDependent(sample_freq, log_std_init) if use_sde else None


class Critics(NamedTuple):
    """An ensemble of K critics, whose parameters are one array ``[K, P]``."""

    init: Callable[[Key[Array, ""]], Float[Array, "K P"]]
    """key -> parameters. Consumes the key."""
    apply: Callable[[Float[Array, "K P"], Observation, Float[Array, "M D"]], Float[Array, "K M outputs"]]
    """parameters of all critics, or of some ``[k, P]``, observation, action -> values."""
    look: Callable[[Optimized, Observation, Float[Array, "M D"]], Metrics]
    """what is learnt ``[K, P]``, observation, action -> dead units, effective rank, gradient norms: the mean over the critics."""


def box_dimensions(algorithm: str, spec: EnvSpec) -> int:
    """How many numbers an action has. Raises ``UserError`` unless actions are a Box of one row of floats."""
    space = spec.action_space
    if isinstance(space, gymnasium.spaces.Box) and len(space.shape) == 1 and np.issubdtype(space.dtype, np.floating):
        return int(space.shape[0])
    raise UserError(
        f"{algorithm} takes Box actions, one row of floats; {spec.id} has {space}; ppo, a2c and reinforce take every kind, dqn Discrete"
    )


def policy_outputs(
    spec: EnvSpec,
    outputs: int,
    hidden: Sequence[int],
    activation: str,
    given: NetworkBuilder | None = None,
    exploration: StateDependent | None = None,
) -> tuple[Network, Callable[[Key[Array, ""]], Float[Array, " P"]]]:
    """The policy's network with its parameters as one flat vector, and what makes such a vector; the user's own network if one is given.

    Raises ``UserError`` for a network with memory, or one of the user's own with state-dependent ``exploration``.
    """
    if exploration is not None and (given is not None or not hidden):
        raise UserError(
            "use_sde explores by the last hidden layer of the library's own network: set it to false, or leave the network as is"
        )
    start = 0.0 if exploration is None else exploration.log_std_init
    module = PolicyOutputs(spec.observation_space, outputs, tuple(hidden), activation, exploration is not None, start)
    made = Network(
        lambda key, obs: module.init(key, obs)["params"],
        lambda params, obs: module.apply({"params": params}, obs),
        layers=hidden_layers(module),
    )
    network = made if given is None else given(spec, outputs)
    if network.recurrence is not None:
        raise UserError("this learner's policy has no memory: give a network without recurrence, or use ppo, a2c, reinforce or dqn")
    example = example_observation(spec.observation_space)
    return flattened(network, example), lambda key: ravel_pytree(network.init(key, example))[0]


def critics(
    spec: EnvSpec, dimensions: int, number: int, hidden: Sequence[int], activation: str, outputs: int = 1, layer_norm: bool = False
) -> Critics:
    """``number`` critics side by side: each layer of all of them is one batched matrix product.

    On a CPU that costs what one product a critic costs (measured with 2 and 10 critics of 256 x 256 on 256 rows: within 10 %), and compiles
    once instead of once a critic.
    """
    module = ActionValue(spec.observation_space, tuple(hidden), activation, outputs, layer_norm)
    example = example_observation(spec.observation_space), jnp.zeros((1, dimensions))
    template, shown = jax.eval_shape(module.init, jax.random.key(0), *example), hidden_layers(module)
    _, unravel = ravel_pytree(jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), template))

    def init(key: Key[Array, ""]) -> Float[Array, "K P"]:
        return jax.vmap(lambda one: ravel_pytree(module.init(one, *example))[0])(jax.random.split(key, number))

    def apply(params: Float[Array, "K P"], obs: Observation, action: Float[Array, "M D"]) -> Float[Array, "K M outputs"]:
        return jax.vmap(lambda flat: jnp.asarray(module.apply(unravel(flat), obs, action)))(params)

    def look(learnt: Optimized, obs: Observation, action: Float[Array, "M D"]) -> Metrics:
        def layers(flat: Float[Array, " P"]) -> PyTree:
            return shown(unravel(flat)["params"], obs, action)

        squares = mean_square_gradient(learnt.opt_state)
        return look_into_ensemble("critics", layers, lambda flat: unravel(flat)["params"], learnt.params, squares)

    return Critics(init, apply, look)


def look_into_actor_critic(
    policy: Network, actor: Optimized, judges: Critics, learnt: Optimized, obs: Observation, action: Float[Array, "M D"]
) -> Metrics:
    """Dead units, effective rank and gradient norms of a policy of flat parameters (as ``actor``) and of its critics."""
    return look_into(policy, actor.params, obs, mean_square_gradient(actor.opt_state), "actor") | judges.look(learnt, obs, action)
