"""MinAtar Seaquest: shoot fish and submarines and bring divers to the surface (Young and Tian, 2019; rules of minatar 1.0.15).

What is shot is worth 1; surfacing with six divers up to 10, by the oxygen that is left. It ends when something hits the player, without
oxygen, or when surfacing with no diver. Every surfacing makes enemies more frequent and faster, unless `difficulty_ramping` is false. As
in the package, surfacing with six divers leaves -1 of them aboard: the next surfacings cost nothing. Channels: own front and back, own
bullets, where a thing came from, their bullets, fish, submarines, oxygen, divers aboard, divers.

The package keeps five lists; here each has fixed places, in the same order. They suffice because:

* Own bullets, 2: one every 5 steps at most, and one lives 9 steps. Divers, 2: one every 30 steps, and one is there for 59.
* Enemies, 32 in a ring: one stays 10 moves at most. At levels 6 and above it moves every 3 steps: 30 steps, a spawn a step. Below, spawns
  are 15 steps or more apart and a move takes 6 steps at most, so one that was there before level 6 sees 4 spawns until then, and leaves 5 +
  1 + 27 steps later; a level takes 2 steps, so spawns are 4 steps or more apart for the first 20 of them: 4 + 6 + 13 spawns, fewer than 32.
* Their bullets, one an enemy, kept where the enemy is: reloading takes 11 steps and crossing the board 10. A bullet is faster than who shot
  it, so it has left the board before the place is taken again, even if who shot it is dead.

All enemies of a row go the same way, and none catches up: the one before moves first, since where spawns are near in time the pace is
constant. So no two enter a cell in one step, and the order in which the package walks its lists matters only for what is shot.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int32

from thorndike.environments.native.minatar.game import (
    ALL_ACTIONS,
    DOWN,
    EMPTY,
    FIRE,
    LAST,
    LEFT,
    RIGHT,
    SIZE,
    UP,
    Game,
    bits,
    board,
    cells,
    dynamics,
    inside,
    move,
    places,
    sign,
    whole,
)
from thorndike.environments.native.randomness import no_noise
from thorndike.environments.native.vectorize import Dynamics

ENEMIES = 32
ROWS = 8
"""Rows 1 to 8 are the sea."""
OXYGEN = 200
DIVERS = 6
SPAWN_INTERVAL = 20
DIVER_INTERVAL = 30
DIVER_MOVE_INTERVAL = 5
MOVE_INTERVAL = 5
FASTEST_MOVE_INTERVAL = 2
SHOT_INTERVAL = 5
ENEMY_SHOT_INTERVAL = 10
HIGHEST_LEVEL = 19


class Bullet(NamedTuple):
    """One of the player's bullets; off the board there is none."""

    x: Int32[Array, "*batch"]
    y: Int32[Array, "*batch"]
    right: Bool[Array, "*batch"]


class Diver(NamedTuple):
    """A diver to be picked up; off the board there is none."""

    x: Int32[Array, "*batch"]
    y: Int32[Array, "*batch"]
    right: Bool[Array, "*batch"]
    timer: Int32[Array, "*batch"]


class Enemies(NamedTuple):
    """Fish and submarines; off the board there is none."""

    x: Int32[Array, "*batch 32"]
    y: Int32[Array, "*batch 32"]
    right: Bool[Array, "*batch 32"]
    armed: Bool[Array, "*batch 32"]
    """A submarine, no fish."""
    timer: Int32[Array, "*batch 32"]
    reload: Int32[Array, "*batch 32"]
    bullet: Int32[Array, "*batch 32"]
    """Column of its bullet, which stays in its row."""


