"""``thorndike language VERB ...``: language models; finds the verb's file and runs it."""

import importlib
from collections.abc import Sequence

from thorndike.cli.answer import Answer
from thorndike.cli.parser import Parser
from thorndike.errors import UserError
from thorndike.suggestions import did_you_mean

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
    listed = "; ".join(f"{verb}: {summary}" for verb, summary in LANGUAGE_VERBS.items())
    verb = next((word for word in words if not word.startswith("-")), None)
    if verb is None:
        parser = Parser("language", f"Language models as Hugging Face folders. {listed}.", EXAMPLES)
        parser.add_argument("verb", metavar="VERB", help=f"one of {', '.join(LANGUAGE_VERBS)}")
        parser.parse(words)
    if verb not in LANGUAGE_VERBS:
        raise UserError(f"there is no verb 'language {verb}'{did_you_mean(str(verb), LANGUAGE_VERBS)}; see: thorndike language --help")
    rest = list(words)
    rest.remove(str(verb))
    answer: Answer = importlib.import_module(f"thorndike.cli.language.{verb}").run(rest)
    return answer
