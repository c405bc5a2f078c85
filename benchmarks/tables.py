"""Writes the tables of docs/performance.md, between their markers, from the JSON in benchmarks/results/."""

import json
from pathlib import Path

from contestants import TASKS

Result = dict


def number(value: float | None, digits: int | None = None) -> str:
    """A figure for people: three significant digits at least, thousands apart; a dash where there is none."""
    if value is None:
        return "-"
    if digits is not None:
        return f"{value:,.{digits}f}"
    return f"{value:,.0f}" if abs(value) >= 100 else f"{value:.3g}"


def rate_table(result: Result) -> list[str]:
    """Rates with their spread, and the first contestant's lead over each other."""
    rows = [
        "| | steps per CPU-s (lowest-highest) | steps/s | Thorndike is | compile, CPU-s | import, CPU-s | peak memory, MiB |",
        "|---|---|---|---|---|---|---|",
    ]
    contestants = result["contestants"]
    leader = next(iter(contestants))
    best = contestants[leader]["median"].get("steps_per_cpu_s")
    for name, contestant in contestants.items():
        median = contestant["median"]
        mine = median.get("steps_per_cpu_s")
        low, high = median.get("steps_per_cpu_s_range", (None, None))
        lead = f"{number(best / mine)}x" if best and mine and not name.startswith("Thorndike") else ""
        cells = [label(name, contestant), f"{number(mine)} ({number(low)}-{number(high)})", number(median.get("steps_per_s")), lead]
        cells += [number(median.get("compile_s"), 1), number(median.get("import_cpu_s"), 2), number(median.get("peak_memory_mb"))]
        rows.append("| " + " | ".join(cells) + " |")
    return rows


def threshold_table(result: Result) -> list[str]:
    """CPU-seconds and wall seconds to the threshold."""
    rows = ["| | CPU-s | wall, s | environment steps | reached | peak memory, MiB |", "|---|---|---|---|---|---|"]
    for name, contestant in result["contestants"].items():
        median = contestant["median"]
        cells = [label(name, contestant), number(median.get("cpu_s"), 1), number(median.get("wall_s"), 1), number(median.get("steps"))]
        cells += [f"{median.get('reached', 0)} of {median['runs']}", number(median.get("peak_memory_mb"))]
        rows.append("| " + " | ".join(cells) + " |")
    return rows


def startup_table(result: Result) -> list[str]:
    """Wall and CPU-seconds of whole short commands."""
    rows = ["| | CPU-s | wall, s | peak memory, MiB |", "|---|---|---|---|"]
    for name, contestant in result["contestants"].items():
        median = contestant["median"]
        cells = [name, number(median.get("cpu_s"), 2), number(median.get("wall_s"), 2), number(median.get("peak_memory_mb"))]
        rows.append("| " + " | ".join(cells) + " |")
    return rows


def label(name: str, contestant: Result) -> str:
    """The contestant's name with its note."""
    return f"{name}: {contestant['note']}" if contestant["note"] else name


def claims_lines(result: Result) -> list[str]:
    """Each claim with its figure and whether it holds."""
    lines = []
    for claim in result["claims"]:
        unit = {"steps_per_cpu_s": "steps per CPU-second", "cpu_s": "CPU-seconds", "wall_s": "seconds"}[claim["measure"]]
        verdict = "met" if claim["met"] else "**not met**"
        if claim["versus"] is None:
            lines.append(f"- {claim['of']}: {number(claim['value'])} {unit}; required <= {claim['at_most']:g}: {verdict}.")
            continue
        spread = " / ".join(number(ratio) for ratio in claim["each_round"])
        ratio = f"**{number(claim['value'])}x** (each round: {spread})"
        lines.append(f"- {claim['of']} / {claim['versus']}, {unit}: {ratio}; required >= {claim['at_least']:g}x: {verdict}.")
    return lines


def provenance(result: Result) -> str:
    """Where, when and with what it was measured."""
    machine, versions = result["machine"], result["versions"]
    ours, peers = versions["thorndike"], versions["peers"]
    names = {"stable_baselines3": "Stable-Baselines3", "sbx_rl": "SBX", "rejax": "rejax", "gymnax": "gymnax", "torch": "torch"}
    peer_text = ", ".join(f"{shown} {peers[name]}" for name, shown in names.items() if name in peers)
    return (
        f"{result['date']}, {machine['processor']}, one of {machine['cores']} cores; medians of {result['repeats']}; "
        f"commit `{result['commit']}`; "
        f"Python {ours.get('python', '?')}, jax {ours.get('jax', '?')}; {peer_text}."
    )


def section(result: Result) -> str:
    """Everything that stands between one pair of markers."""
    table = {"rate": rate_table, "threshold": threshold_table, "startup": startup_table}[result["kind"]](result)
    return "\n".join([f"Settings: {result['settings']}.", "", *table, "", *claims_lines(result), "", provenance(result)])


def between_markers(text: str, name: str, content: str) -> str:
    """``text`` with what stands between the markers of ``name`` replaced.

    Raises:
        ValueError: the markers are not there.
    """
    begin, end = f"<!-- bench:{name} -->", f"<!-- /bench:{name} -->"
    head, found, rest = text.partition(begin)
    _, closed, tail = rest.partition(end)
    if not found or not closed:
        raise ValueError(
            f"docs/performance.md: expected the markers {begin} and {end}, found {'only the first' if found else 'none'}; put them back"
        )
    return f"{head}{begin}\n{content}\n{end}{tail}"


def write_tables(results: Path, document: Path) -> None:
    """Renew the tables of ``document`` from ``results``; a task without a results file keeps its table."""
    text = document.read_text()
    for task in TASKS:
        path = results / f"{task.name}.json"
        if path.exists():
            text = between_markers(text, task.name, section(json.loads(path.read_text())))
    document.write_text(text)
