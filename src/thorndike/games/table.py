"""A game on a table: who sits there, what was played, which position is looked at. All that a page does with a game, without a page.

Every method may be called from any thread. Those that cannot do what they are asked raise UserError, one line, and change nothing.
Players think in threads of their own; one that is interrupted, or whom nobody looks at any more, is told to stop, and what it answers all
the same is thrown away.
"""

import threading
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

from thorndike.errors import UserError
from thorndike.games.game import Choice, Game, Square, Stopped, Turn
from thorndike.games.plies import Ply, first_ply, next_ply
from thorndike.games.seats import Seat, leave
from thorndike.games.squares import begins_a_move, why_not


class Outcome(NamedTuple):
    """How a game ended."""

    winner: int | None
    """None: a draw, or a game of one player."""
    resigned: bool = False


class View(NamedTuple):
    """What there is to see at one moment."""

    seats: tuple[Seat, ...]
    plies: tuple[Ply, ...]
    moves: tuple[int, ...]
    names: tuple[str, ...]
    """Of the moves."""
    shown: int
    """Which of ``plies`` is looked at."""
    pending: tuple[Square, ...]
    """Squares clicked so far for a move that takes more than one."""
    choices: Mapping[int, Choice]
    """What a player answered to a position, by the number of moves before it."""
    thinking: str | None
    """Who is asked for the next move."""
    analysing: bool
    """Whether the position looked at is being searched, not for a move."""
    analyse: bool
    paused: bool
    """It is a computer's turn, but it was interrupted or could not go on."""
    notice: str
    """The last thing that went wrong, in one line."""
    outcome: Outcome | None

    @property
    def ply(self) -> Ply:
        """The position looked at."""
        return self.plies[self.shown]

    @property
    def at_end(self) -> bool:
        """Whether the position looked at is the one that is played on."""
        return self.shown == len(self.moves)


class _Task(NamedTuple):
    """What somebody is asked to think about."""

    moves: tuple[int, ...]
    seat: Seat
    plays: bool


