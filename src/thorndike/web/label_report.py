"""The owner's page of a labelling project: how far it is, how far raters agree, who they are, and files to take away.

Raters must not see it: it has a key of its own, in the address that only the owner is told.
"""

import hmac
from collections.abc import Mapping
from html import escape
from typing import cast

from fastapi import FastAPI, Request
from fastapi.responses import RedirectResponse, Response

from thorndike.errors import UserError
from thorndike.language.preferences.agreement import Agreement, RaterReport, Share, agreement
from thorndike.language.preferences.comparisons import compared
from thorndike.language.preferences.formats import EXPORTS, export_rows
from thorndike.language.preferences.noise import METHODS, Method, dawid_skene
from thorndike.language.preferences.records import as_text
from thorndike.language.preferences.store import Progress
from thorndike.web.label import Labelling

_COOKIE = "thorndike_owner"
_KINDS = {"jsonl": "application/x-ndjson", "json": "application/json", "csv": "text/csv"}
_HEADINGS = (
    "Rater",
    "Judged",
    "Skipped",
    "Agrees with others",
    "Gold right",
    "As before",
    "First side",
    "Cycles",
    "Seconds",
    "Reliability",
)
_NOTES = {
    "Raw agreement": "how often two raters of the same pair say the same; with its 95 % interval",
    "Krippendorff's alpha, nominal": "1 is perfect, 0 is chance; below 0.67 labels are best used with weights",
    "Krippendorff's alpha, ordinal": "the same, where slightly and much better are near each other",
    "Cohen's kappa": "two raters at a time, weighted by what they share",
    "Fleiss' kappa": "over pairs with the commonest number of raters",
}


def add_label_report(app: FastAPI, labelling: Labelling, key: str) -> None:
    """The page ``/preferences`` and the files below it."""

    def is_owner(request: Request) -> bool:
        return hmac.compare_digest(request.cookies.get(_COOKIE, "").encode(), key.encode())

    @app.get("/preferences")
    def report(request: Request) -> Response:
        shown = request.query_params.get("key")
        if shown is not None and hmac.compare_digest(shown.encode(errors="replace"), key.encode()):
            answer = RedirectResponse("/preferences", status_code=303)
            answer.set_cookie(_COOKIE, key, path="/preferences", httponly=True, samesite="strict")
            return answer
        if not is_owner(request):
            return _refused()
        judged = labelling.store.judged(labelling.project)
        belief = dawid_skene(compared(judged)).belief
        reliabilities = dict(zip(compared(judged).raters, belief.reliability.tolist(), strict=True))
        page = _page(labelling.name, labelling.store.progress(labelling.project), agreement(judged), reliabilities)
        return Response(page, media_type="text/html", headers={"cache-control": "no-store"})

    @app.get("/preferences/export/{name}")
    def export(request: Request, name: str, method: str = "dawid_skene", ties: str = "drop") -> Response:
        if not is_owner(request):
            return _refused()
        what, _, ending = name.partition(".")
        if method not in METHODS:
            raise UserError(f"there is no way to aggregate labels called '{method}'; there are {', '.join(METHODS)}")
        rows = export_rows(labelling.store, labelling.project, what, cast(Method, method), ties)
        text = as_text(rows, f".{ending}", name)
        headers = {"content-disposition": f'attachment; filename="{what}.{ending}"', "cache-control": "no-store"}
        return Response(text, media_type=_KINDS[ending], headers=headers)


def _refused() -> Response:
    return Response("403: open the owner's address, which was printed where the labelling was started\n", 403, media_type="text/plain")


def _page(name: str, progress: Progress, found: Agreement, reliabilities: Mapping[str, float]) -> str:
    rows = {
        "Raw agreement": _number(found.raw) + ("" if found.raw_ci95 is None else f" ({found.raw_ci95[0]:.2f} to {found.raw_ci95[1]:.2f})"),
        "Krippendorff's alpha, nominal": _number(found.alpha_nominal),
        "Krippendorff's alpha, ordinal": _number(found.alpha_ordinal),
        "Cohen's kappa": _number(found.cohen_kappa),
        "Fleiss' kappa": _number(found.fleiss_kappa),
    }
    agreed = "".join(
        f'<tr><th scope="row">{label}</th><td class="number">{value}</td><td class="quiet">{_NOTES[label]}</td></tr>'
        for label, value in rows.items()
    )
    raters = "".join(_rater_row(each, reliabilities.get(each.rater)) for each in found.raters)
    heading = "".join(f'<th scope="col">{each}</th>' for each in _HEADINGS)
    links = "".join(
        f"<li><span>{escape(what.replace('_', ' '))}</span>"
        + "".join(
            f'<a class="button" href="/preferences/export/{what}.{end}" download>{end.upper()}</a>' for end in ("jsonl", "json", "csv")
        )
        + "</li>"
        for what in EXPORTS
    )
    none = "" if found.raters else '<tr><td colspan="10" class="quiet">Nobody has judged anything yet.</td></tr>'
    return f"""<!doctype html><html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width">
<meta name="color-scheme" content="light dark"><title>{escape(name)}: preferences · Thorndike</title>
<link rel="icon" href="data:,"><link rel="stylesheet" href="/label/static/studio.css">
<link rel="stylesheet" href="/label/static/label.css"></head>
<body class="report"><header class="top"><span class="brand">Thorndike</span><span>{escape(name)}</span><nav aria-label="Pages">
<a href="/label">The raters' page</a></nav></header><main class="page"><h1>Preferences</h1>
<p class="lead">{progress.judgements:,} judgements; {progress.done:,} of {progress.items:,} items have all the raters they want.
{found.shared_pairs:,} of {found.pairs:,} pairs were judged by more than one.</p>
<progress max="{max(progress.items, 1)}" value="{progress.done}" aria-label="Items that are done"></progress>
<h2>Agreement</h2><div class="scroll"><table><tbody>{agreed}</tbody></table></div>
<h2>Raters</h2><div class="scroll" tabindex="0" role="region" aria-label="Raters"><table><thead><tr>{heading}</tr></thead>
<tbody>{raters}{none}</tbody></table></div>
<p class="quiet">Reliability: the chance that a rater says what is so, by Dawid and Skene's model. About 0.5 is guessing; far below it,
sides or keys were mistaken. First side: how often what was shown first won; about 0.5, or only one side was read.</p>
<h2>Take away</h2><ul class="exports">{links}</ul>
<p class="quiet"><code>preference</code> is what TRL's trainers read; ties are left out.
More ways: <code>thorndike language export --help</code>.</p>
</main></body></html>"""


def _rater_row(each: RaterReport, reliability: float | None) -> str:
    shares = (each.with_others, each.gold, each.consistency, each.left, each.cycles)
    cells = [f"{each.judgements:,}", f"{each.skipped:,}", *map(_share, shares), _number(each.median_seconds, 1), _number(reliability)]
    return f'<tr><th scope="row">{escape(each.rater)}</th>' + "".join(f'<td class="number">{cell}</td>' for cell in cells) + "</tr>"


def _export_link(what: str, ending: str) -> str:
    return f'<a class="button" href="/preferences/export/{what}.{ending}" download>{ending.upper()}</a>'


def _share(share: Share) -> str:
    return "-" if share.value is None else f"{share.value:.2f} <small>of {share.of:,}</small>"


def _number(value: float | None, digits: int = 2) -> str:
    return "-" if value is None else f"{value:.{digits}f}"
