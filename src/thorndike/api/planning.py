"""``train planning``: plan on an environment's transition table, and keep the plan as a run whose policy is a table."""

import time
from collections.abc import Mapping
from pathlib import Path
from typing import cast

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np

from thorndike.algorithms.planning import Config, Solution, plan
from thorndike.api.building import build_algorithm, build_config, full_config
from thorndike.api.exporting import write_policy
from thorndike.api.training_result import Result
from thorndike.environments import registry
from thorndike.environments.native.blackjack_table import blackjack_table
from thorndike.environments.native.table import Table, read_table
from thorndike.errors import UserError
from thorndike.plotting.grid_world import Grid, picture, read_grid, save_picture
from thorndike.training.run_directory import facts, new_run_directory, write_json
from thorndike.training.space_files import space_to_json
from thorndike.types import EnvSpec


def plan_run(choice: registry.Choice, settings: Mapping[str, object], output: str | Path, name: str | None, command: str | None) -> Result:
    """Plan, print values and policy, and write the run. Raises ``UserError`` if the environment has no table.

    The policy exported is the greedy one; of a finite horizon, the one for its first step.
    """
    wall, cpu = time.perf_counter(), time.process_time()
    config = full_config("planning", settings)
    environment = registry.reference(choice)
    try:
        table, grid = table_of(choice, environment), read_grid(environment)
        spec = EnvSpec(choice.id, environment.observation_space, environment.action_space, 1, choice.max_episode_steps)
    finally:
        environment.close()
    solution = plan(table, cast(Config, build_config("planning", config)))
    run = new_run_directory(output, choice.id, "planning", name)
    described: dict[str, object] = {
        "algorithm": "planning", "environment": choice.id, "env_kwargs": dict(choice.env_kwargs), "engine": "table", "config": config,
        "max_episode_steps": choice.max_episode_steps, "environment_object": not isinstance(choice.origin, str), "network": "default",
        "wrappers": [], "seeds": 1, "seed": 0, "num_envs": 1, "steps": solution.iterations,
    }  # fmt: skip
    _export(run, spec, solution, described)
    _draw(run, grid, solution)
    value = solution.start_value(table)
    write_json(run / "values.json", {"start_value": value, "iterations": solution.iterations, "residual": solution.residual,
                                     "values": solution.values.tolist(), "policy": solution.policy.tolist()})  # fmt: skip
    wall_s, cpu_s = time.perf_counter() - wall, time.process_time() - cpu
    times = {"wall_s": wall_s, "cpu_s": cpu_s, "compile_s": 0.0, "steps_done": solution.iterations}
    write_json(run / "run.json", {**facts(), "status": "finished", "command": command, **described, **times, "start_value": value})
    sweeps = solution.iterations
    return Result(run, "finished", sweeps, 1, wall_s, cpu_s, 0.0, sweeps / wall_s, sweeps / max(cpu_s, 1e-9), value)


def table_of(choice: registry.Choice, environment: gymnasium.Env) -> Table:
    """The transition table of an environment: its own, or the one counted out for Blackjack."""
    if choice.id == "Blackjack-v1":
        rules = choice.env_kwargs
        return blackjack_table(natural=bool(rules.get("natural", False)), sab=bool(rules.get("sab", True)))
    return read_table(environment)


def _export(run: Path, spec: EnvSpec, solution: Solution, described: dict[str, object]) -> None:
    """The plan as the policy of a tabular learner, which is what acts on it."""
    learner = full_config("q_learning", {"total_steps": 1, "exploration_initial_eps": 0.0, "exploration_final_eps": 0.0})
    algorithm = build_algorithm("q_learning", learner, spec, None)
    actor = algorithm.actor(algorithm.init(jax.random.key(0)))
    # Blackjack's table also tells a natural from other hands of 21, which no observation does.
    seen = solution.q_values[: len(actor.q)]
    if seen.size != actor.q.size:
        raise UserError(f"{spec.id} has a table of {seen.size} values, but its spaces count {actor.q.size}")
    actor = actor._replace(q=jnp.asarray(seen, jnp.float32).reshape(actor.q.shape))
    spaces = {"observation_space": space_to_json(spec.observation_space), "action_space": space_to_json(spec.action_space)}
    arrays = {"actor": jax.tree.map(lambda x: x[None], actor), "statistics": ()}
    write_policy(run, arrays, {**described, **spaces, "algorithm": "q_learning", "config": learner, "planned": True, "best": 0})


def _draw(run: Path, grid: Grid | None, solution: Solution) -> None:
    """``plan.txt``, and ``plan.png`` where there is a map and matplotlib to draw it."""
    values, policy = (np.atleast_2d(rows)[0] for rows in (solution.values, solution.policy))
    (run / "plan.txt").write_text(picture(grid, values, policy) + "\n", encoding="utf-8")
    if grid is None:
        return
    try:
        save_picture(grid, values, policy, run / "plan.png")
    except UserError as error:
        (run / "plan.png.missing").write_text(f"{error}\n", encoding="utf-8")