class Table:
    """One game being played, looked at, or both."""

    def __init__(self, game: Game, seats: Sequence[Seat], analyst: Seat | None = None, seed: int = 0) -> None:
        """``analyst`` searches the positions in which a person is to move, where that is asked for; ``seed`` throws the dice."""
        self.game, self.seed = game, seed
        self._seats, self._analyst = _seated(game, seats), analyst
        self._lock = threading.RLock()
        self._listeners: list[Callable[[], None]] = []
        self._left = False
        """Whether there were listeners, and there are none now."""
        self._task: _Task | None = None
        self._analyse = False
        self._start = first_ply(game, seed)
        self._resigned: int | None = None
        self._clear()

    def _clear(self) -> None:
        self._plies, self._moves, self._names = [self._start], list[int](), list[str]()
        self._choices: dict[int, Choice] = {}
        self._shown, self._pending, self._paused, self._notice, self._resigned = 0, tuple[Square, ...](), False, "", None

    def view(self) -> View:
        """All there is to see, of one moment."""
        with self._lock:
            task = self._task
            return View(
                seats=self._seats,
                plies=tuple(self._plies),
                moves=tuple(self._moves),
                names=tuple(self._names),
                shown=self._shown,
                pending=self._pending,
                choices=dict(self._choices),
                thinking=task.seat.name if task is not None and task.plays else None,
                analysing=task is not None and not task.plays,
                analyse=self._analyse,
                paused=self._paused,
                notice=self._notice,
                outcome=self._outcome(),
            )

    def listen(self, listener: Callable[[], None]) -> Callable[[], None]:
        """Have a function called, from any thread, whenever something changes; what is returned ends that.

        Once the last listener has left nobody thinks until there is another one.
        """
        with self._lock:
            self._listeners.append(listener)
            if self._left:
                self._left = False
                self._changed()

        def leave_table() -> None:
            with self._lock:
                if listener in self._listeners:
                    self._listeners.remove(listener)
                    self._left = not self._listeners
                    self._changed()

        return leave_table

    def begin(self) -> None:
        """Let whoever is to move think, if it is no person."""
        with self._lock:
            self._changed()

    def click(self, square: Square) -> None:
        """Click a square: it plays, chooses a piece or lets go of it."""
        with self._lock:
            self._check_turn()
            board = self._plies[-1].board
            if square in self._pending:
                self._pending = self._pending[: self._pending.index(square)]
                return self._changed()
            chosen = (*self._pending, square)
            if chosen in board.clicks:
                return self._play(board.clicks[chosen])
            if begins_a_move(board, chosen):
                self._pending = chosen
            elif self._pending and begins_a_move(board, (square,)):
                self._pending = (square,)
            else:
                raise UserError(why_not(board, self._pending, square))
            self._changed()

    def press(self, name: str) -> None:
        """Press one of the board's buttons, as ``pass``."""
        with self._lock:
            self._check_turn()
            buttons = self._plies[-1].board.buttons
            if name not in buttons:
                raise UserError(f"{name} is no move here")
            self._play(buttons[name])

    def take_back(self) -> None:
        """Undo the last move, and those before it until it is a person's turn again."""
        with self._lock:
            if not self._moves:
                raise UserError("no move was played yet, so there is none to take back")
            persons = [seat.player is None for seat in self._seats]
            length = len(self._moves) - 1
            while length and any(persons) and not persons[self._plies[length].player]:
                length -= 1
            self._cut(length)
            # A computer that moved first would only play the same move again.
            self._paused = self._seats[self._plies[-1].player].player is not None
            self._changed()

    def play_on_from_here(self) -> None:
        """Leave out all moves after the position that is looked at."""
        with self._lock:
            self._cut(self._shown)
            self._paused = False
            self._changed()

    def swap_sides(self) -> None:
        """Everybody takes the next seat; the moves stay."""
        with self._lock:
            if len(self._seats) < 2:
                raise UserError("one plays this game alone: there are no sides to swap")
            self._seats = self._seats[::-1]
            self._pending, self._paused, self._notice = (), False, ""
            self._changed()

    def seat(self, seats: Sequence[Seat], analyst: Seat | None = None) -> None:
        """Others sit down; the moves stay."""
        with self._lock:
            left = (*self._seats, self._analyst)
            self._seats, self._analyst = _seated(self.game, seats), analyst
            self._pending, self._paused, self._notice = (), False, ""
            self._changed()
        leave(seat for seat in left if seat is not None and seat not in (*seats, analyst))

    def restart(self) -> None:
        """The same players begin anew."""
        with self._lock:
            self._clear()
            self._changed()

    def close(self) -> list[threading.Thread]:
        """Nobody thinks any more, and the players are closed, in the threads that are given back."""
        with self._lock:
            self._task, self._paused, self._analyse = None, True, False
            self._listeners.clear()
        return leave(seat for seat in (*self._seats, self._analyst) if seat is not None)

    def show(self, number: int) -> None:
        """Look at the position after so many moves."""
        with self._lock:
            self._shown, self._pending = min(max(number, 0), len(self._moves)), ()
            self._changed()

    def interrupt(self) -> None:
        """Stop whoever is thinking about a move."""
        with self._lock:
            if self._task is None or not self._task.plays:
                raise UserError("nobody is thinking about a move")
            self._paused = True
            self._changed()

    def go_on(self) -> None:
        """Let the one who was interrupted think again."""
        with self._lock:
            self._paused, self._notice, self._shown = False, "", len(self._moves)
            self._changed()

    def analyse(self, wanted: bool) -> None:
        """Whether the analyst searches the position that is looked at."""
        with self._lock:
            self._analyse = wanted
            self._changed()

    def replay(self, actions: Sequence[int], choices: Mapping[int, Choice]) -> None:
        """Put a whole game on the table, looked at from its beginning. Raises UserError at the first move that is not legal."""
        with self._lock:
            plies, names = [self._start], list[str]()
            for number, action in enumerate(actions, 1):
                if action not in plies[-1].legal:
                    raise UserError(f"move {number} of {len(actions)} is not legal")
                names.append(self.game.action_name(plies[-1].position, action))
                plies.append(next_ply(self.game, plies[-1], action, self.seed))
            self._clear()
            self._plies, self._moves, self._names, self._choices = plies, list(actions), names, dict(choices)
            self._changed()

    # What follows is called with the lock held.

    def _check_turn(self) -> None:
        if self._outcome() is not None:
            raise UserError("the game is over: take a move back, or begin a new one")
        if self._shown != len(self._moves):
            raise UserError(
                f"this is the position after move {self._shown} of {len(self._moves)}: go to the last one, or play on from here"
            )
        seat = self._seats[self._plies[-1].player]
        if seat.player is not None and not self._paused:
            raise UserError(f"it is not your turn: {seat.name} is thinking")
        if seat.player is not None:
            raise UserError(f"it is the turn of {seat.name}: let it go on, take a move back, or swap sides")

    def _play(self, action: int) -> None:
        ply = self._plies[-1]
        self._names.append(self.game.action_name(ply.position, action))
        self._plies.append(next_ply(self.game, ply, action, self.seed))
        followed = self._shown == len(self._moves)
        self._moves.append(action)
        if followed:
            self._shown = len(self._moves)
        self._pending, self._notice = (), ""
        self._changed()

    def _cut(self, length: int) -> None:
        del self._plies[length + 1 :], self._moves[length:], self._names[length:]
        self._choices = {number: choice for number, choice in self._choices.items() if number <= length}
        self._shown, self._pending, self._notice, self._resigned = length, (), "", None

    def _outcome(self) -> Outcome | None:
        if self._resigned is not None:
            return Outcome(1 - self._resigned, resigned=True)
        last = self._plies[-1]
        if last.legal:
            return None
        best = max(last.rewards)
        return Outcome(last.rewards.index(best) if len(last.rewards) == 2 and best > 0 else None)

    def _changed(self) -> None:
        wanted = self._wanted()
        if wanted != self._task:
            self._task = wanted
            if wanted is not None:
                threading.Thread(target=self._think, args=(wanted,), daemon=True, name=f"{wanted.seat.name} at {self.game.id}").start()
        for listener in tuple(self._listeners):
            listener()

    def _wanted(self) -> _Task | None:
        if self._left:
            return None
        if self._outcome() is None and not self._paused:
            seat = self._seats[self._plies[-1].player]
            if seat.player is not None:
                return _Task(tuple(self._moves), seat, plays=True)
        if self._analyse and self._analyst is not None and self._shown not in self._choices and self._plies[self._shown].legal:
            return _Task(tuple(self._moves[: self._shown]), self._analyst, plays=False)
        return None

    def _think(self, task: _Task) -> None:
        """In a thread of its own."""
        seat, number = task.seat, len(task.moves)
        assert seat.player is not None and seat.busy is not None
        with seat.busy:
            with self._lock:
                if self._task is not task:
                    return
                earlier = tuple(ply.position for ply in self._plies[:number])
                turn = Turn(self.game, self._plies[number].position, task.moves, earlier, lambda: self._task is not task)
            try:
                choice = seat.player.choose(turn)
            except Stopped:
                # Nothing, unless a player of the user's raised it unasked.
                return self._give_up(task, f"{seat.name} stopped, though its move was waited for")
            except Exception as error:
                self._give_up(task, f"{seat.name} cannot go on: {error}")
                if not isinstance(error, UserError):
                    raise
                return
        with self._lock:
            if self._task is not task:
                return
            if choice.action not in self._plies[number].legal and not choice.resigns:
                return self._give_up(task, f"{seat.name} answered a move that is not legal and was stopped")
            self._task, self._choices[number] = None, choice
            if not task.plays:
                self._changed()
            elif choice.resigns:
                self._resigned = self._plies[-1].player
                self._changed()
            else:
                self._play(choice.action)

    def _give_up(self, task: _Task, notice: str) -> None:
        with self._lock:
            if self._task is not task:
                return
            self._notice = " ".join(notice.split())
            if task.plays:
                self._paused = True
            else:
                self._analyse = False
            self._changed()


def _seated(game: Game, seats: Sequence[Seat]) -> tuple[Seat, ...]:
    if len(seats) != game.num_players:
        raise UserError(f"{game.id} is played by {game.num_players}, but {len(seats)} sat down")
    return tuple(seats)
