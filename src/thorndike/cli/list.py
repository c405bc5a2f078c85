"""``thorndike list [WHAT]``: what there is, from files and tables alone."""

from collections.abc import Sequence
from pathlib import Path
from typing import TypeAlias

from thorndike.algorithms import ALGORITHMS
from thorndike.cli.answer import Answer
from thorndike.cli.find_run import add_output_argument
from thorndike.cli.parser import Parser
from thorndike.cli.tables import mean, table
from thorndike.config_fields import read_config_fields
from thorndike.errors import UserError
from thorndike.games.registry import game_ids
from thorndike.settings import describe_kind
from thorndike.suggestions import did_you_mean
from thorndike.training.run_listing import all_runs, last_row, read_facts

Row: TypeAlias = dict[str, object]

WHATS = ("runs", "algorithms", "environments", "presets", "settings")
EXAMPLES = """\
  thorndike list                     the runs
  thorndike list settings ppo        what --set can change, with defaults
  thorndike list environments"""


def run(words: Sequence[str]) -> Answer:
    """List one kind of thing; runs by default."""
    parser = Parser("list", "List runs, algorithms, environments, presets, or the settings of an algorithm.", EXAMPLES)
    parser.add_argument("what", nargs="?", default="runs", metavar="WHAT", help=f"one of {', '.join(WHATS)} (default: runs)")
    parser.add_argument("algorithm", nargs="?", metavar="ALGORITHM", help="for settings: whose")
    add_output_argument(parser)
    options = parser.parse(words)
    if options.what not in WHATS:
        raise UserError(f"cannot list '{options.what}'{did_you_mean(options.what, WHATS)}")
    if options.what == "settings":
        return _settings(options.algorithm)
    if options.algorithm is not None:
        raise UserError(f"did not expect '{options.algorithm}' after 'list {options.what}'")
    lists = {"runs": lambda: _runs(options.output), "algorithms": _algorithms, "environments": _environments, "presets": _presets}
    return lists[options.what]()


def _runs(output: Path) -> Answer:
    rows: list[Row] = []
    for directory in all_runs(output):
        facts = read_facts(directory)
        row = {name: facts.get(name) for name in ("algorithm", "environment", "status", "steps_done", "steps", "seeds")}
        rows.append({"run": directory, **row, "mean_return": mean(last_row(directory / "metrics.jsonl").get("rollout/ep_rew_mean"))})
    if not rows:
        return Answer({"runs": []}, f"{output}/ holds no run yet; make one: thorndike train ppo CartPole-v1")
    return Answer({"runs": rows}, table([{**row, "run": Path(str(row["run"])).name} for row in rows]))


def _algorithms() -> Answer:
    rows: list[Row] = [{"algorithm": name, "description": entry.description} for name, entry in ALGORITHMS.items()]
    return Answer({"algorithms": rows}, table(rows))


def _environments() -> Answer:
    import gymnasium

    from thorndike.environments.host.envpool_ids import pool_ids, pool_is_installed
    from thorndike.environments.native import NATIVE

    native = [name for name in NATIVE if not name.startswith("probe/")]
    probes = [name for name in NATIVE if name.startswith("probe/")]
    pool = sorted(pool_ids()) if pool_is_installed() else []
    host = sorted(set(gymnasium.registry) - set(native))
    groups: dict[str, object] = {"native": native, "games": list(game_ids()), "probes": probes, "gymnasium": host, "envpool": pool}
    text = "\n".join(
        [
            f"compiled: {', '.join(native)},",
            "  and every Gymnasium environment with a transition table, such as FrozenLake-v1, CliffWalking-v1, Taxi-v4",
            f"games of two players, which play themselves: {', '.join(game_ids())}",
            f"probes, which tell whether a learner is right: {', '.join(probes)}",
            f"Gymnasium: {', '.join(host)}",
            f"EnvPool: {len(pool)} ids, listed by --json" if pool else "EnvPool: not installed: pip install 'thorndike[pool]'",
            "your own: module:Id, module:Class or path/to/file.py:Class",
        ]
    )
    return Answer(groups, text)


def _presets() -> Answer:
    from thorndike.training.presets import load_presets

    rows: list[Row] = [
        {"algorithm": algorithm, "environment": environment, "preset": name, "steps": preset.steps, "settings": preset.settings}
        for algorithm in ALGORITHMS
        for environment, variants in load_presets(algorithm).items()
        for name, preset in variants.items()
    ]
    return Answer({"presets": rows}, table(rows) if rows else "there are no presets")


def _settings(algorithm: str | None) -> Answer:
    if algorithm is None:
        raise UserError(f"whose settings? One of {', '.join(ALGORITHMS)}, as in: thorndike list settings ppo")
    rows: list[Row] = []
    for facts in read_config_fields(algorithm).values():
        limits = ", ".join(map(str, facts.bounds)) or describe_kind(facts.kind)
        rows.append({"setting": facts.name, "default": facts.default, "value": limits, "meaning": facts.comment})
    rows = [row for row in rows if row["setting"] != "total_steps"]
    return Answer({"algorithm": algorithm, "settings": rows}, table(rows))
