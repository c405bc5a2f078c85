"""The demo's report: one page that needs nothing else, a picture, and all figures as JSON."""

import base64
import html
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple, TypeAlias, cast

from thorndike.plotting.style import COLOURS, STYLE, check_plot_file, save_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_NAMES = {
    "ppo": "PPO", "grpo": "GRPO", "rloo": "RLOO", "dpo": "DPO", "ppo_without_kl": "PPO without a penalty",
    "ppo_max_kl": "PPO without a penalty, stopped in time",
}  # fmt: skip
_STYLE = """body{font:16px/1.5 system-ui,sans-serif;max-width:60rem;margin:2rem auto;padding:0 1rem;color:#222}
table{border-collapse:collapse;width:100%;margin:1rem 0}img{max-width:100%}
td,th{border-bottom:1px solid #ddd;padding:.35rem .6rem;text-align:left;vertical-align:top}
td.n,th.n{text-align:right;font-variant-numeric:tabular-nums}"""

Found: TypeAlias = Mapping[str, object]


class Files(NamedTuple):
    """Where the report is."""

    page: Path
    picture: Path
    figures: Path


def write_report(out: Path, found: Found) -> Files:
    """Write ``report.html`` and ``report.png`` beside ``report.json``. Raises ``UserError`` where Matplotlib is missing."""
    files = Files(out / "report.html", out / "report.png", out / "report.json")
    check_plot_file(files.picture)
    draw(found, files.picture)
    files.page.write_text(page(found, files.picture.read_bytes()), encoding="utf-8")
    return files


def draw(found: Found, path: Path) -> None:
    """What is wanted beside the distance from the base, and what the reward model says and what is wanted while the policy learns."""
    import matplotlib as mpl
    from matplotlib.figure import Figure

    with mpl.rc_context(cast(dict, STYLE)):
        figure = Figure(figsize=(11, 4.2), layout="constrained")
        left, right = figure.subplots(1, 2)
        _equal_distance(left, found)
        _curves(right, found)
        save_figure(figure, path)


def page(found: Found, picture: bytes) -> str:
    """The report as HTML."""
    labels, reward = _part(found, "labels"), _part(found, "reward")
    low, high = cast(Sequence[float], reward["accuracy_ci95"])
    image = base64.b64encode(picture).decode()
    rows = "".join(_row(_NAMES[name], _part(found, name)) for name in _NAMES if name in found)
    reliability = cast(Mapping[str, float], labels["reliability"])
    raters = ", ".join(f"{html.escape(name)} {value:.2f}" for name, value in sorted(reliability.items(), key=lambda each: -each[1]))
    return f"""<!doctype html><html lang="en"><meta charset="utf-8"><meta name="viewport" content="width=device-width">
<title>RLHF demo</title><style>{_STYLE}</style><h1>Film reviews that go on kindly</h1>
<p>A small model of film reviews, a reward model of real people's ratings of snippets, and policies that were trained on it.
<em>Gold</em> is what is wanted (kind words, no repetition), which no policy was shown; <em>proxy</em> is what the reward model says.
Seed {found["seed"]}.</p>
<img alt="Left: gold by distance from the base. Right: proxy and gold while policies learn." src="data:image/png;base64,{image}">
<h2>Policies beside the base</h2><table><tr><th>learner</th><th class="n">wins [95 %]</th><th class="n">KL, nats a text</th>
<th class="n">gold, base &rarr; policy</th><th class="n">proxy</th><th class="n">repetition</th></tr>{rows}</table>
<h2>Labels</h2><p>Share of pairs labelled as the raters' own yardstick has it: one rater {_percent(labels["single"])}, majority of three
{_percent(labels["majority"])}, Dawid-Skene {_percent(labels["dawid_skene"])}. Reliability found: {raters}.</p>
<h2>Reward model</h2><p>Right on {_percent(reward["accuracy"])} of {reward["pairs"]} held-out pairs (95 % interval {low:.1%} to {high:.1%});
calibration error {_number(reward["calibration_error"])}.</p>
<h2>Texts</h2>{"".join(_texts(_NAMES[name], _part(found, name)) for name in _NAMES if name in found)}</html>
"""


def _equal_distance(axes: "Axes", found: Found) -> None:
    points = cast(Sequence[Mapping[str, float]], _part(found, "best_of_n")["points"])
    axes.plot([each["kl"] for each in points], [each["gold"] for each in points], "o-", color=COLOURS[6], label="best of n", markersize=4)
    for colour, name in zip(COLOURS, _NAMES, strict=False):
        if name in found:
            part = _part(found, name)
            axes.plot([_float(part["kl"])], [_float(_judged(part)["policy"])], "D", color=colour, label=_NAMES[name])
    axes.set(xlabel="distance from the base (nats a text)", ylabel="gold", title="What is wanted, by distance from the base")
    axes.legend()


def _curves(axes: "Axes", found: Found) -> None:
    for colour, name in zip(COLOURS, _NAMES, strict=False):
        curve = cast(Sequence[Mapping[str, float]], _part(found, name).get("curve", ())) if name in found else ()
        if curve:
            kl = [each["kl"] for each in curve]
            axes.plot(kl, [each["score"] for each in curve], "--", color=colour, linewidth=1, label=f"{_NAMES[name]}: proxy")
            axes.plot(kl, [each["gold"] for each in curve], "-", color=colour, linewidth=1.4, label=f"{_NAMES[name]}: gold")
    axes.set(xlabel="distance from the base (nats a text)", ylabel="mean of a batch", title="While they learn: proxy and gold")
    if axes.lines:
        axes.legend(fontsize=8)


def _row(name: str, part: Found) -> str:
    gold = _judged(part)
    low, high = cast(Sequence[float], gold["win_rate_ci95"])
    proxy = cast(Mapping[str, Mapping[str, float]], part["judged"])["proxy"]["policy"]
    cells = [
        f"{_float(gold['win_rate']):.1%} [{low:.1%}, {high:.1%}]",
        _number(part["kl"]),
        f"{_number(gold['base'])} &rarr; {_number(gold['policy'])}",
        _number(proxy),
        _number(part["repetition"]),
    ]
    stopped = f"<br>stopped: {html.escape(str(part['stopped']))}" if part.get("stopped") else ""
    return f"<tr><td>{name}{stopped}</td>{''.join(f'<td class=n>{cell}</td>' for cell in cells)}</tr>"


def _texts(name: str, part: Found) -> str:
    samples = cast(Sequence[Mapping[str, object]], part["samples"])[:5]
    rows = "".join(
        f"<tr>{''.join(f'<td>{html.escape(str(each[key]))}</td>' for key in ('prompt', 'base', 'policy'))}</tr>" for each in samples
    )
    return f"<h3>{name}</h3><table><tr><th>prompt</th><th>base</th><th>{name}</th></tr>{rows}</table>"


def _part(found: Found, name: str) -> Found:
    return cast(Found, found[name])


def _judged(part: Found) -> Found:
    return cast(Mapping[str, Found], part["judged"])["gold"]


def _float(value: object) -> float:
    return float(cast(float, value))


def _number(value: object) -> str:
    return f"{_float(value):.2f}"


def _percent(value: object) -> str:
    return f"{_float(value):.1%}"
