import jax
import jax.numpy as jnp
import numpy as np

from thorndike.networks.batch_renorm import EPSILON, MOMENTUM, BatchRenorm, renormalized_network

ROWS = jnp.asarray(np.random.default_rng(0).normal(3.0, 2.0, size=(64, 4)).astype(np.float32))


def layer(warmup: int):
    module = BatchRenorm(warmup)
    return module, module.init(jax.random.key(0), ROWS, True)


def test_before_the_warm_up_ends_rows_are_standardised_by_the_batch():
    module, held = layer(10)
    rows, _ = module.apply(held, ROWS, True, mutable=["batch_stats"])
    np.testing.assert_allclose(rows.mean(axis=0), 0.0, atol=1e-5)
    np.testing.assert_allclose(rows.std(axis=0), 1.0, atol=1e-3)


def test_after_it_the_correction_makes_them_what_the_running_moments_give():
    module, held = layer(0)
    running = {"mean": jnp.full(4, 2.5), "variance": jnp.full(4, 3.0), "seen": jnp.float32(5)}
    held = {"params": held["params"], "batch_stats": running}
    rows, _ = module.apply(held, ROWS, True, mutable=["batch_stats"])
    np.testing.assert_allclose(rows, module.apply(held, ROWS, False), rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(rows, (ROWS - 2.5) / np.sqrt(3.0 + EPSILON), rtol=1e-4, atol=1e-5)


def test_running_moments_move_towards_the_batchs():
    module, held = layer(0)
    assert held["batch_stats"]["seen"] == 0.0
    _, later = module.apply(held, ROWS, True, mutable=["batch_stats"])
    np.testing.assert_allclose(later["batch_stats"]["mean"], (1 - MOMENTUM) * np.mean(ROWS, axis=0), rtol=1e-4)
    np.testing.assert_allclose(later["batch_stats"]["variance"], MOMENTUM + (1 - MOMENTUM) * np.var(ROWS, axis=0), rtol=1e-4)
    assert later["batch_stats"]["seen"] == 1.0


def test_acting_treats_each_row_alone_and_learning_does_not():
    net = renormalized_network(4, 2, (8,), "relu", 0)
    params, moments = net.init(jax.random.key(1))
    for _ in range(3):
        _, moments = net.learning(params, moments, ROWS)
    np.testing.assert_allclose(net.acting(params, moments, ROWS)[:1], net.acting(params, moments, ROWS[:1]), rtol=1e-5, atol=1e-6)
    fresh = net.init(jax.random.key(1))[1]
    warming = renormalized_network(4, 2, (8,), "relu", 10)
    assert not np.allclose(warming.learning(params, fresh, ROWS)[0][:8], warming.learning(params, fresh, ROWS[:8])[0])
