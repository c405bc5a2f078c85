"""Questions that mean nothing, for stores to keep."""

from thorndike.language.preferences.judgements import Candidate, NewItem


def question(number: int, candidates: int = 2, **more) -> NewItem:
    texts = [Candidate({"text": f"answer {each} to {number}"}, made_by=f"model-{each}") for each in range(candidates)]
    return NewItem({"text": f"question {number}"}, texts, **more)