class State(NamedTuple):
    """The player, clocks that count down, and what is in the sea; of pairs the older comes first."""

    x: Int32[Array, "*batch"]
    y: Int32[Array, "*batch"]
    right: Bool[Array, "*batch"]
    oxygen: Int32[Array, "*batch"]
    aboard: Int32[Array, "*batch"]
    surfaced: Bool[Array, "*batch"]
    level: Int32[Array, "*batch"]
    """0 to 19: enemies appear every ``20 - level`` steps, and move every ``1 + max(2, 5 - level // 2)``."""
    shot_timer: Int32[Array, "*batch"]
    enemy_timer: Int32[Array, "*batch"]
    diver_timer: Int32[Array, "*batch"]
    bullets: tuple[Bullet, Bullet]
    divers: tuple[Diver, Diver]
    enemies: Enemies
    next_place: Int32[Array, "*batch"]
    """Where in the ring the next enemy comes; whoever is there has been there longest."""


class Outcome(NamedTuple):
    """What a part of a step is worth, and whether it ends the game."""

    reward: Int32[Array, "*batch"]
    over: Bool[Array, "*batch"]


def seaquest(*, sticky_action_prob: float = 0.1, difficulty_ramping: bool = True) -> Dynamics:
    """MinAtar/Seaquest-v0: six actions."""
    return dynamics(SEAQUEST._replace(play=partial(play, ramping=difficulty_ramping)), 0, sticky_action_prob)


def seaquest_minimal(*, sticky_action_prob: float = 0.1, difficulty_ramping: bool = True) -> Dynamics:
    """MinAtar/Seaquest-v1: the same six, for all of them do something."""
    return dynamics(SEAQUEST._replace(play=partial(play, ramping=difficulty_ramping)), 1, sticky_action_prob)


def reset(noise: tuple[()]) -> State:
    """At the surface, in an empty sea."""
    del noise
    zero, no, none = jnp.int32(0), jnp.bool_(False), jnp.int32(EMPTY)
    zeros, noes, nones = jnp.zeros(ENEMIES, jnp.int32), jnp.zeros(ENEMIES, bool), jnp.full(ENEMIES, EMPTY, jnp.int32)
    bullet, diver = Bullet(none, zero, no), Diver(none, zero, no, zero)
    return State(
        x=jnp.int32(5),
        y=zero,
        right=no,
        oxygen=jnp.int32(OXYGEN),
        aboard=zero,
        surfaced=jnp.bool_(True),
        level=zero,
        shot_timer=zero,
        enemy_timer=jnp.int32(SPAWN_INTERVAL),
        diver_timer=jnp.int32(DIVER_INTERVAL),
        bullets=(bullet, bullet),
        divers=(diver, diver),
        enemies=Enemies(nones, zeros, noes, noes, zeros, zeros, nones),
        next_place=zero,
    )


def play(
    state: State, action: Int32[Array, "*batch"], numbers: Float[Array, "*batch 5"], *, ramping: bool = True
) -> tuple[State, Float[Array, "*batch"], Bool[Array, "*batch"]]:
    """One step: what appears, the player, own bullets, divers, enemies and their bullets, the surface."""
    state = spawn_diver(spawn_enemy(state, numbers[..., :3]), numbers[..., 3:])
    state = steer(state, action)
    state, shot = shoot(state)
    state = collect(state)
    state, met = attack(state)
    state, surfaced = breathe(state, ramping)
    return state, (shot + met.reward + surfaced.reward).astype(jnp.float32), met.over | surfaced.over


