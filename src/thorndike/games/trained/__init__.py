"""Small trained policies that come with the library, so that there is somebody to play against: exported as any run's, and no code."""

from pathlib import Path


def trained_run(game: str) -> Path | None:
    """The folder that holds the policy of a game, to be loaded as a run is; None if there is none."""
    folder = Path(__file__).parent / game
    return folder if game.isidentifier() and (folder / "policy" / "policy.json").is_file() else None
