"""A small picture for each kind of game, drawn here."""

from collections.abc import Mapping
from types import MappingProxyType

_DISCS = "".join(
    f'<circle cx="{9 + 10 * column}" cy="{9 + 10 * row}" r="3.8" fill="var(--{colour})"/>'
    for row, colours in enumerate(("hole hole hole hole", "hole hole second hole", "hole first second hole", "first second first first"))
    for column, colour in enumerate(colours.split())
)
_GRID = "".join(f'<path d="M{8 + 8 * i} 8V40M8 {8 + 8 * i}H40" stroke="#3b2c12" stroke-width="1"/>' for i in range(5))
_HEXES = "".join(
    f'<circle cx="{9 + 10 * column + 5 * (row % 2)}" cy="{12 + 8 * row}" r="4.4" fill="{colour}" stroke="var(--edge)"/>'
    for row, colours in enumerate(("#2f6fd0 none none", "none #2f6fd0 none", "var(--first) none #2f6fd0", "none var(--first) none"))
    for column, colour in enumerate(colours.split())
)
_CHESS = "".join(f'<rect x="{10 * (i % 4) + 4}" y="{10 * (i // 4) + 4}" width="10" height="10"/>' for i in range(16) if (i + i // 4) % 2)

_DRAWINGS: Mapping[str, str] = MappingProxyType(
    {
        "marks": '<path d="M18 5V43M30 5V43M5 18H43M5 30H43" stroke="var(--edge)" stroke-width="1.5"/>'
        '<path d="M21 21l6 6m0-6l-6 6M8.5 33l6 6m0-6l-6 6" stroke="var(--accent)" stroke-width="2.5"/>'
        '<circle cx="36.5" cy="11.5" r="3.5" fill="none" stroke="var(--first)" stroke-width="2.5"/>',
        "discs": f'<rect x="2" y="2" width="44" height="44" rx="6" fill="var(--well)"/>{_DISCS}',
        "stones": '<rect x="2" y="2" width="44" height="44" rx="6" fill="var(--felt)"/><path d="M24 2V46M2 24H46" stroke="#0004"/>'
        '<circle cx="13" cy="13" r="8" fill="#fafafa"/><circle cx="35" cy="35" r="8" fill="#fafafa"/>'
        '<circle cx="35" cy="13" r="8" fill="#161616"/><circle cx="13" cy="35" r="8" fill="#161616"/>',
        "go": f'<rect x="2" y="2" width="44" height="44" rx="6" fill="var(--wood)"/>{_GRID}'
        '<circle cx="16" cy="24" r="5" fill="#161616"/><circle cx="32" cy="24" r="5" fill="#fafafa"/>'
        '<circle cx="24" cy="16" r="5" fill="#161616"/>',
        "hex": _HEXES,
        "chess": f'<rect x="4" y="4" width="40" height="40" fill="var(--light-square)"/><g fill="var(--dark-square)">{_CHESS}</g>'
        '<circle cx="29" cy="19" r="4" fill="#1a1a1a"/><circle cx="19" cy="29" r="4" fill="#fff" stroke="#1a1a1a"/>',
        "letters": '<rect x="4" y="4" width="40" height="40" rx="6" fill="none" stroke="var(--edge)" stroke-width="1.5"/>'
        '<path d="M24 4V44M4 24H44" stroke="var(--edge)" stroke-width="1.5"/><circle cx="14" cy="14" r="4" fill="var(--accent)"/>',
    }
)


def game_icon(pieces: str) -> str:
    """SVG for one of the kinds of ``looks.Look.pieces``."""
    return f'<svg viewBox="0 0 48 48" aria-hidden="true">{_DRAWINGS.get(pieces, _DRAWINGS["letters"])}</svg>'