def spawn_enemy(state: State, numbers: Float[Array, "*batch 3"]) -> State:
    """When it is time, a submarine, one time in three, or a fish, at an end of a row in which none goes the other way."""
    enemies, due = state.enemies, state.enemy_timer == 0
    right, armed, y = numbers[..., 0] < 1 / 2, numbers[..., 1] < 1 / 3, 1 + whole(numbers[..., 2], ROWS)
    opposed = jnp.any(inside(enemies.x) & (enemies.y == y[..., None]) & (enemies.right ^ right[..., None]), axis=-1)
    spawned = due & ~opposed
    here = spawned[..., None] & (places(y, ENEMIES) == state.next_place[..., None])

    def put(new: Array | int, old: Array) -> Array:
        return jnp.where(here, new[..., None] if isinstance(new, jax.Array) else new, old)

    enemies = Enemies(
        x=put(jnp.where(right, jnp.int32(0), jnp.int32(LAST)), enemies.x),
        y=put(y, enemies.y),
        right=put(right, enemies.right),
        armed=put(armed, enemies.armed),
        timer=put(move_interval(state.level), enemies.timer),
        reload=put(ENEMY_SHOT_INTERVAL, enemies.reload),
        bullet=put(EMPTY, enemies.bullet),
    )
    return state._replace(
        enemies=enemies,
        next_place=(state.next_place + spawned.astype(jnp.int32)) & (ENEMIES - 1),
        enemy_timer=jnp.where(due, SPAWN_INTERVAL - state.level, state.enemy_timer),
    )


def spawn_diver(state: State, numbers: Float[Array, "*batch 2"]) -> State:
    """When it is time, a diver at an end of any row."""
    due, right = state.diver_timer == 0, numbers[..., 0] < 1 / 2
    x = jnp.where(right, jnp.int32(0), jnp.int32(LAST))
    new = Diver(x, 1 + whole(numbers[..., 1], ROWS), right, jnp.full_like(x, DIVER_MOVE_INTERVAL))
    return state._replace(divers=pushed(due, state.divers, new), diver_timer=jnp.where(due, DIVER_INTERVAL, state.diver_timer))


def steer(state: State, action: Int32[Array, "*batch"]) -> State:
    """The player's move or shot."""
    fired = (action == FIRE) & (state.shot_timer == 0)
    left, right = action == LEFT, action == RIGHT
    return state._replace(
        x=move(state.x, right, left),
        y=move(state.y, action == DOWN, action == UP, 0, ROWS),
        right=(state.right | right) & ~left,
        bullets=pushed(fired, state.bullets, Bullet(state.x, state.y, state.right)),
        shot_timer=jnp.where(fired, SHOT_INTERVAL, state.shot_timer),
    )


def shoot(state: State) -> tuple[State, Int32[Array, "*batch"]]:
    """Own bullets fly, the newer first; how many enemies they hit."""
    older, newer = state.bullets
    newer, enemies, second = fly(newer, state.enemies, state.next_place)
    older, enemies, first = fly(older, enemies, state.next_place)
    return state._replace(bullets=(older, newer), enemies=enemies), first.astype(jnp.int32) + second.astype(jnp.int32)


def fly(bullet: Bullet, enemies: Enemies, next_place: Int32[Array, "*batch"]) -> tuple[Bullet, Enemies, Bool[Array, "*batch"]]:
    """A bullet one cell on; it hits the oldest fish there, else the oldest submarine."""
    x = jnp.where(inside(bullet.x), bullet.x + sign(bullet.right), EMPTY)
    met = inside(enemies.x) & (enemies.x == x[..., None]) & (enemies.y == bullet.y[..., None])
    age = (places(x, ENEMIES) - next_place[..., None]) & (ENEMIES - 1)
    order = jnp.where(met, age + jnp.where(enemies.armed, ENEMIES, 0), 2 * ENEMIES)
    first = jnp.min(order, axis=-1)
    hit = first < 2 * ENEMIES
    left = jnp.where(met & (order == first[..., None]), EMPTY, enemies.x)
    return bullet._replace(x=jnp.where(hit, EMPTY, x)), enemies._replace(x=left), hit


def collect(state: State) -> State:
    """Divers move, the newer first, and come aboard where they meet the player, if there is room."""
    older, newer = state.divers
    newer, aboard = swim(newer, state.aboard, state)
    older, aboard = swim(older, aboard, state)
    return state._replace(divers=(older, newer), aboard=aboard)


