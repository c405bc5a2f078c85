"""What runs in a worker process: one environment, which does what it is told over a socket and writes into its row of shared memory.

Kept free of JAX, so that it starts fast. It ends when the pool is closed and, whatever its environment is doing, when its parent is gone.
"""

import fcntl
import json
import os
import select
import signal
import socket
import struct
import sys
import traceback
from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING

import gymnasium
import numpy as np
from gymnasium.vector.utils import CloudpickleWrapper

from thorndike.environments.host.checks import (
    RESET_GIVES,
    STEP_GIVES,
    bounds_hold,
    check_flags,
    check_values,
    due,
    finite_test,
    not_finite,
    number,
    reward_not_finite,
    storer,
)
from thorndike.environments.host.faults import Fault, as_fault
from thorndike.environments.host.shared_block import Block, open_block, row_of

if TYPE_CHECKING:
    from thorndike.types import Observation

COMMAND = struct.Struct("<cq")
"""What is asked, and the seed of a reset."""
RESET, STEP, CLOSE = b"r", b"s", b"c"
DONE = b"."
"""The answer when all is well; a fault is answered by an object of JSON."""
LONGEST_ANSWER = 40_000
"""Bytes: the texts below with every character escaped, six bytes each."""
_LONGEST_TEXT, _LONGEST_TRACEBACK = 1_000, 4_000


class Worker:
    """One environment and its row of the block."""

    def __init__(self, env: gymnasium.Env, block: Block) -> None:
        space = env.observation_space
        self._env, self._block, self._space = env, block, space
        self._store, self._is_finite, self._bounds = storer(space), finite_test(space), bounds_hold(env)
        self._steps = 0

    def reset(self, seed: int) -> None:
        """Start from `seed`; the observation goes where observations after resets are."""
        observation, _ = self._env.reset(seed=seed)
        self._put(self._block.obs, observation, look=True)

    def step(self) -> None:
        """One step with the block's action, and the reset if it ends the episode."""
        self._steps += 1
        block, look = self._block, due(self._steps)
        block.resetting[0] = False
        observation, reward, terminated, truncated, info = self._env.step(block.action[0].copy())
        self._put(block.next_obs, observation, look)
        if look:
            check_flags(terminated, truncated)
        block.reward[0] = number(reward)
        if not np.isfinite(block.reward[0]):
            raise reward_not_finite(block.reward)
        block.terminated[0], block.truncated[0] = terminated, truncated
        block.cost[0] = info.get("cost", 0)

    def reset_if_ended(self) -> None:
        """The reset at the end of an episode."""
        block = self._block
        if block.terminated[0] or block.truncated[0]:
            block.resetting[0] = True
            observation, _ = self._env.reset()
            self._put(block.obs, observation, look=False)

    def _put(self, arrays: "Observation", observation: "Observation", look: bool) -> None:
        self._store(arrays, 0, observation)
        if not self._is_finite(arrays):
            raise not_finite(self._space, arrays)
        if look:
            check_values(self._space, arrays, self._bounds)


def main() -> None:
    """Serve the pool whose file descriptors and place in it are the last five arguments; the constructor comes through stdin."""
    connection, block, parent, row, count = (int(word) for word in sys.argv[-5:])
    end_with_parent(parent)
    for file in (connection, block, parent):
        os.set_inheritable(file, False)
    constructor = sys.stdin.buffer.read()
    _serve(socket.socket(fileno=connection), block, constructor, row, count)


def end_with_parent(pipe: int) -> None:
    """Let the kernel kill this process and its children when the parent, who alone can write to `pipe`, is gone.

    A signal, for no thread here would be heard while an environment hangs in native code.
    """
    fcntl.fcntl(pipe, fcntl.F_SETSIG, signal.SIGKILL)
    fcntl.fcntl(pipe, fcntl.F_SETOWN, -os.getpgrp())
    fcntl.fcntl(pipe, fcntl.F_SETFL, fcntl.fcntl(pipe, fcntl.F_GETFL) | os.O_ASYNC)
    watch = select.poll()
    watch.register(pipe, select.POLLIN)
    if watch.poll(0):
        # It went before it could be watched.
        os._exit(1)


def packed(make: Callable[[], gymnasium.Env], observation: gymnasium.Space, action: gymnasium.Space) -> bytes:
    """A constructor as a worker reads it: Gymnasium's own way, which sends code that a user gave. Never from or to a file."""
    return CloudpickleWrapper(partial(_made, make, observation, action)).__getstate__()


def _made(make: Callable[[], gymnasium.Env], observation: gymnasium.Space, action: gymnasium.Space) -> gymnasium.Env:
    env = make()
    for name, first, own in (("observation", observation, env.observation_space), ("action", action, env.action_space)):
        if first != own:
            raise Fault(f"has the {name} space {own}, but the first one made has {first}", "give all the same spaces")
    return env


def _unpacked(constructor: bytes) -> Callable[[], gymnasium.Env]:
    wrapper: CloudpickleWrapper[gymnasium.Env] = CloudpickleWrapper(gymnasium.Env)
    wrapper.__setstate__(constructor)
    return wrapper.fn


def _serve(connection: socket.socket, block: int, constructor: bytes, row: int, count: int) -> None:
    """Do what is asked until the pool is closed, or one thing went wrong."""
    expected = "a gymnasium.Env"
    try:
        env = _unpacked(constructor)()
    except BaseException as error:
        connection.send(_told(error, expected))
        return
    try:
        worker = Worker(env, row_of(open_block(block, env.observation_space, env.action_space, count), row))
        connection.send(DONE)
        while message := connection.recv(COMMAND.size):
            command, seed = COMMAND.unpack(message)
            if command == CLOSE:
                break
            expected = RESET_GIVES if command == RESET else STEP_GIVES
            if command == RESET:
                worker.reset(seed)
            else:
                worker.step()
                expected = RESET_GIVES
                worker.reset_if_ended()
            connection.send(DONE)
    except BaseException as error:
        # Even SystemExit: what ends a worker is always told.
        connection.send(_told(error, expected))
    finally:
        env.close()


def _told(error: BaseException, expected: str) -> bytes:
    fault = as_fault(error, __file__, expected)
    trace = "" if isinstance(error, Fault) else "".join(traceback.format_exception(error))[-_LONGEST_TRACEBACK:]
    return json.dumps({"what": fault.what[:_LONGEST_TEXT], "mend": fault.mend[:_LONGEST_TEXT], "traceback": trace}).encode("ascii")
