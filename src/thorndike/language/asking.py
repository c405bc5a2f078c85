"""What to ask people next: the questions about which the members of an ensemble of reward models disagree most.

Christiano et al. 2017 (arXiv:1706.03741), section 2.2.4: the pairs whose predicted preference varies most over the members.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from thorndike.errors import UserError
from thorndike.language.data import Text, completion_tokens, prompt_tokens
from thorndike.language.preferences.judgements import Content
from thorndike.language.preferences.store import Store
from thorndike.language.reward_files import RewardModel
from thorndike.language.tokenizer import Tokenizer

_BATCH = 256


class Asked(NamedTuple):
    """What was put in order."""

    items: int
    mean: float
    """The mean disagreement: a standard deviation of probabilities, from 0 to 0.5."""
    highest: float


def ask_where_members_disagree(store: Store, project: int, model: RewardModel) -> Asked:
    """Give every question of a project the members' disagreement as its priority; those with the highest are asked first.

    Raises ``UserError`` for a model of one member, and for questions that are no texts.
    """
    if len(model.members) < 2:
        raise UserError("one reward model has nobody to disagree with: train several with thorndike language reward --members 3")
    prompts, candidates = store.contents(project)
    questions = store.questions(project)
    if not questions:
        raise UserError("the project has no questions to put in order; put some in: thorndike language import --ask")
    places: list[tuple[int, int]] = []
    texts: list[list[int]] = []
    for number, question in questions.items():
        places.append((len(texts), len(texts) + len(question.candidates)))
        where = f"item {number}"
        texts += [_tokens(prompts[question.prompt], candidates[each].content, model.tokenizer, where) for each in question.candidates]
    parts = [model.all_scores(texts[begin : begin + _BATCH]) for begin in range(0, len(texts), _BATCH)]
    scores = np.concatenate(parts, axis=1)
    found = [disagreement(scores[:, begin:end]) for begin, end in places]
    store.set_priorities(dict(zip(questions, found, strict=True)))
    return Asked(len(found), float(np.mean(found)), float(np.max(found)))


def disagreement(scores: Float[np.ndarray, "E K"]) -> float:
    """The members' standard deviation of the probability that one candidate is better than another, the mean over all pairs."""
    pairs = [(i, j) for i in range(scores.shape[1]) for j in range(i + 1, scores.shape[1])]
    chances = np.stack([1.0 / (1.0 + np.exp(scores[:, j] - scores[:, i])) for i, j in pairs])
    return float(chances.std(axis=1).mean())


def _tokens(prompt: Content, answer: Content, tokenizer: Tokenizer, where: str) -> list[int]:
    before = _text(prompt, where)
    return [*prompt_tokens(before, tokenizer), *completion_tokens(before, _text(answer, where), tokenizer, where)]


def _text(content: Content, where: str) -> Text:
    found = content.get("text", content.get("messages"))
    if not isinstance(found, str | list):
        raise UserError(f"{where} is no text: a reward model of texts cannot read {', '.join(content)}")
    return found