def swim(diver: Diver, aboard: Int32[Array, "*batch"], state: State) -> tuple[Diver, Int32[Array, "*batch"]]:
    """A diver, and how many are aboard, after its move."""
    there = inside(diver.x)
    takes = there & (diver.y == state.y) & (aboard < DIVERS)
    met = takes & (diver.x == state.x)
    moving = there & ~met & (diver.timer == 0)
    x = jnp.where(moving, diver.x + sign(diver.right), diver.x)
    gone = met | (takes & (x == state.x))
    timer = jnp.where(moving, DIVER_MOVE_INTERVAL, diver.timer - 1)
    return diver._replace(x=jnp.where(gone | ~there, EMPTY, x), timer=timer), aboard + gone.astype(jnp.int32)


def attack(state: State) -> tuple[State, Outcome]:
    """Enemies move, into the player or into own bullets, submarines shoot, and their bullets fly."""
    enemies = state.enemies
    there = inside(enemies.x)
    at_row = enemies.y == state.y[..., None]
    touching = there & at_row & (enemies.x == state.x[..., None])
    moving = there & (enemies.timer == 0)
    x = jnp.where(moving, enemies.x + sign(enemies.right), enemies.x)
    caught = moving & at_row & (x == state.x[..., None])
    bullets, shot = strike(state.bullets, moving & inside(x) & ~caught, x, enemies.y)
    firing = there & enemies.armed & (enemies.reload == 0)
    bullet, struck = fly_at_player(jnp.where(firing, x, enemies.bullet), enemies.right, at_row, state.x)
    after = enemies._replace(
        x=jnp.where(shot | ~there, EMPTY, x),
        timer=jnp.where(moving, move_interval(state.level)[..., None], enemies.timer - 1),
        reload=jnp.where(firing, ENEMY_SHOT_INTERVAL, enemies.reload - 1),
        bullet=bullet,
    )
    over = jnp.any(touching | caught | struck, axis=-1)
    return state._replace(enemies=after, bullets=bullets), Outcome(jnp.sum(shot, axis=-1, dtype=jnp.int32), over)


def strike(
    bullets: tuple[Bullet, Bullet], moved: Bool[Array, "*batch 32"], x: Int32[Array, "*batch 32"], y: Int32[Array, "*batch 32"]
) -> tuple[tuple[Bullet, Bullet], Bool[Array, "*batch 32"]]:
    """Enemies that moved into a bullet, and the bullets that are left: of two at one place the older is used up."""
    older, newer = bullets
    by_older = moved & (x == older.x[..., None]) & (y == older.y[..., None])
    by_newer = moved & (x == newer.x[..., None]) & (y == newer.y[..., None]) & ~by_older
    older = older._replace(x=jnp.where(jnp.any(by_older, axis=-1), EMPTY, older.x))
    newer = newer._replace(x=jnp.where(jnp.any(by_newer, axis=-1), EMPTY, newer.x))
    return (older, newer), by_older | by_newer


def fly_at_player(
    bullet: Int32[Array, "*batch 32"], right: Bool[Array, "*batch 32"], at_row: Bool[Array, "*batch 32"], x: Int32[Array, "*batch"]
) -> tuple[Int32[Array, "*batch 32"], Bool[Array, "*batch 32"]]:
    """Their bullets one cell on, and which hit the player, where they were or where they come."""
    flown = jnp.where(inside(bullet), bullet + sign(right), EMPTY)
    return flown, at_row & ((bullet == x[..., None]) | (flown == x[..., None]))


def breathe(state: State, ramping: bool) -> tuple[State, Outcome]:
    """The clocks, the oxygen, and what happens at the surface."""
    under = state.y > 0
    surfacing = ~under & ~state.surfaced
    saved = surfacing & (state.aboard != 0)
    full = saved & (state.aboard == DIVERS)
    after = state._replace(
        oxygen=jnp.where(saved, OXYGEN, state.oxygen - under.astype(jnp.int32)),
        aboard=jnp.where(full, 0, state.aboard) - saved.astype(jnp.int32),
        surfaced=~under,
        level=jnp.minimum(state.level + saved.astype(jnp.int32), HIGHEST_LEVEL) if ramping else state.level,
        shot_timer=jnp.maximum(state.shot_timer - 1, 0),
        enemy_timer=jnp.maximum(state.enemy_timer - 1, 0),
        diver_timer=jnp.maximum(state.diver_timer - 1, 0),
    )
    over = (state.oxygen <= 0) | (surfacing & ~saved)
    return after, Outcome(jnp.where(full, tenths(state.oxygen), 0), over)


