"""What MuZero reaches: returns of finished runs, and every line of tic-tac-toe; written down as JSON.

python benchmarks/muzero.py RUN...        evaluate finished runs of muzero, or of another learner to be held against it
python benchmarks/muzero.py RUN --episodes 20
"""

import argparse
import json
import sys
from pathlib import Path

import thorndike as td
from thorndike.games.tic_tac_toe import TIC_TAC_TOE

ROOT = Path(__file__).parents[1]
RESULTS = ROOT / "benchmarks" / "results" / "muzero.json"


def described(run: Path, episodes: int) -> dict:
    """What a finished run was, and what its policy reaches. Ends the program for a run that is not finished."""
    facts = json.loads((run / "run.json").read_text())
    if facts["status"] != "finished":
        raise SystemExit(f"{run} is {facts['status']}, not finished: there is no result to write down")
    named = ("algorithm", "environment", "num_envs", "seeds", "config", "cpu_s", "versions", "platform")
    content = {name: facts[name] for name in named} | {"steps": facts["steps_done"], "commit": facts["git_commit"]}
    content["train"] = f"thorndike train {facts['algorithm']} {facts['environment']} --seeds {facts['seeds']} --seed {facts['seed']}"
    if facts["environment"] == TIC_TAC_TOE.id:
        return content | {"lines": {f"{count} simulations": walked(run, count) for count in (0, 64)}}
    found = td.load(run).evaluate(episodes, seed=0)
    figures = {name: getattr(found, name) for name in ("episodes", "mean", "iqm", "min", "ci95", "per_seed")}
    return content | figures | {"evaluate": f"thorndike eval RUN --episodes {episodes} --seed 0"}


def walked(run: Path, simulations: int) -> dict:
    """Every line that the policy leaves open as either side: won, drawn, lost; and the share of positions in which it keeps the value."""
    # The slow Python that the tests walk through.
    sys.path.insert(0, str(ROOT / "tests"))
    import tic_tac_toe_lines as lines

    choose = lines.chooser(run, simulations)
    first, second = (lines.walk(choose, agent) for agent in (0, 1))
    return {"first": first._asdict(), "second": second._asdict(), "keeps_the_value": lines.optimal_share(choose)}


def main() -> None:
    """Evaluate the runs and write them down, each in place of what stood there for its learner and environment."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", nargs="+", type=Path, metavar="RUN")
    parser.add_argument("--episodes", type=int, default=100)
    options = parser.parse_args()
    results = json.loads(RESULTS.read_text()) if RESULTS.exists() else {}
    for run in options.runs:
        content = described(run, options.episodes)
        name = f"{content['algorithm']} {content['environment']}"
        results[name] = content | {"command": f"python benchmarks/muzero.py RUN --episodes {options.episodes}"}
        RESULTS.write_text(json.dumps(results, indent=1) + "\n")
        print(name, {key: content[key] for key in ("steps", "cpu_s", "mean", "ci95", "per_seed", "lines") if key in content}, flush=True)


if __name__ == "__main__":
    main()
