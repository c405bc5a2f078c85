"""What the verbs that learn from rewards and preferences share: flags, a progress line, the answer."""

import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from thorndike.cli.answer import Answer
from thorndike.cli.language.arguments import (
    add_device_argument,
    add_precision_arguments,
    add_settings_argument,
    given_settings,
    prepare_device,
    settings_in_words,
    sharing,
)
from thorndike.cli.language.config_file import parse_with_config
from thorndike.cli.language.hub import model_folder
from thorndike.cli.parser import Parser, positive_whole, seed_number
from thorndike.errors import UserError

if TYPE_CHECKING:
    from thorndike.language.lora import LoraConfig
    from thorndike.language.win_rate import Comparison

_EXAMPLES = """\
  thorndike language {verb} MODEL --reward runs/reward/model --prompts prompts.jsonl --out runs/{verb}
  thorndike language {verb} MODEL --reward my_rewards:kind --reward 0.1*runs/reward/model --prompts p.jsonl --out runs/{verb} --max-kl 20
The same command again goes on where it stopped. A reward function takes prompts, completions and ids (tokens of both), and returns a number
a text. Settings:
{settings}"""


def add_training_arguments(parser: Parser) -> None:
    """Model, folder, adapter, settings, seed, device."""
    parser.add_argument("model", metavar="MODEL", type=Path, help="a folder as save_pretrained writes it, or owner/name on the hub")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="the run's folder; its model/ is a Hugging Face folder")
    parser.add_argument("--lora", type=positive_whole, metavar="RANK", help="learn an adapter of this rank instead of all parameters")
    add_settings_argument(parser)
    add_precision_arguments(parser)
    parser.add_argument("--seed", type=seed_number, default=0, help="the number everything random follows from (default: 0)")
    add_device_argument(parser)


def lora_of(rank: int | None) -> "LoraConfig | None":
    """The adapter asked for."""
    from thorndike.language.lora import LoraConfig

    return None if rank is None else LoraConfig(rank, 2.0 * rank)


def teller(every: int = 1) -> Callable[[str], None] | None:
    """Lines for who is looking."""
    if not sys.stderr.isatty():
        return None
    return lambda line: print(line, file=sys.stderr)


def run_policy_verb(verb: str, summary: str, words: Sequence[str]) -> Answer:
    """``ppo``, ``grpo`` and ``rloo``."""
    module = "ppo" if verb == "ppo" else "grpo"
    parser = Parser(f"language {verb}", summary, _EXAMPLES.format(verb=verb, settings=settings_in_words(module)))
    add_training_arguments(parser)
    parser.add_argument("--reward", action="append", required=True, metavar="WHAT", help="WHAT or WEIGHT*WHAT; several are summed")
    parser.add_argument("--prompts", type=Path, action="append", required=True, metavar="FILE", help="rows with a column prompt")
    parser.add_argument("--max-kl", type=above_zero, metavar="NATS", help="stop beyond, and keep the last policy that was not")
    parser.add_argument("--no-limits", action="store_true", help="do not stop on disagreement, repetition or changed length either")
    options = parse_with_config(parser, words, verb, module)
    settings = given_settings(options.settings, module)
    if verb == "rloo" and "baseline" in settings:
        raise UserError("rloo is GRPO with baseline=leave_one_out; to choose another baseline: thorndike language grpo")
    options.model = model_folder(options.model)
    prepare_device(options.device, options.model, options.devices)
    from thorndike.language.aligning import align, parse_reward
    from thorndike.language.over_optimisation import Limits

    limits = Limits(options.max_kl, None, None, None) if options.no_limits else Limits(options.max_kl)
    show = teller()

    def told(step: int, values: Mapping[str, float]) -> None:
        if show is not None:
            length = values["rollout/ep_len_mean"]
            show(f"{step}: reward {values['objective/score']:.3f}, {values['objective/kl']:.2f} nats, {length:.0f} tokens")

    rewards = [parse_reward(text) for text in options.reward]
    with sharing(options.devices):
        outcome, found = align(
            options.model, rewards, options.prompts, options.out, verb, settings, limits=limits, lora=lora_of(options.lora),
            seed=options.seed, dtype=options.dtype, told=told,
        )  # fmt: skip
    data: dict[str, object] = {"run": options.out, "iterations": outcome.iterations, "stopped": outcome.stopped}
    if found is None:
        text = f"interrupted after {outcome.iterations} iterations\nthe same command again goes on from here"
        return Answer(data | {"status": "interrupted"}, text, 130)
    data |= {"status": "finished", "model": options.out / "model"}
    text = f"{outcome.iterations} iterations" + (f", stopped: {outcome.stopped}" if outcome.stopped else "")
    return Answer(data | comparison_data(found), f"{text}\n{in_words(found)}\nmodel: {options.out / 'model'}")


def comparison_data(found: "Comparison") -> dict[str, object]:
    """A comparison with the base without its samples."""
    judged = {name: each._asdict() for name, each in found.judged.items()}
    return {name: value for name, value in found._asdict().items() if name != "samples"} | {"judged": judged}


def in_words(found: "Comparison") -> str:
    """The same for people."""
    lines = [
        f"{name}: wins {each.win_rate:.1%} [{each.win_rate_ci95[0]:.1%}, {each.win_rate_ci95[1]:.1%}] of {found.prompts} prompts; "
        f"{each.base:.3f} -> {each.policy:.3f}"
        for name, each in found.judged.items()
    ]
    lines.append(f"{found.kl:.2f} nats a text from the base (sampled: {found.kl_k1:.2f})")
    lines.append(f"tokens {found.base_length:.1f} -> {found.length:.1f}, repetition {found.base_repetition:.3f} -> {found.repetition:.3f}")
    return "\n".join(lines)


def above_zero(text: str) -> float:
    """A finite number above 0."""
    import argparse
    import math

    try:
        number = float(text)
    except ValueError:
        number = math.nan
    if not 0.0 < number < math.inf:
        raise argparse.ArgumentTypeError(f"expected a number above 0; got '{text}'")
    return number
