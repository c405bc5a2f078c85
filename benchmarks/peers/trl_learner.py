"""TRL's DPO, GRPO or PPO on a folder of ``language_models.py``: texts per CPU-second; a line for ``language_speed.py``.

float32 without gradient checkpointing, as on the other side; nothing is logged, saved or evaluated. PPO is of TRL 1.12.0, the last that
had it, which stands in a folder of its own on ``PYTHONPATH``.
"""

import argparse
import tempfile
from pathlib import Path

import torch
from datasets import load_dataset
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
    WARM_UP,
    variety,
)
from measurement import now, report, window
from transformers import AutoModelForCausalLM, AutoModelForSequenceClassification, AutoTokenizer, TrainerCallback


class Clock(TrainerCallback):
    """The moment after each step."""

    def __init__(self, texts: int) -> None:
        """``texts``: pairs or episodes of a step."""
        self.texts, self.moments = texts, []

    def on_step_end(self, args: object, state: object, control: object, **kwargs: object) -> None:
        """Called by the trainer."""
        self.moments.append(now((len(self.moments) + 1) * self.texts))


def shared(steps: int, out: str) -> dict[str, object]:
    """What is the same for all trainers."""
    return {
        "output_dir": out, "max_steps": steps, "learning_rate": LEARNING_RATE, "lr_scheduler_type": "constant", "use_cpu": True,
        "bf16": False, "gradient_checkpointing": False, "report_to": "none", "save_strategy": "no", "logging_strategy": "no",
        "disable_tqdm": True, "dataloader_pin_memory": False, "seed": 0,
    }  # fmt: skip


def policy(folder: Path) -> torch.nn.Module:
    return AutoModelForCausalLM.from_pretrained(folder / "policy", dtype=torch.float32)


def scorer(folder: Path) -> torch.nn.Module:
    return AutoModelForSequenceClassification.from_pretrained(folder / "reward", num_labels=1, dtype=torch.float32)


def train_dpo(folder: Path, steps: int, clock: Clock, out: str) -> None:
    from trl import DPOConfig, DPOTrainer

    config = DPOConfig(**shared(steps, out), per_device_train_batch_size=PAIRS, beta=BETA)
    data = load_dataset("json", data_files=str(folder / "preferences.jsonl"), split="train")
    tokenizer = AutoTokenizer.from_pretrained(folder / "policy")
    DPOTrainer(policy(folder), policy(folder), config, train_dataset=data, processing_class=tokenizer, callbacks=[clock]).train()


def train_grpo(folder: Path, steps: int, clock: Clock, out: str) -> None:
    from trl import GRPOConfig, GRPOTrainer

    config = GRPOConfig(
        **shared(steps, out), per_device_train_batch_size=BATCH, num_generations=GROUP, max_completion_length=NEW, beta=PENALTY,
    )  # fmt: skip
    data = load_dataset("json", data_files=str(folder / "prompts.jsonl"), split="train")
    tokenizer = AutoTokenizer.from_pretrained(folder / "policy", padding_side="left")

    def reward(completions: list[str], **columns: object) -> list[float]:
        return variety(completions)

    # The reference is loaded again by the model's path.
    GRPOTrainer(policy(folder), reward, config, train_dataset=data, processing_class=tokenizer, callbacks=[clock]).train()


def train_ppo(folder: Path, steps: int, clock: Clock, out: str) -> None:
    from trl.experimental.ppo import PPOConfig, PPOTrainer

    config = PPOConfig(
        **shared(steps, out), per_device_train_batch_size=BATCH, num_mini_batches=BATCH // MINIBATCH, num_ppo_epochs=EPOCHS,
        total_episodes=steps * BATCH, local_rollout_forward_batch_size=BATCH, response_length=NEW, temperature=1.0,
        kl_coef=KL_COEFFICIENT, num_sample_generations=0,
    )  # fmt: skip
    tokenizer = AutoTokenizer.from_pretrained(folder / "policy", padding_side="left")
    data = load_dataset("json", data_files=str(folder / "prompts.jsonl"), split="train")
    data = data.map(lambda row: {"input_ids": tokenizer(row["prompt"])["input_ids"]}, remove_columns=["prompt"])
    PPOTrainer(
        config, tokenizer, policy(folder), policy(folder), scorer(folder), data, scorer(folder), eval_dataset=data, callbacks=[clock]
    ).train()  # fmt: skip


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("learner", choices=("dpo", "grpo", "ppo"))
    parser.add_argument("--steps", type=int, required=True)
    parser.add_argument("folder", type=Path)
    options = parser.parse_args()
    torch.manual_seed(0)
    clock = Clock(PAIRS if options.learner == "dpo" else BATCH)
    train = {"dpo": train_dpo, "grpo": train_grpo, "ppo": train_ppo}[options.learner]
    with tempfile.TemporaryDirectory() as out:
        train(options.folder, WARM_UP + options.steps, clock, out)
    moments = clock.moments
    report(name="TRL", **window(moments[WARM_UP - 1], moments[-1]))
