"""The win probability over a game, as a small drawing of our own: nothing to load, and it follows light and dark."""

from collections.abc import Sequence
from html import escape

_WIDTH, _HEIGHT = 320, 96


def probability_line(chances: Sequence[float | None], shown: int, first: str, second: str) -> str:
    """SVG of the chances of the first player by position, with a mark at the one looked at. Positions without one are bridged."""
    known = [(number, chance) for number, chance in enumerate(chances) if chance is not None]
    label = f"Win probability of {first}: " + (f"now {known[-1][1]:.0%}" if known else "not known yet")
    steps = max(len(chances) - 1, 8)
    points = [(_WIDTH * number / steps, _HEIGHT * (1 - chance)) for number, chance in known]
    at = _WIDTH * shown / steps
    parts = [
        f'<svg class="chances" viewBox="-2 -4 {_WIDTH + 4} {_HEIGHT + 8}" preserveAspectRatio="none"',
        f' role="img" aria-label="{escape(label)}">',
        f'<rect class="ground" x="0" y="0" width="{_WIDTH}" height="{_HEIGHT}" rx="4"/>',
    ]
    if points:
        line = " ".join(f"{x:.1f},{y:.1f}" for x, y in points)
        parts.append(f'<polygon class="area" points="{points[0][0]:.1f},{_HEIGHT} {line} {points[-1][0]:.1f},{_HEIGHT}"/>')
    parts.append(f'<line class="even" x1="0" y1="{_HEIGHT / 2}" x2="{_WIDTH}" y2="{_HEIGHT / 2}"/>')
    parts.append(f'<line class="now" x1="{at:.1f}" y1="0" x2="{at:.1f}" y2="{_HEIGHT}"/>')
    if points:
        parts.append(f'<polyline class="line" points="{line}"/>')
        parts.append("".join(f'<path class="dot" d="M{x:.1f} {y:.1f}h0"/>' for x, y in points))
    parts.append("</svg>")
    # Text in the drawing would be stretched with it.
    ends = f'<span class="end top-end">{escape(first)} wins</span><span class="end bottom-end">{escape(second)} wins</span>'
    return f'<div class="chances-box">{"".join(parts)}<div aria-hidden="true">{ends}</div></div>'
