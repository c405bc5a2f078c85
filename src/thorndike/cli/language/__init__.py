"""``thorndike language VERB ...``: language models; finds the verb's file and runs it."""

from collections.abc import Sequence

from thorndike.cli.answer import Answer
from thorndike.cli.verbs import chosen_verb, run_verb

LANGUAGE_VERBS = {
    "generate": "go on with prompts, several samples each",
    "chat": "talk with a model in the terminal",
    "pretrain": "a small model from nothing: its tokenizer and its parameters from plain text",
    "sft": "fine-tune a model on texts, prompts with completions, or conversations",
    "import": "put preferences, or candidates to be compared, into a store",
    "label": "a page on which people say which answer, or which clip, is better",
    "ask": "ask first what an ensemble of reward models disagrees about",
    "agree": "how far raters agree, and how far each can be trusted",
    "export": "a store's preferences as a file that TRL's trainers read",
    "reward": "a reward model from preferences, and how far it can be trusted",
    "ppo": "PPO towards a reward, held close to the base",
    "grpo": "GRPO: several completions of a prompt as each other's baseline",
    "rloo": "REINFORCE, the other completions of a prompt as the baseline",
    "dpo": "a policy from preferences, without a reward model",
    "eval": "a policy beside its base: win rate, divergence, drift",
    "demo": "all of it on a small model, with a report",
}
"""Verb -> its line in the help; each is a file beside this one."""

EXAMPLES = """\
  thorndike language pretrain movie-reviews --out runs/base
  thorndike language generate runs/base/model --prompt "The film was" --samples 4
  thorndike language sft runs/base/model --data answers.jsonl --out runs/tuned
  thorndike language chat runs/tuned/model
  thorndike language demo --out runs/demo
  thorndike language label --db prefs.db
`thorndike language VERB --help` tells more."""


def run(words: Sequence[str]) -> Answer:
    """Run a verb of language models."""
    return run_verb("language", chosen_verb("language", "Language models as Hugging Face folders.", LANGUAGE_VERBS, EXAMPLES, words), words)
