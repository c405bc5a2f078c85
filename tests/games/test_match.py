"""Matches: balanced openings, results by colour, files that outlive an interruption, players that fail or cheat."""

import json
from collections import Counter

import jax
import numpy as np
import pytest

from games.rules import SlowOthello
from thorndike.errors import UserError
from thorndike.games.game import Choice, Player, named_action
from thorndike.games.match import as_record, compiled, openings, play_match
from thorndike.games.players import random_player
from thorndike.games.registry import game
from thorndike.games.tally import tally

TIC_TAC_TOE = game("tic_tac_toe")


@pytest.fixture(scope="module")
def rules():
    return compiled(TIC_TAC_TOE)


def in_order(name="in order"):
    """Always the first legal move."""
    return Player(name, lambda turn: Choice(int(np.flatnonzero(np.asarray(turn.game.legal(turn.position)))[0])))


def test_all_openings_are_there_once_in_an_order_of_the_seed(rules):
    found = openings(rules, 2, 1)
    assert sorted(found) == sorted((a, b) for a in range(9) for b in range(9) if a != b)
    assert found != openings(rules, 2, 2)
    assert found == openings(rules, 2, 1)
    assert openings(rules, 0, 1) == [()]
    drawn = openings(rules, 4, 1)
    assert len(set(drawn)) == len(drawn) > 100
    assert all(len(opening) == 4 for opening in drawn)
    with pytest.raises(UserError, match="no game of tic_tac_toe lasts 9 moves"):
        openings(rules, 9, 1)


def test_every_opening_is_played_with_both_colours():
    first, second = in_order("a"), random_player(1)
    match = play_match(TIC_TAC_TOE, (first, second), 10, seed=3)
    begun = Counter(tuple(name for _, name in played.moves[:2]) for played in match.games)
    assert set(begun.values()) == {2}
    assert [played.players for played in match.games] == [("a", "random"), ("random", "a")] * 5
    told = match.tally
    assert told.total.games == 10
    assert told.moving_first.games == told.moving_second.games == 5
    for played in match.games:
        slow = winner(played.moves)
        assert played.score == {"X": 1.0, "O": 0.0, None: 0.5}[slow]


def winner(moves):
    """By looking at all lines."""
    board = {name: "XO"[player] for player, name in moves}
    lines = [[f"{c}{r}" for c in "abc"] for r in "123"] + [[f"{c}{r}" for r in "123"] for c in "abc"]
    lines += [["a1", "b2", "c3"], ["a3", "b2", "c1"]]
    full = [board.get(line[0]) for line in lines if board.get(line[0]) and len({board.get(square) for square in line}) == 1]
    return full[0] if full else None


def test_a_tally_by_hand():
    told = tally([(0, 1.0), (1, 1.0), (0, 0.5), (1, 0.0), (0, 0.0)])
    assert told.total == (2, 1, 2)
    assert told.moving_first == (1, 1, 1)
    assert told.moving_second == (1, 0, 1)
    assert told.score == 0.5
    assert told.elo == 0
    assert told.score_ci95[0] < 0.2 < 0.8 < told.score_ci95[1]
    assert told.elo_ci95[0] == pytest.approx(-told.elo_ci95[1])
    assert tally([(0, 1.0)] * 5).elo == np.inf


def test_an_interrupted_match_goes_on_where_it_was(tmp_path):
    path = tmp_path / "deep" / "match.jsonl"
    whole = play_match(TIC_TAC_TOE, (in_order("a"), in_order("b")), 8, seed=5)
    asked = 0

    def tired(turn):
        nonlocal asked
        asked += 1
        if asked > 12:
            raise KeyboardInterrupt
        return in_order().choose(turn)

    with pytest.raises(KeyboardInterrupt):
        play_match(TIC_TAC_TOE, (Player("a", tired), in_order("b")), 8, seed=5, path=path)
    kept = path.read_bytes()
    assert 1 < kept.count(b"\n") < 9
    path.write_bytes(kept + b'{"number": 7, "play')
    played = []
    match = play_match(TIC_TAC_TOE, (in_order("a"), in_order("b")), 8, seed=5, path=path, progress=played.append)
    assert match == whole
    assert len(played) == 9 - kept.count(b"\n")
    assert path.read_bytes().startswith(kept)
    assert len(path.read_text().splitlines()) == 9
    longer = play_match(TIC_TAC_TOE, (in_order("a"), in_order("b")), 10, seed=5, path=path)
    assert longer.games[:8] == whole.games