def observe(state: State) -> Bool[Array, "... 10 10 10"]:
    """Own front and back, own bullets, where things came from, their bullets, fish, submarines, oxygen, divers aboard, divers."""
    (older_bullet, newer_bullet), (older, newer) = state.bullets, state.divers
    kinds, trails = words(state.enemies)
    bottom = places(state.x, SIZE)[..., :, None] == LAST
    column = places(state.x, SIZE)[..., None, :]
    aboard, oxygen = state.aboard[..., None, None], tenths(state.oxygen)[..., None, None]
    return board(
        cells(state.y, state.x),
        cells(state.y, state.x - sign(state.right)),
        cells(older_bullet.y, older_bullet.x) | cells(newer_bullet.y, newer_bullet.x),
        bits(trails) | trail(older) | trail(newer),
        bits(kinds, 2 * SIZE),
        bits(kinds),
        bits(kinds, SIZE),
        bottom & (column < oxygen),
        bottom & (column >= LAST - aboard) & (column < LAST),
        cells(older.y, older.x) | cells(newer.y, newer.x),
    )


def words(enemies: Enemies) -> tuple[Int32[Array, "*batch 10"], Int32[Array, "*batch 10"]]:
    """Each row as two words of bits: fish, submarines and their bullets from bits 0, 10 and 20 on; and where enemies came from."""

    def bit(column: Int32[Array, "*batch 32"], there: Bool[Array, "*batch 32"]) -> Int32[Array, "*batch 32"]:
        return jnp.where(there & inside(column), jnp.int32(1) << jnp.clip(column, 0, LAST), 0)

    there, shooting = inside(enemies.x), inside(enemies.bullet)
    enemy, bullet = bit(enemies.x, there), bit(enemies.bullet, shooting)
    kinds = jnp.where(enemies.armed, enemy << SIZE, enemy) | (bullet << (2 * SIZE))
    in_row = enemies.y[..., None, :] == places(enemies.y[..., 0], SIZE)[..., :, None]

    def gather(word: Int32[Array, "*batch 32"]) -> Int32[Array, "*batch 10"]:
        return jax.lax.reduce(jnp.where(in_row, word[..., None, :], 0), jnp.int32(0), jax.lax.bitwise_or, (in_row.ndim - 1,))

    return gather(kinds), gather(bit(enemies.x - sign(enemies.right), there))


def trail(diver: Diver) -> Bool[Array, "*batch 10 10"]:
    """Where a diver came from."""
    return cells(diver.y, jnp.where(inside(diver.x), diver.x - sign(diver.right), EMPTY))


def pushed(due: Bool[Array, "*batch"], pair: tuple, new: tuple) -> tuple:
    """A pair whose older one, which is gone by then, makes room for a new one."""
    older, newer = pair
    return tuple(jax.tree.map(lambda a, b: jnp.where(due, a, b), after, before) for after, before in ((newer, older), (new, newer)))


def tenths(oxygen: Int32[Array, "*batch"]) -> Int32[Array, "*batch"]:
    """The oxygen that is left, 0 to 10."""
    return jnp.maximum(oxygen, 0) * SIZE // OXYGEN


def move_interval(level: Int32[Array, "*batch"]) -> Int32[Array, "*batch"]:
    """Steps an enemy waits between two moves."""
    return jnp.maximum(FASTEST_MOVE_INTERVAL, MOVE_INTERVAL - (level >> 1))


SEAQUEST = Game("Seaquest", 10, ALL_ACTIONS, reset, no_noise, observe, play, numbers=5)
