"""Thorndike's DPO, GRPO or PPO on a folder of ``language_models.py``: texts per CPU-second; a line for ``language_speed.py``."""

import argparse
import sys
import tempfile
from collections.abc import Iterator
from itertools import count
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent / "peers"))

from language_task import (
    BATCH,
    BETA,
    EPOCHS,
    GROUP,
    KL_COEFFICIENT,
    LEARNING_RATE,
    MINIBATCH,
    NEW,
    PAIRS,
    PENALTY,
    PROMPT,
    WARM_UP,
    variety,
)
from measurement import Moment, now, report, window

from thorndike import startup


def dpo_steps(folder: Path, steps: int) -> Iterator[Moment]:
    """Comparisons; the reference reads each batch before it is learnt from, as TRL's does."""
    import jax
    import numpy as np

    from thorndike.language.comparisons import ComparisonBatch, comparison_data
    from thorndike.language.dpo import Batch, Config, completion_log_probs, dpo
    from thorndike.language.model import load_model
    from thorndike.language.preference_files import read_comparisons

    model = load_model(folder / "policy")
    data = comparison_data(read_comparisons([folder / "preferences.jsonl"], model.tokenizer), model.tokenizer.pad_id)
    learner = dpo(Config(total_steps=steps, learning_rate=LEARNING_RATE, batch_size=PAIRS, beta=BETA), model.config)
    state = learner.init(model.params, jax.random.key(0))
    update = jax.jit(learner.update, donate_argnums=0)

    @jax.jit
    def read(params: object, batch: ComparisonBatch) -> jax.Array:
        return completion_log_probs(params, model.config, batch)

    for step in range(steps):
        rows = data.rows(np.arange(step * PAIRS, (step + 1) * PAIRS) % len(data.valid))
        state, metrics = update(state, (), Batch(rows, read(model.params, rows)))
        # Fetched each step, so that a step is over where the clock is read.
        float(metrics["train/loss"])
        yield now((step + 1) * PAIRS)


def policy_steps(learner: str, folder: Path, steps: int) -> list[Moment]:
    """Episodes, through the loop that ``thorndike language grpo`` and ``ppo`` run."""
    from thorndike.language import grpo, ppo
    from thorndike.language.model import load_model
    from thorndike.language.over_optimisation import Limits
    from thorndike.language.policy_learner import PolicyLearner
    from thorndike.language.policy_training import Task, train_policy
    from thorndike.language.preference_files import read_prompts
    from thorndike.language.reward_files import load_reward_model
    from thorndike.language.rewards import Score, model_score
    from thorndike.language.rollouts import make_prompts
    from thorndike.language.text_run import open_run

    base = load_model(folder / "policy")
    config: grpo.Config | ppo.Config
    score: Score
    built: PolicyLearner
    if learner == "grpo":
        config = grpo.Config(
            total_steps=steps, episodes=BATCH, group=GROUP, max_prompt_length=PROMPT, max_new_tokens=NEW, learning_rate=LEARNING_RATE,
            batch_size=BATCH, kl_coefficient=PENALTY,
        )  # fmt: skip
        built, score = grpo.grpo(config, base.config, base.params), lambda prompts, completions, ids: variety(completions)
    else:
        reward = load_reward_model(folder / "reward")
        config = ppo.Config(
            total_steps=steps, episodes=BATCH, max_prompt_length=PROMPT, max_new_tokens=NEW, learning_rate=LEARNING_RATE,
            n_epochs=EPOCHS, batch_size=MINIBATCH, kl_coefficient=KL_COEFFICIENT, target_kl=None,
        )  # fmt: skip
        built, score = ppo.ppo(config, base.config, base.params, reward.members[0]), model_score(reward)
    prompts, moments, done = make_prompts(read_prompts([folder / "prompts.jsonl"]), base.tokenizer, PROMPT), [], count(1)
    with tempfile.TemporaryDirectory() as run:
        open_run(Path(run), {"learner": learner})
        train_policy(
            Task(base, prompts, score), built, config, Path(run), limits=Limits(None, None, None, None), checkpoint_every=steps + 1,
            told=lambda step, values: moments.append(now(next(done) * BATCH)),
        )  # fmt: skip
    return moments


if __name__ == "__main__":
    # What is set here is read when JAX is imported.
    startup.prepare()
    startup.prepare_large_steps()
    parser = argparse.ArgumentParser()
    parser.add_argument("learner", choices=("dpo", "grpo", "ppo"))
    parser.add_argument("--steps", type=int, required=True)
    parser.add_argument("folder", type=Path)
    options = parser.parse_args()
    total = WARM_UP + options.steps
    start = now()
    found = list(dpo_steps(options.folder, total)) if options.learner == "dpo" else policy_steps(options.learner, options.folder, total)
    report(name="Thorndike", warm_up_cpu_s=window(start, found[WARM_UP - 1])["cpu_s"], **window(found[WARM_UP - 1], found[-1]))
