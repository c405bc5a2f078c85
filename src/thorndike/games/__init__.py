"""Two-player games: what they are, who plays them, matches between players, ratings, external engines."""
