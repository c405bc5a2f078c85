"""What a function of arrays depends on, found by tracing it."""

from collections.abc import Callable

import jax
from jaxtyping import PyTree


def looked_at(function: Callable[[PyTree], PyTree], tree: PyTree) -> list[bool]:
    """Of each leaf of the argument (arrays or shapes): whether anything is computed with it, or it is handed back.

    A compiled function within counts as one that computes with all that it is given.
    """
    traced = jax.make_jaxpr(function)(tree).jaxpr
    used = {id(each) for equation in traced.eqns for each in equation.invars} | {id(each) for each in traced.outvars}
    return [id(each) in used for each in traced.invars]