def test_games_of_a_run_before_it_was_trained_on_are_not_taken_for_its_own(tmp_path):
    path = tmp_path / "match.jsonl"
    before, after = (in_order("run")._replace(identity=identity) for identity in ("12", "34"))
    play_match(TIC_TAC_TOE, (before, in_order("b")), 2, path=path)
    kept = path.read_bytes()
    with pytest.raises(UserError, match=r"holds games of a run that has been trained on since, or changed: keep the new ones in another"):
        play_match(TIC_TAC_TOE, (after, in_order("b")), 4, path=path)
    assert path.read_bytes() == kept
    assert len(play_match(TIC_TAC_TOE, (before, in_order("b")), 4, path=path).games) == 4


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"seed": 6}, r"is of another match: its seed is 6, not 5"),
        ({"players": ["a", "c"]}, r'its players is \["a", "c"\], not \["a", "b"\]'),
        ({"format": "x"}, "its format is"),
    ],
)
def test_a_file_of_another_match_is_refused(tmp_path, change, words):
    path = tmp_path / "match.jsonl"
    play_match(TIC_TAC_TOE, (in_order("a"), in_order("b")), 2, seed=5, path=path)
    lines = path.read_text().splitlines()
    path.write_text("\n".join([json.dumps(json.loads(lines[0]) | change), *lines[1:]]) + "\n")
    with pytest.raises(UserError, match=words):
        play_match(TIC_TAC_TOE, (in_order("a"), in_order("b")), 2, seed=5, path=path)


@pytest.mark.parametrize("content", [b"notes of mine", b"notes\nof mine", b'{"format": "thorndike-game"}\n{"a'])
def test_a_file_of_something_else_is_left_as_it_is(tmp_path, content):
    path = tmp_path / "match.jsonl"
    path.write_bytes(content)
    with pytest.raises(UserError, match=r"match\.jsonl"):
        play_match(TIC_TAC_TOE, (in_order("a"), in_order("b")), 2, path=path)
    assert path.read_bytes() == content


@pytest.mark.parametrize(
    "line", ["[]", "{", '{"number": 1}', '{"number": 0, "players": ["a"], "opening": 0, "moves": [], "score": 1, "remark": ""}']
)
def test_a_damaged_line_is_told_with_its_number(tmp_path, line):
    path = tmp_path / "match.jsonl"
    play_match(TIC_TAC_TOE, (in_order("a"), in_order("b")), 2, path=path)
    path.write_text(path.read_text() + line + "\n")
    with pytest.raises(UserError, match=r"match\.jsonl, line 4 is damaged"):
        play_match(TIC_TAC_TOE, (in_order("a"), in_order("b")), 4, path=path)


def test_an_illegal_action_forfeits_and_is_told():
    cheat = Player("cheat", lambda turn: Choice(turn.moves[0] if turn.moves else 99))
    match = play_match(TIC_TAC_TOE, (cheat, in_order()), 2)
    assert match.tally.total == (0, 0, 2)
    assert all("cheat forfeits: action" in played.remark for played in match.games)


def test_a_player_that_fails_once_loses_no_game_and_twice_ends_the_match():
    def failing(times):
        left = [times]

        def choose(turn):
            if left[0]:
                left[0] -= 1
                raise UserError("broken, and once more")
            return in_order().choose(turn)

        return Player("failing", choose)

    assert play_match(TIC_TAC_TOE, (failing(1), in_order()), 4).tally.total.games == 3
    with pytest.raises(UserError, match="broken"):
        play_match(TIC_TAC_TOE, (failing(2), in_order()), 4)


def test_records_of_a_match_hold_the_moves_and_the_result():
    othello = game("othello")
    match = play_match(othello, (random_player(1), random_player(2)), 2, seed=1)
    for played in match.games:
        slow = SlowOthello()
        for player, name in played.moves:
            assert player == "XO".index(slow.mover)
            slow.play(name)
        assert as_record(othello, played).result == tuple(map(float, slow.rewards()))


def test_names_of_moves_that_differ_in_case_only(rules):
    position = rules.init(0)
    assert named_action(TIC_TAC_TOE, position, "B2") == 4
    assert jax.tree.leaves(position)
