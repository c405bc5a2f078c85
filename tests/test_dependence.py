"""What functions depend on."""

import jax
import jax.numpy as jnp

from thorndike.dependence import looked_at


def test_what_is_computed_with_or_handed_back_is_told_from_what_is_not():
    tree = {"a": jnp.ones(3), "b": (jnp.zeros((2, 2)), jax.ShapeDtypeStruct((), jnp.int32)), "c": jax.random.key(0)}
    asked = {
        "a": lambda tree: tree["a"] * 2,
        "b": lambda tree: {"same": tree["b"][0], "shape": jnp.zeros(tree["c"].shape)},
        "both": lambda tree: jax.lax.cond(tree["b"][1] > 0, lambda: tree["a"], lambda: tree["a"] + 1),
        "key": lambda tree: jax.random.normal(tree["c"]),
        "none": lambda tree: jnp.float32(1),
    }
    found = {name: looked_at(function, tree) for name, function in asked.items()}
    assert found == {
        "a": [True, False, False, False],
        "b": [False, True, False, False],
        "both": [True, False, True, False],
        "key": [False, False, False, True],
        "none": [False] * 4,
    }
