"""A person at the terminal against a player: the board as text, moves by name, advice, take back, save."""

import threading
import time
from pathlib import Path

from thorndike.cli.answer import printable
from thorndike.cli.board_text import board_text
from thorndike.errors import UserError
from thorndike.games.game import Choice, Game, Player, Turn, named_action
from thorndike.games.game_record import GameRecord
from thorndike.games.pgn import write_pgn
from thorndike.games.plies import Ply, first_ply, line_names, next_ply
from thorndike.games.saved_game import saved_game_file
from thorndike.games.sgf import can_be_sgf, write_sgf
from thorndike.suggestions import nearest

COMMANDS = ("moves", "hint", "undo", "save", "board", "help", "quit")
_HELP = "a move by its name (moves lists them), or: hint, undo, save [FILE], board, quit"
_LINE = 5
"""Moves of a line that are shown."""


class TerminalGame:
    """One game, asked for line by line."""

    def __init__(
        self, game: Game, opponent: Player | None, adviser: Player | None, person: int, seed: int, opponent_compiles: bool = False
    ) -> None:
        """``opponent`` None: the person plays alone; ``person``: 0 moves first, 1 second."""
        self._opponent_compiles = opponent_compiles
        self._game, self._opponent, self._adviser, self._person, self._seed = game, opponent, adviser, person, seed
        self._plies = [first_ply(game, seed)]
        self._actions: list[int] = []
        self._choices: dict[int, Choice] = {}
        self._score, self._slowest = 0.0, 0.0
        self._gave_up, self._left = False, False
        self._warming = threading.Thread(target=self._warm_up, daemon=True)

    @property
    def _now(self) -> Ply:
        return self._plies[-1]

    def go(self) -> None:
        """To the end of the game, or until the person leaves: by `quit`, the end of the input or Ctrl-C."""
        rival = f" against {self._opponent.name}" if self._opponent is not None else ""
        marks = "" if self._opponent is None else f"; you move {'second' if self._person else 'first'}"
        print(f"{self._game.id}{rival}{marks}. {_HELP}")
        self._show()
        self._warming.start()
        while not self._over() and not self._left:
            if self._opponent is not None and self._now.player != self._person:
                self._ask(self._opponent)
            else:
                self._listen()
        # A program that leaves while it compiles may crash.
        self._warming.join()

    def close(self) -> None:
        """End the opponent, and who advises."""
        for player in (self._opponent, self._adviser):
            if player is not None:
                player.close()

    def result(self) -> dict[str, object]:
        """What ``--json`` prints."""
        over = self._over()
        score = None if not over else self._score if self._opponent is None else self._outcome()
        against = None if self._opponent is None else self._opponent.name
        names = self._names()
        told = {"game": self._game.id, "against": against, "person": self._person, "over": over, "score": score, "moves": names}
        return {**told, "slowest_answer_s": self._slowest}

    def farewell(self) -> str:
        """The last line."""
        if not self._over():
            return f"left after {len(self._actions)} moves"
        if self._opponent is None:
            return f"over after {len(self._actions)} moves: {self._score:g} points"
        return {1.0: "you won", 0.0: "you lost", 0.5: "a draw"}[self._outcome()] + f" after {len(self._actions)} moves"

    def _over(self) -> bool:
        return self._gave_up or not self._now.legal

    def _outcome(self) -> float:
        if self._gave_up:
            return 1.0
        mine, theirs = self._now.rewards[self._person], self._now.rewards[1 - self._person]
        return 0.5 if mine == theirs else float(mine > theirs)

    def _names(self) -> list[str]:
        return [self._game.action_name(ply.position, action) for ply, action in zip(self._plies, self._actions, strict=False)]

    def _warm_up(self) -> None:
        """Compile while the person looks at the board, so that the first answer comes as fast as the others."""
        next_ply(self._game, self._plies[0], self._plies[0].legal[0], self._seed)
        if self._opponent is not None and self._opponent_compiles and self._person == 0:
            self._opponent.choose(Turn(self._game, self._plies[0].position, ()))

    def _asked(self, player: Player) -> Choice:
        if self._warming.is_alive():
            self._warming.join()
        began = time.monotonic()
        earlier = tuple(ply.position for ply in self._plies[:-1])
        choice = player.choose(Turn(self._game, self._now.position, tuple(self._actions), earlier))
        self._slowest = max(self._slowest, time.monotonic() - began)
        return choice

    def _ask(self, player: Player) -> None:
        choice = self._asked(player)
        if choice.resigns:
            self._gave_up = True
            print(choice.remark or f"{player.name} resigns")
            return
        print(f"{player.name} plays {self._told(choice)}")
        self._choices[len(self._actions)] = choice
        self._play(choice.action)

    def _told(self, choice: Choice) -> str:
        """A move, and what the player thinks of it."""
        name = self._game.action_name(self._now.position, choice.action)
        line = line_names(self._game, self._now, choice.principal_variation, _LINE)
        thoughts = [] if choice.win_probability is None else [f"expects {choice.win_probability:.0%}"]
        thoughts += [f"line {' '.join(line)}"] if len(line) > 1 else []
        return name + (f" ({'; '.join(thoughts)})" if thoughts else "")

    def _play(self, action: int) -> None:
        self._actions.append(action)
        self._plies.append(next_ply(self._game, self._now, action, self._seed))
        self._score += self._now.rewards[0]
        self._show()

    def _show(self) -> None:
        print(board_text(self._now.board))

    def _listen(self) -> None:
        """One line of the person's."""
        try:
            words = input(f"{'' if self._opponent is None else 'XO'[self._now.player]}> ").split()
        except EOFError:
            print()
            self._left = True
            return
        except UnicodeDecodeError:
            words = ["?"]
        if not words:
            return
        command = words[0].lower()
        action = named_action(self._game, self._now.position, words[0]) if len(words) == 1 else None
        if action is not None and action in self._now.legal:
            self._play(action)
            return
        try:
            self._obey(command, words[1:])
        except UserError as error:
            print(printable(str(error)))

    def _obey(self, command: str, rest: list[str]) -> None:
        match command:
            case "quit" | "exit" | "q":
                self._left = True
            case "help" | "?":
                print(_HELP)
            case "board":
                self._show()
            case "moves":
                print(" ".join(self._game.action_name(self._now.position, action) for action in self._now.legal))
            case "hint":
                self._hint()
            case "undo":
                self._undo()
            case "save":
                self._save(" ".join(rest))
            case _:
                names = [self._game.action_name(self._now.position, action) for action in self._now.legal]
                close = nearest(command, [*names, *COMMANDS])
                meant = f"; did you mean {close}?" if close else "; `moves` lists those that are, `help` the commands"
                raise UserError(f"{command[:40]} is no legal move{meant}")

    def _hint(self) -> None:
        if self._adviser is None:
            raise UserError("nobody here can give advice in this game")
        choice = self._asked(self._adviser)
        print(f"{self._adviser.name} would give up" if choice.resigns else f"{self._adviser.name} would play {self._told(choice)}")

    def _undo(self) -> None:
        mine = [i for i in range(len(self._actions)) if self._opponent is None or self._plies[i].player == self._person]
        if not mine:
            raise UserError("there is no move of yours to take back")
        for i in range(mine[-1], len(self._actions)):
            self._score -= self._plies[i + 1].rewards[0]
        del self._plies[mine[-1] + 1 :]
        del self._actions[mine[-1] :]
        self._choices = {number: choice for number, choice in self._choices.items() if number < len(self._actions)}
        self._show()

    def _save(self, name: str) -> None:
        path = Path(name) if name else _free(f"{self._game.id}", ".sgf" if can_be_sgf(self._game.id) else ".json")
        other = "nobody" if self._opponent is None else self._opponent.name
        names = ("you", other) if self._person == 0 else (other, "you")
        moves = self._names()
        if path.suffix in (".sgf", ".pgn"):
            played = tuple((ply.player, move) for ply, move in zip(self._plies, moves, strict=False))
            record = GameRecord(self._game.id, names, played)
            data = (write_sgf if path.suffix == ".sgf" else write_pgn)(record).encode()
        else:
            data = saved_game_file(self._game, self._seed, names, moves, self._choices)
        if path.exists():
            raise UserError(f"{path} is there already: give another name")
        try:
            path.write_bytes(data)
        except (OSError, ValueError) as error:
            raise UserError(f"{path} cannot be written: {getattr(error, 'strerror', None) or error}") from error
        print(f"saved: {path}")


def _free(stem: str, suffix: str) -> Path:
    number = 1
    while (path := Path(f"{stem}-{number}{suffix}")).exists():
        number += 1
    return path
