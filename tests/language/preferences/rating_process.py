"""A rater in a process of its own, who says on stdout what was acknowledged: rating_process.py STORE RATER VOTES."""

import sys

from thorndike.language.preferences.assignment import Plan, next_assignments
from thorndike.language.preferences.judgements import Response
from thorndike.language.preferences.store import Store


def rate(where: str, name: str, votes: int) -> None:
    with Store(where) as store:
        project, rater = store.project("votes"), store.rater(name)
        given = 0
        while given < votes:
            for assignment in next_assignments(store, project, rater, 4, Plan(gold=0, repeats=0)):
                store.judge(Response(assignment, "ab"[assignment % 2], f"{name} {assignment}"))
                print(assignment, flush=True)
                given += 1


if __name__ == "__main__":
    rate(sys.argv[1], sys.argv[2], int(sys.argv[3]))
